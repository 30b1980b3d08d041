"""START HERE for runs: how commands came about that are not a policy's on the logged states.

One table (`Row`): each row gives the policy something else than the log has (columns times a
factor, in another order, off by constants, smoothed), or makes another policy of it (at other
times, without feedback, cut, from a later step on). All are scored by the same terms, in nats: what
is left of the commands, how far the robot is then from its prediction, and a price. A row that
changes columns is two stories with the same commands: the log has them so, and the robot moved as
the changed ones say; or its program passed them so, and it moved as logged. The motion decides.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import cache, partial
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from grounded.accounts.levels import (
    DECISIVE,
    EXACT,
    EXPLAINED,
    FINE,
    HALF,
    LATEST,
    MARGIN,
    NEARLY_ALL,
    PART,
    SLIGHT,
    STEPS_TO_JUDGE,
)
from grounded.accounts.motion import SHORTLIST
from grounded.accounts.reported import tables
from grounded.accounts.sent import (
    Commanded,
    Fed,
    Following,
    Ran,
    apart,
    commanded,
    evidence,
    follows,
    latest,
    past_of,
    size_of,
)
from grounded.accounts.table import Account, of_commands, unit_named
from grounded.findings import Finding, Quantity, found
from grounded.frozen import Array
from grounded.model import Model
from grounded.places import velocities
from grounded.policy import Policy
from grounded.result import figure, number, with_unit
from grounded.task import Task
from grounded.trial import Trial

OTHERS = 20  # number of latest candidates to compare with
TIMES = {"ms": 1e3, "a clock": np.inf, "no unit: it stays 0": 0.0}  # in place of seconds
SHARES = np.arange(1, 49) / 50  # of its last value that a first-order filter keeps


class Kind(Enum):
    """What a story is about, which decides how it is told."""

    UNIT = "columns of the log times a factor"
    LOG = "another fault of the log"
    PROGRAM = "the program misused its candidate"
    FELL = "the run failed before the log ends"
    CANDIDATE = "another candidate ran"
    EARLIER = "a candidate of an earlier task ran"
    UNKNOWN = "as logged, which is no run of the candidate"


@dataclass(frozen=True)
class Story:
    """One story of how the log of a candidate's run came about."""

    kind: Kind
    finding: Finding | None = None  # None for columns times a factor
    commands: float = 0.0  # what it leaves of them [nats], the logarithm of their relative error
    motion: float = 0.0  # how far the robot is from its prediction then [nats]
    price: float = 0.0  # before a log is seen [nats]
    rerun: bool = False  # no setting reads this log: another run, or log of it, is needed
    names: tuple[str, ...] = ()  # columns that have to be multiplied, or exchanged
    by: float = 1.0  # the factor

    @property
    def left(self) -> float:
        """What remains unexplained [nats]."""
        return self.commands + self.motion + self.price


def scored(
    kind: Kind,
    finding: Finding | None,
    own: Ran,
    run: Trial,
    error: float,
    **other: Any,
) -> Story:
    """Return a story with its score: a candidate's run, with what is left of the commands."""
    return Story(kind, finding, float(np.log(error + FINE)), apart(own, run), **other)


def likeliest(some: Iterable[Story | None], as_logged: Story) -> Story:
    """Return the story that explains a log best; `as_logged` unless one leads it clearly."""
    better = [one for one in some if one and one.left < as_logged.left - MARGIN]
    return min(better, key=lambda one: one.left, default=as_logged)


class Row(NamedTuple):
    """One entry of the table: what the policy was given, and what it was, before any score."""

    policy: Policy  # as it acts
    run: Trial  # with its columns as the policy got them
    stories: tuple[Story, ...]  # that the log is so, or that the robot's program made it so
    steps: int = 0  # of the run that were before it began


def filtered(x: Array, shares: Array) -> Array:
    """Return states (T, n) that a first-order filter passed on, (K, T, n) for its K shares."""
    found = np.repeat(x[None], len(shares), axis=0)
    for t in range(1, len(x)):
        found[:, t] = shares[:, None] * found[:, t - 1] + (1 - shares[:, None]) * x[t]
    return found


def stories(
    task: Task,
    own: Ran,
    trial: Trial,
    plain: Following | None,
    *,
    logged: Sequence[str] | None = None,
    waits: bool | None = None,
) -> list[Story]:
    """Return what explains a trial's commands clearly better than that they are as logged.

    Args:
        task: the task of the candidate.
        own: the candidate.
        trial: the trial, which is said to be its run.
        plain: the comparison of its commands with the policy's.
        logged: the states that a column holds; None: all.
        waits: whether its log begins before any run; None if that is unknown.

    Returns:
        The stories, the likeliest first.
    """
    if plain is None or (plain.alike and plain.error < EXACT) or not trial.inputs.any():
        return []
    trial = trial.until(min(trial.finite_steps, task.horizon, own.policy.horizon))
    logged = task.model.state_names if logged is None else logged
    found = list[Story]()
    for row in nearest(_Table(task.model, own, trial, logged).rows(waits)):
        fit = follows(row.policy, row.run, latest(task))
        if fit is None or not fit.alike or fit.error > EXPLAINED:
            continue
        before = replace(plain, off=plain.off[: len(fit.off)]).left
        motion, gain = apart(own, trial, row.steps), np.log((before + FINE) / (fit.left + FINE))
        for story in row.stories:
            there = motion if story.kind is Kind.PROGRAM else apart(own, row.run, row.steps)
            if gain >= story.price + MARGIN and there <= motion:
                left = float(np.log(fit.left + FINE))
                found.append(replace(story, commands=left, motion=there))
    return sorted(found, key=lambda one: one.left)


def nearest(rows: Sequence[Row]) -> list[Row]:
    """Return the rows that explain the commands best, each policy's compared at once."""
    score, groups = dict[int, float](), dict[int, list[int]]()
    for k, row in enumerate(rows):
        groups.setdefault(id(row.policy), []).append(k)
    for some in groups.values():
        policy, runs = rows[some[0]].policy, [rows[k].run for k in some]
        T, past = min(runs[0].steps, policy.horizon), past_of(policy, runs[0])
        sent = np.clip(np.stack([run.inputs[:T] for run in runs]), policy.low, policy.high)
        asked = policy.commands(np.stack([run.states[:T] for run in runs]), past)
        size = np.stack([size_of(policy, one) for one in sent])[:, None]
        square = Commanded(sent, asked, size).apart ** 2
        left = np.sqrt(np.median(square, axis=1) + 1e-3 * square.mean(axis=1))
        for k, error in zip(some, left, strict=True):
            score[k] = np.log(error + FINE) + min(one.price for one in rows[k].stories)
    return [rows[k] for k in sorted(score, key=lambda k: score[k])[:SHORTLIST]]


# --- the table ------------------------------------------------------------------------------------


class _Table:
    """The rows of a trial: those that hold for any, and those with a number that is fitted."""

    def __init__(self, model: Model, own: Ran, trial: Trial, logged: Sequence[str]) -> None:
        self.model, self.own, self.policy, self.trial = model, own, own.policy, trial
        self.logged, self.names = logged, (*model.state_names, *model.input_names)
        self.fed = own.policy.gain is not None

    def rows(self, waits: bool | None) -> list[Row]:
        """Return all rows."""
        scales = [*self.scales()]
        some = [*scales, *self.orders(), *self.times()]
        if self.fed:
            some += [*self.fitted(scales), *self.smoothed()]
        return [*some, *self.clipped(), *(self.held() if waits is None else self.later(waits))]

    def passed(
        self, code: str, price: float = MARGIN, names: Sequence[str] = (), **facts: Any
    ) -> Story:
        """Return the story that the program gave its policy something else, or ran it so."""
        told = found(code, ran=self.own.id, **facts)
        return Story(Kind.PROGRAM, told, price=price, names=tuple(names))

    def scales(self) -> Iterator[Row]:
        """Yield columns in another unit or of the other sign: of the log, or as they were passed.

        At the limits one state may explain as much as all, but a program passes all in one unit.
        """
        model, guessed = self.model, {*self.model.state_names} - {*self.logged}
        for one in of_commands(model, self.trial.inputs):
            group, by = tuple(self.names[k] for k in one.columns), 1 / one.factor
            some = [Story(Kind.UNIT, price=one.price, names=group, by=by)]
            some = some if {*group} - guessed else []
            if max(one.columns) < model.n and self.fed:
                unit = unit_named((model.states[n] for n in group), by)
                how: dict[str, Any] = {"unit": unit} if unit else {"times": by}
                how |= {"states": group, "order": model.state_names}
                price = MARGIN * (1 - len(group) / model.n)
                some.append(replace(self.passed("run.passed", price, group, **how), by=by))
            if some:
                yield Row(self.policy, one.mended(self.trial), tuple(some))

    def orders(self) -> Iterator[Row]:
        """Yield wrong orders that occur: two exchanged, some of the first ones last, sorted.

        A program has positions before velocities where the model has them after, for example; a log
        has two columns in each other's place.
        """
        n, m, right = self.model.n, self.model.m, self.model.state_names
        for some in (range(n) if self.fed else (), range(n, n + m)):
            for a, b in combinations(some, 2):
                names = (self.names[a], self.names[b])
                told = found("log.exchange", *names, ran=self.own.id)
                log = Story(Kind.LOG, told, names=names, price=MARGIN)
                both = [log] if a >= n or {*names} <= {*self.logged} else []
                if a < n:
                    both.append(self.misordered([{a: b, b: a}.get(k, k) for k in range(n)]))
                run = Account("exchange", pairs=((a, b),)).mended(self.trial)
                yield Row(self.policy, run, tuple(both))
        ways = [[*range(k, n), *range(k)] for k in range(1, n)]
        ways.append(sorted(range(n), key=lambda k: right[k]))
        for order in ways if self.fed else ():
            if sum(k != at for at, k in enumerate(order)) > 2:
                run = replace(self.trial, states=self.trial.states[:, order])
                yield Row(self.policy, run, (self.misordered(order),))

    def misordered(self, order: Sequence[int]) -> Story:
        """Return the story that a program passed the states in this order."""
        right = self.model.state_names
        passed = tuple(right[k] for k in order)
        moved = [name for name, now in zip(right, passed, strict=True) if name != now]
        price = MARGIN * (1 - len(moved) / self.model.n)
        return self.passed("run.passed", price, moved, passed=passed, order=right)

    def times(self) -> Iterator[Row]:
        """Yield the policy at other times than the run's, and without its feedback."""
        unsent = np.abs(self.trial.inputs - self.policy.past).max() <= 1e-9
        for unit, factor in TIMES.items():
            if unsent or np.isfinite(factor):
                story = self.passed("run.passed", time=unit)
                yield Row(_at_times(self.policy, factor), self.trial, (story,))
        if self.fed:
            alone = replace(self.policy, gain=None, reference=None)
            yield Row(alone, self.trial, (self.passed("run.unfed"),))

    def fitted(self, known: Sequence[Row]) -> Iterator[Row]:
        """Yield columns times the factor, and states from the zero, that fit the commands best.

        A policy is linear in what it is fed: columns that are multiplied, and states that are off
        by d, change a command by the gains times what is changed. Of one state, its sensor's zero
        may differ; all may be off as a program passed them.
        """
        policy, trial, n, m = self.policy, self.trial, self.model.n, self.model.m
        free = replace(policy, low=np.full(m, -np.inf), high=np.full(m, np.inf))
        run = commanded(free, trial)
        off, T = (run.sent - run.asked[0]) / run.size, len(run.sent)
        assert policy.gain is not None
        gains = policy.gain[:T, :, :n] / run.size[:, None]
        inside, asked = (
            (u > policy.low) & (u < policy.high) for u in (run.sent, run.asked[0])
        )  # at its limits a command tells nothing
        log = [one for row in known for one in row.stories if one.kind is Kind.UNIT]

        def about(by: float) -> tuple[float, bool]:
            return round(float(np.log(abs(by))), 1), by > 0

        tried = {(one.names, about(one.by)) for one in log}
        for group in dict.fromkeys((*(one.names for one in log), tuple(self.logged))):
            some = np.isin(self.names, group)
            fed = np.einsum("tmn,tn->tm", gains, some[:n] * trial.states[:T])
            slope = some[n:] * run.sent / run.size - fed
            where = asked if some[n:].any() else inside
            size = float((slope[where] ** 2).sum())
            by = 1 - float((slope[where] * off[where]).sum()) / size if size else np.nan
            by = float(f"{by:.3g}")
            if by and np.isfinite(by) and about(by) != about(1) and (group, about(by)) not in tried:
                columns = tuple(np.flatnonzero(some).tolist())
                changed = Account("unit", columns, 1 / by).mended(trial)
                yield Row(policy, changed, (Story(Kind.UNIT, price=MARGIN, names=group, by=by),))
        inside &= asked
        rest, design = off[inside], gains[inside]
        if inside.any(axis=1).sum() < STEPS_TO_JUDGE:
            return
        each = (design * rest[:, None]).sum(axis=0) / np.maximum((design**2).sum(axis=0), 1e-300)
        for i, (name, unit) in enumerate(self.model.states.items()):
            by = float(f"{each[i]:.3g}")
            if name in self.logged and by:
                told = found("log.zero", name, ran=self.own.id, add=by, off=Quantity(abs(by), unit))
                told = told.also(size="small" if by > 0 else "large")
                told = told.also(tables=tables(self.model, [name]))
                story = Story(Kind.LOG, told, price=MARGIN, names=(name,))
                moved = replace(trial, states=trial.states + by * (np.arange(n) == i))
                yield Row(policy, moved, (story,))
        joint = np.linalg.lstsq(design, rest, rcond=1e-6)[0]
        does = np.abs(design * joint).max(axis=0) > SLIGHT * np.abs(rest).max(initial=1e-12)
        if does.sum() >= 2:
            shares = zip(self.model.states.items(), joint, does, strict=True)
            beside = [f"{name} {with_unit(figure(x, 2), u)}" for (name, u), x, is_ in shares if is_]
            story = self.passed("run.origin", MARGIN * len(beside), off=tuple(beside))
            moved = replace(trial, states=trial.states + np.where(does, joint, 0.0))
            yield Row(policy, moved, (story,))

    def smoothed(self) -> Iterator[Row]:
        """Yield the states that a first-order filter passed on, with the share that fits best.

        One filter serves all states, the velocities, or one of them.
        """
        policy, trial, names = self.policy, self.trial, self.policy.state_names
        T = min(trial.steps, policy.horizon)
        assert policy.gain is not None
        fed = np.abs(policy.gain[..., : len(names)]).max(axis=(0, 1)) > 0
        some = [name for name, is_ in zip(names, fed, strict=True) if is_]
        moving = [name for name in some if name in velocities(self.model)]
        groups = [some, moving, [n for n in some if n not in moving], *([n] for n in some)]
        smooth = filtered(trial.states, SHARES)
        for group in filter(None, dict.fromkeys(map(tuple, groups))):
            passed = np.where(np.isin(names, group), smooth, trial.states)
            asked = policy.commands(passed[:, :T], past_of(policy, trial))
            size = np.maximum(np.abs(asked).max(axis=1, keepdims=True), 1e-12)
            best = int(np.argmin((((trial.inputs[:T] - asked) / size) ** 2).mean(axis=(1, 2))))
            share = float(SHARES[best])
            lag = Quantity(share / (1 - share) * trial.dt, "s")
            story = self.passed("run.smoothed", states=group, share=share, lag=lag)
            yield Row(policy, replace(trial, states=passed[best]), (story,))

    def clipped(self) -> Iterator[Row]:
        """Yield the policy with commands that are cut inside their limits.

        A cut repeats one value to the last digit wherever the policy asks for more.
        """
        policy, cuts = self.policy, dict[str, list[float]]()
        run, ends = commanded(policy, self.trial), np.stack([policy.low, policy.high])
        cut = np.zeros(len(run.sent), bool)
        for side, sign in enumerate((-1.0, 1.0)):
            most = (sign * run.sent).max(axis=0, initial=-np.inf)
            at = sign * run.sent >= most - FINE**2 * run.size
            more = sign * run.asked[0] > most + SLIGHT * run.size
            inside = most < sign * ends[side] - SLIGHT * run.size
            often = at.sum(axis=0) >= max(STEPS_TO_JUDGE, len(cut) / STEPS_TO_JUDGE / 2)
            often &= (at & more).sum(axis=0) > NEARLY_ALL * at.sum(axis=0)
            for j in np.flatnonzero(inside & often):
                ends[side, j] = run.sent[at[:, j], j][0]
                cuts.setdefault(policy.input_names[j], []).append(float(ends[side, j]))
                cut |= at[:, j]
        # unlike what is sent before a run and after it
        held = (ends[0] > policy.low) & (ends[0] >= policy.past)
        held |= (ends[1] < policy.high) & (ends[1] <= policy.past)
        if cuts and not held.any():
            where = tuple(f"{n} = {number(v)}" for n, some in cuts.items() for v in some)
            told = found("run.clipped", *cuts, ran=self.own.id, share=float(cut.mean()), at=where)
            clipped = replace(policy, low=ends[0], high=ends[1])
            yield Row(clipped, self.trial, (Story(Kind.PROGRAM, told),))

    def held(self) -> Iterator[Row]:
        """Yield the policy that keeps its last command wherever the log has it once more.

        A policy's plan, gains and reference change from step to step, so its commands change even
        if no new states arrive: where they stay the same to the last digit, the step was not run.
        """
        policy, trial, m = self.policy, self.trial, self.model.m
        T, same = min(trial.steps, policy.horizon), np.zeros(policy.horizon, bool)
        before = np.vstack([past_of(policy, trial), trial.inputs[: T - 1]])
        same[:T] = (np.abs(trial.inputs[:T] - before) <= 1e-9).all(axis=1)
        unsent, changed = int(np.argmin(same)), np.flatnonzero(~same[:T])
        lost = float(same[:T].mean())
        if unsent > LATEST:
            story = self.passed("run.unsent", steps=unsent)
        elif len(changed) >= STEPS_TO_JUDGE and lost > PART:
            every, dt = 1e3 * policy.dt * float(np.median(np.diff(changed))), 1e3 * policy.dt
            story = self.passed("run.skipped", lost=lost, every=every, dt=dt)
        else:
            return
        shape = (policy.horizon, m, self.model.n + sum(policy.depths))
        gain = np.zeros(shape) if policy.gain is None else np.array(policy.gain)
        reference = np.zeros(shape[::2]) if policy.reference is None else np.array(policy.reference)
        gain[same], reference[same] = 0.0, 0.0
        newest = self.model.n + np.cumsum([0, *policy.depths[:-1]])  # of the past inputs
        gain[np.flatnonzero(same)[:, None], np.arange(m), newest] = 1.0
        sent = np.where(same[:, None], 0.0, policy.feedforward)
        kept = replace(policy, feedforward=sent, gain=gain, reference=reference)
        yield Row(kept, trial, (story,))

    def later(self, waits: bool) -> Iterator[Row]:
        """Yield the policy from the later step that fits the first command best.

        The program's clock ran before, if the log begins before the run; else the log begins late.
        """
        policy, most = self.policy, min(self.trial.finite_steps, self.policy.horizon)

        def left(k: int) -> float:
            run = commanded(policy.after(k), self.trial.until(min(most, policy.horizon - k)))
            return float(np.median(run.apart))

        best = min(range(max(1, policy.horizon - STEPS_TO_JUDGE + 1)), key=left)
        if not best:
            return
        late, price = policy.dt * best, MARGIN * (1 + best / policy.horizon)
        story = self.passed("run.clock", price, step=best, seconds=late)
        if not waits:
            told = found("log.begun_late", ran=self.own.id, late=Quantity(late, "s"))
            story = Story(Kind.LOG, told, price=price, rerun=True)
        yield Row(policy.after(best), self.trial, (story,), best)


def _at_times(policy: Policy, factor: float) -> Policy:
    """Return the policy as it acts if the times passed to its runner are multiplied by a factor."""
    H = policy.horizon
    with np.errstate(all="ignore"):
        times = np.arange(H) * factor
        times[np.isnan(times)] = np.inf  # 0 times inf: a clock is past the end at once
    over = times > H - 1
    step = np.minimum(np.floor(np.where(over, 0.0, times) + 0.5), H - 1).astype(int)
    sent = np.where(over[:, None], policy.past, policy.feedforward[step])
    if policy.gain is None or policy.reference is None:
        return replace(policy, feedforward=sent)
    gain = np.where(over[:, None, None], 0.0, policy.gain[step])
    if not factor:  # the runner keeps the last command of each step: none but those held before
        n = len(policy.state_names)
        off = np.repeat(policy.past, policy.depths) - policy.reference[0, n:]
        sent, gain[:, :, n:] = sent + gain[0, :, n:] @ off, 0.0
    return replace(policy, feedforward=sent, gain=gain, reference=policy.reference[step])


def unit_by_factor(model: Model, names: Sequence[str], by: float) -> str:
    """Return the unit of signals in a log that a factor converts to the model's; "" if unknown."""
    own = {**model.states, **model.inputs}
    return unit_named((own[name] for name in names), 1 / by) if names else ""


# --- whose run it is ------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Suspicion:
    """The result of comparing a trial's commands with its candidate's and others'."""

    ran: Following | None  # the comparison with its candidate
    why: Finding | None = None  # why it is not its candidate's run
    other: str = ""  # the candidate whose run it is instead, or ""
    asked: Callable[[], Sequence[Story]] = tuple  # computes `stories`, once

    @property
    def stories(self) -> Sequence[Story]:
        """What explains it better than that it is as logged."""
        return self.asked()


def suspicion(
    task: Task,
    trial: Trial,
    own: Ran,
    others: Sequence[Ran],
    logged: Sequence[str] | None = None,
    given: Callable[[Ran], Iterable[tuple[Trial, Fed | None]]] | None = None,
) -> Suspicion:
    """Check whether a trial is a run of its candidate, and if not, whose it is.

    Args:
        task: the task with latency and units.
        trial: the trial, with gaps bridged; its candidate is `own`.
        own: the candidate that it is said to have run.
        others: candidates that it may have run instead, in order of proposal.
        logged: the states that a column holds; None: all.
        given: runs if they are a candidate's, and what it may have been fed; None: the trial.
    """
    trial = trial.until(task.horizon)

    def compared(one: Ran) -> Following | None:
        some = [
            follows(one.policy, run.until(task.horizon), latest(task), fed)
            for run, fed in (given(one) if given else [(trial, None)])
        ]
        return min(filter(None, some), key=lambda fit: fit.usual, default=None)

    ran = compared(own)
    if ran is None or ran.exact or (ran.alike and ran.error < FINE):
        return Suspicion(ran)
    rivals = [(compared(one), one.id) for one in others[-OTHERS:] if one.id != own.id]
    late = given is not None and ran.alike and ran.late  # late commands belong to other steps
    alike = [
        (fit, name, evidence(ran.apart, fit.apart))
        for fit, name in rivals
        if fit and (fit.exact or (fit.alike and not late))
    ]
    if sure := [one for one in alike if one[2] > DECISIVE]:
        fit, name, nats = min(sure, key=lambda one: (one[0].error, one[1]))
        near = name if fit.exact or fit.error < max(EXACT, HALF * ran.error) else ""
        told = found("log.another", ran=own.id, other=name, nats=nats)
        usual = [max(one.usual, FINE) if np.isfinite(one.usual) else None for one in (fit, ran)]
        return Suspicion(ran, told.also(theirs=usual[0], mine=usual[1]), near)
    some = cache(partial(stories, task, own, trial, ran, logged=logged))
    if ran.alike:
        return Suspicion(ran, asked=some)
    if program := next((one for one in some() if one.kind is Kind.PROGRAM), None):
        return Suspicion(ran, program.finding, asked=some)
    moves = np.ptp(own.policy.feedforward, axis=0) > 0
    silent = moves & ~(trial.inputs != 0).any(axis=0)
    if silent.any():
        names = [n for n, is_ in zip(trial.input_names, silent, strict=True) if is_]
        return Suspicion(ran, found("log.silent", *names, ran=own.id), asked=some)
    until = Quantity(ran.until_s if ran.opens else 0.0, "s")
    rms = Quantity(ran.rms, task.model.inputs[ran.input])
    why = found("log.not_run", ran.input, ran=own.id, rms=rms, until=until)
    return Suspicion(ran, why, asked=some)
