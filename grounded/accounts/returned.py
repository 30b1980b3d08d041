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
from typing import Any

import numpy as np

from grounded.accounts.judge import contradicted
from grounded.accounts.motion import MARGIN
from grounded.accounts.sent import (
    CLEAR,
    DECISIVE,
    EXPLAINED,
    FINE,
    SAME,
    SLIGHT,
    STEPS_TO_JUDGE,
    Commanded,
    Following,
    Ran,
    apart,
    commanded,
    evidence,
    far,
    follows,
    latest,
    states_ago,
)
from grounded.accounts.signals import limits_of, span
from grounded.accounts.table import Account, of_commands, unit_named
from grounded.findings import Finding, Quantity, found
from grounded.frozen import Array
from grounded.model import Model
from grounded.places import velocities
from grounded.policy import Policy
from grounded.result import figure, number, with_unit
from grounded.task import Task
from grounded.trial import Trial

ALIKE = 3.0  # [nats] by which a story must lead where the commands are alike as logged
ROWS_IN_FULL = 12  # rows that are compared in full
OTHERS = 20  # number of latest candidates to compare with
ONE, LARGEST = 0.03, 100.0  # factors nearer to 1 are none; largest fitted factor, or its inverse
NEARLY_ALL = 0.95  # of the steps that tell two policies apart: one must be nearer in these
TIMES = {"ms": 1e3, "us": 1e6, "minutes": 1 / 60}  # units of a time that should be in seconds
ROUNDS = 12  # Gauss-Newton iterations; more than two are only needed at limits or wrapped angles
AGES = (0.0, 1.0, 2.0)  # [steps] of the states acted on that rows are first compared with
SHARES = np.arange(1, 49) / 50  # of its last value that a first-order filter keeps
COARSE = 100  # steps of a run at which a log may begin, first tried
GROSS = 10.0  # smallest factor, or its inverse, that the prediction alone tells
CUT = 0.05  # least share of the steps at a cut


class Kind(Enum):
    """What a story is about, which decides how it is told."""

    UNIT = "columns of the log times a factor"
    LOG = "another fault of the log"
    PROGRAM = "the program misused its candidate"
    ROBOT = "the robot acted otherwise than it was told"
    FELL = "the run failed before the log ends"
    CANDIDATE = "another candidate ran"
    EARLIER = "a candidate of an earlier task ran"
    UNKNOWN = "as logged, which is no run of the candidate"


@dataclass(frozen=True)
class Story:
    """One story of how the log of a candidate's run came about.

    Args:
        kind: what it is about.
        finding: what it is, and what to do about it; None for columns times a factor.
        commands: what it leaves of the commands [nats], the logarithm of their relative error.
        motion: how far the robot is from its prediction then [nats].
        price: what it costs before a log is seen [nats].
        rerun: no setting reads this log: the next run, or another log of this one, is needed.
        names: columns that have to be multiplied, or exchanged.
        by: the factor.
    """

    kind: Kind
    finding: Finding | None = None
    commands: float = 0.0
    motion: float = 0.0
    price: float = 0.0
    rerun: bool = False
    names: tuple[str, ...] = ()
    by: float = 1.0

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
    first: int = 0,
    **other: Any,
) -> Story:
    """Return a story with its score.

    Args:
        kind: what it is about.
        finding: what to tell of it.
        own: the candidate whose commands these are.
        run: the trial as it was by the story.
        error: what is left of the commands, relative to their size.
        first: step of the run with which the trial begins.
        other: further fields of `Story`.
    """
    return Story(kind, finding, float(np.log(error + FINE)), apart(own, run, first), **other)


def likeliest(some: Iterable[Story | None], as_logged: Story) -> Story:
    """Return the story that explains a log best; `as_logged` unless one leads it clearly."""
    better = [one for one in some if one and one.left < as_logged.left - MARGIN]
    return min(better, key=lambda one: one.left, default=as_logged)


@dataclass(frozen=True, eq=False)
class Row:
    """One entry of the table: what the policy was given, and what it was, before any score.

    Args:
        policy: as it acts.
        log: price of the story that the log is so [nats]; None if it is none.
        program: price of the story that the robot's program made it so [nats]; None likewise.
        names: columns that are multiplied, moved or exchanged.
        by: the factor.
        order: every column, as it is passed; () if in the right order.
        off: what is added to the states (n,).
        share: of its last value that a filter of the states `names` keeps.
        told: what a program did, or what is wrong with the log; None for columns times a factor.
        steps: of the run that were before it began.
        fitted: a number of it is fitted to the trial.
    """

    policy: Policy
    log: float | None = None
    program: float | None = None
    names: tuple[str, ...] = ()
    by: float = 1.0
    order: tuple[str, ...] = ()
    off: Array | None = None
    share: float = 0.0
    told: Finding | None = None
    of_log: Finding | None = None
    steps: int = 0
    fitted: bool = False

    def of(self, trial: Trial) -> Trial:
        """Return a trial with its columns as the policy got them."""
        states, inputs, held = trial.states, trial.inputs, trial.start_inputs
        if self.share:
            which = np.isin(trial.state_names, self.names)
            states = np.where(which, filtered(states, np.array([self.share]))[0], states)
        elif self.order:
            every = (*trial.state_names, *trial.input_names)
            at, n = [every.index(name) for name in self.order], len(trial.state_names)
            states, sent = states[:, at[:n]], [k - n for k in at[n:]]
            inputs, held = inputs[:, sent], None if held is None else held[sent]
        elif self.off is not None:
            states = states + self.off
        elif self.names:
            return multiplied(trial, self.names, self.by)
        return replace(trial, states=states, inputs=inputs, start_inputs=held)


def multiplied(trial: Trial, names: Sequence[str], factor: float) -> Trial:
    """Return a trial with some columns multiplied by a factor."""
    every = (*trial.state_names, *trial.input_names)
    columns = tuple(every.index(name) for name in names)
    return Account("unit", columns, 1 / factor).mended(trial) if columns else trial


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
    acts: bool = False,
    logged: Sequence[str] | None = None,
    waits: bool | None = None,
) -> list[Story]:
    """Return what explains a trial's commands clearly better than that they are as logged.

    Args:
        task: the task of the candidate.
        own: the candidate.
        trial: the trial, which is said to be its run.
        plain: the comparison of its commands with the policy's.
        acts: whether other commands than those held before a run are sent elsewhere in its log.
        logged: the states that a column holds; None: all.
        waits: whether its log begins before any run; None if that is unknown.

    Returns:
        The stories, the likeliest first.
    """
    if plain is None or (plain.alike and plain.error < CLEAR) or not trial.inputs.any():
        return []
    trial = trial.until(min(trial.finite_steps, task.horizon, own.policy.horizon))
    logged = task.model.state_names if logged is None else logged
    rows = rows_of(task, own, trial, acts=acts, logged=logged, waits=waits)
    some = list[Story]()
    for row in nearest(rows, trial):
        some += stories_of(row, task, own, trial, plain)
    if not some and not plain.beyond:
        some += _by_motion(task.model, own, trial, plain, logged)
    return sorted(some, key=lambda one: one.left)


def stories_of(row: Row, task: Task, own: Ran, trial: Trial, plain: Following) -> Iterator[Story]:
    """Yield the stories of a row that explain a trial clearly better than as logged.

    Args:
        row: of the table.
        task: the task of the candidate.
        own: the candidate.
        trial: the trial, not longer than its run.
        plain: the comparison of its commands with the policy's.
    """
    run = row.of(trial)
    fit = follows(row.policy, run, latest(task))
    if fit is None:
        return
    plain = replace(plain, off=plain.off[: len(fit.off)])
    before, motion, first = _left(plain), apart(own, trial, row.steps), row.steps
    unit = row.of_log is None and not row.fitted  # a known one, or a sign
    least = ALIKE if plain.alike else MARGIN

    def gained(left: float, price: float) -> bool:
        return bool(np.log((before + FINE) / (left + FINE)) >= price)

    left, tells = _left(fit), _tells(plain, fit)
    same: dict[str, Any] = {"names": row.names, "by": row.by}
    if row.log is not None and fit.alike and (tells or unit) and fit.error < EXPLAINED:
        price = row.log + (MARGIN if unit else least)
        if gained(left, price) and apart(own, run, first) <= motion:
            kind = Kind.UNIT if row.of_log is None else Kind.LOG
            yield scored(
                kind, row.of_log, own, run, left, first, price=row.log, rerun=row.steps > 0, **same
            )
    if row.program is None or plain.beyond:
        return
    share = _moved(own, trial, fit)
    known = fit.alike and tells and fit.error < EXPLAINED * share
    if known and gained(left / share, row.program + least):
        yield scored(
            Kind.PROGRAM, row.told, own, trial, left / share, first, price=row.program, **same
        )


def _left(ran: Following) -> float:
    """Return the rms difference of the commands from the policy's, in units of their size."""
    return float(np.sqrt(np.nanmean((ran.off / ran.fine) ** 2))) * FINE


def _moved(own: Ran, trial: Trial, fit: Following) -> float:
    """Return how far the commands that moved most did, relative to their size, at most 1.

    What a program sends that hardly moves is near to any commands that hardly move.
    """
    most = np.abs(trial.inputs - own.policy.past).max(axis=0) * FINE / fit.fine
    return float(np.clip(most.max(), FINE, 1.0))


def _tells(plain: Following, fit: Following) -> bool:
    """Return whether a policy explains nearly all commands in which it differs from the plain one.

    Many policies hold an input at the same limit: such commands are no evidence for one of them.
    """
    size, T = fit.fine / FINE, min(len(plain.off), len(fit.off))
    with np.errstate(invalid="ignore"):
        told = np.abs(plain.off[:T] - fit.off[:T]) > EXPLAINED * size
        nearer = np.abs(fit.off[:T]) < np.abs(plain.off[:T]) / 2
    return bool(told.any() and nearer[told].mean() >= NEARLY_ALL)


def _by_motion(
    model: Model, own: Ran, trial: Trial, plain: Following, logged: Sequence[str]
) -> Iterator[Story]:
    """Yield the states in another unit or of the other sign that commands don't tell, at most one.

    A policy that hardly uses a speed sends the same commands whatever its unit. The run must be
    near its prediction in most other states, and with the column put right in this one, too. A real
    motion may be opposite to a small predicted one: a sign must also be wrong by the model.
    """
    as_it_is, before, best = far(own, trial), apart(own, trial), list[Story]()
    known, every = np.isfinite(as_it_is), (*model.state_names, *model.input_names)
    for account in of_commands(model) if plain.alike else ():
        names, by = tuple(every[k] for k in account.columns), 1 / account.factor
        which = [i for i in account.columns if i < model.n and known[i]]
        rest = [i for i in np.flatnonzero(known) if i not in which]
        gross = by == -1 or not 1 / GROSS < abs(by) < GROSS
        if not which or not rest or not gross or not {*names} <= {*logged}:
            continue
        run = multiplied(trial, names, by)
        nearer = before - apart(own, run) > 2 * MARGIN and far(own, run)[which].max() < 1
        if not nearer or np.median(as_it_is[rest]) > MARGIN:
            continue
        fault = Account("sign", tuple(which), -1.0)
        if by == -1 and not contradicted(model, run, range(model.n), fault):
            continue
        best.append(scored(Kind.UNIT, None, own, run, _left(plain), names=names, by=by))
    yield from sorted(best, key=lambda one: one.left)[:1]


def nearest(rows: Sequence[Row], trial: Trial) -> list[Row]:
    """Return the rows that explain the commands best, each policy's compared at once."""
    score, groups = dict[int, float](), dict[int, list[int]]()
    for k, row in enumerate(rows):
        groups.setdefault(id(row.policy), []).append(k)
    for some in groups.values():
        policy, runs = rows[some[0]].policy, [rows[k].of(trial) for k in some]
        T, past = min(trial.steps, policy.horizon), runs[0].start_inputs
        states = np.stack([run.states[:T] for run in runs])
        sent = np.clip(np.stack([run.inputs[:T] for run in runs]), policy.low, policy.high)
        left = np.full(len(some), np.inf)
        for age in AGES if policy.gain is not None else AGES[:1]:
            aged = np.stack([states_ago(x, age, policy.angles) for x in states])
            asked = policy.commands(aged, policy.past if past is None else past)
            size = np.maximum(np.abs(asked).max(axis=1), np.abs(sent).max(axis=1)) + 1e-12
            for late in (0, 1):
                a, b = asked[:, : T - late], sent[:, late:]
                square = (((a - b) / size[:, None]) ** 2).mean(axis=2)
                left = np.minimum(left, np.sqrt(np.median(square, axis=1) + 1e-3 * square.mean(1)))
        for k, error in zip(some, left, strict=True):
            score[k] = float(np.log(error + FINE)) + min(
                one for one in (rows[k].log, rows[k].program) if one is not None
            )
    return [rows[k] for k in sorted(score, key=lambda k: score[k])[:ROWS_IN_FULL]]


# --- the table ------------------------------------------------------------------------------------


def rows_of(
    task: Task,
    own: Ran,
    trial: Trial,
    *,
    acts: bool,
    logged: Sequence[str],
    waits: bool | None,
) -> list[Row]:
    """Return the table: rows that hold for any trial, and those with a number that is fitted.

    Args:
        task: the task of the candidate.
        own: the candidate.
        trial: the trial, not longer than its run.
        acts: whether other commands than those held before a run are sent elsewhere in its log.
        logged: the states that a column holds.
        waits: whether its log begins before any run; None if that is unknown.
    """
    model, held = task.model, np.abs(trial.inputs - own.policy.past).max(axis=1) <= 1e-9
    scales = [*_scales(task, own, trial.inputs, logged)]
    return [
        *scales,
        *_orders(model, own, logged),
        *_times(own, unsent=bool(held[0]), over=bool(held.all()) and not acts),
        *_fitted_scales(own.policy, trial, scales, [n for n in model.state_names if n in logged]),
        *_origins(model, own, trial, logged),
        *_smoothed(model, own, trial),
        *_clipped(own, trial),
        *(_later(own, trial, waits) if waits is not None else ()),
    ]


def _scales(task: Task, own: Ran, inputs: Array, logged: Sequence[str]) -> Iterator[Row]:
    """Yield columns in another unit or of the other sign: of the log, or as a program passed them.

    At the limits one state may explain as much as all, but a program passes all in one unit.
    """
    model, fed = task.model, own.policy.gain is not None
    names, guessed = (*model.state_names, *model.input_names), {*model.state_names} - {*logged}
    for one in (*full_scales(task, inputs), *of_commands(model, inputs)):
        group, by = tuple(names[k] for k in one.columns), 1 / one.factor
        passed = max(one.columns) < model.n and fed
        unit = unit_named((model.states[n] for n in group), by) if passed else ""
        how: dict[str, Any] = {"unit": unit} if unit else {"times": by}
        told = found("run.passed", ran=own.id, states=group, order=model.state_names, **how)
        yield Row(
            own.policy,
            log=one.price if {*group} - guessed else None,
            program=MARGIN * (1 - len(group) / model.n) if passed else None,
            names=group,
            by=by,
            told=told,
        )


def full_scales(task: Task, inputs: Array) -> Iterator[Account]:
    """Yield that inputs beyond their limits are in percent or thousandths of the larger one.

    Args:
        task: with the limits.
        inputs: the commands (T, m) of a log.
    """
    for j, unit in enumerate(task.model.inputs.values()):
        full = float(max(abs(task.low[j]), abs(task.high[j])))
        most = np.nanmax(np.abs(inputs[:, j]), initial=0.0)
        if np.isfinite(full) and most > full and not (full == 1 and unit == "1"):
            for parts in (1e2, 1e3):
                yield Account("unit", (task.model.n + j,), parts / full)


def unit_by_factor(model: Model, names: Sequence[str], by: float) -> str:
    """Return the unit of signals in a log that a factor converts to the model's; "" if unknown."""
    own = {**model.states, **model.inputs}
    return unit_named((own[name] for name in names), 1 / by) if names else ""


def of_full_scale(task: Task, names: Sequence[str], by: float) -> str:
    """Return `percent of 10 N` if a factor converts an input from that; "" otherwise."""
    if len(names) != 1 or names[0] not in task.model.inputs:
        return ""
    j = task.model.input_names.index(names[0])
    full = float(max(abs(task.low[j]), abs(task.high[j])))
    parts = {"percent": 1e-2, "thousandths": 1e-3}
    part = next((name for name, one in parts.items() if np.isclose(by, full * one)), "")
    return part and f"{part} of {with_unit(f'{full:g}', task.model.inputs[names[0]])}"


def _orders(model: Model, own: Ran, logged: Sequence[str]) -> Iterator[Row]:
    """Yield wrong orders that occur: two exchanged, some of the first ones last, sorted.

    A program has positions before velocities where the model has them after, for example; a log has
    two columns in each other's place.
    """
    right, sent = model.state_names, model.input_names
    for some in (right if own.policy.gain is not None else (), sent):
        pairs = combinations(some, 2)
        orders: dict[tuple[str, ...], tuple[str, ...]] = {
            tuple({a: b, b: a}.get(n, n) for n in some): (a, b) for a, b in pairs
        }
        if some is right:
            turned = [right[k:] + right[:k] for k in range(1, len(right))]
            orders |= {one: () for one in (*turned, tuple(sorted(right))) if one not in orders}
        for order, pair in orders.items():
            if order == some:
                continue
            moved = tuple(was for was, now in zip(some, order, strict=True) if was != now)
            log = found("log.exchange", *pair, ran=own.id) if pair else None
            yield Row(
                own.policy,
                log=MARGIN if pair and (some is sent or {*pair} <= {*logged}) else None,
                program=MARGIN * (1 - len(moved) / model.n) if some is right else None,
                names=moved,
                order=(*order, *sent) if some is right else (*right, *order),
                told=found("run.passed", ran=own.id, passed=order, order=right),
                of_log=log,
            )


def _times(own: Ran, *, unsent: bool, over: bool) -> Iterator[Row]:
    """Yield the policy at other times than the run's, and without its feedback.

    Args:
        own: the candidate.
        unsent: whether the first command is the one held before the run, so that none was sent.
        over: whether all are.
    """
    policy, ran = own.policy, own.id
    for unit, factor in TIMES.items():
        if factor < 1 or not unsent:
            told = found("run.passed", ran=ran, time=unit)
            yield Row(_at_times(policy, factor), program=MARGIN, told=told)
    if over:
        told = found("run.passed", ran=ran, time="a clock")
        yield Row(_at_times(policy, np.inf), program=MARGIN, told=told)
    told = found("run.passed", ran=ran, time="no unit: it stays 0")
    yield Row(_at_times(policy, 0.0), program=MARGIN, told=told)
    if policy.gain is not None:
        told = found("run.unfed", ran=ran)
        yield Row(replace(policy, gain=None, reference=None), program=MARGIN, told=told)


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


def _fitted_scales(
    policy: Policy, trial: Trial, known: Sequence[Row], states: Sequence[str]
) -> Iterator[Row]:
    """Yield each group of columns times the factor, unlike the known ones, that fits best."""
    tried = {(row.names, round(float(np.log(abs(row.by))), 2), row.by > 0) for row in known}
    groups = [row.names for row in known if row.log is not None]
    groups = list(dict.fromkeys((*groups, tuple(states))))
    columns = np.array([[name in some for name in trial.state_names] for some in groups])[:, None]
    sent = np.array([[name in some for name in trial.input_names] for some in groups])[:, None]

    def off(which: Array, by: Array) -> Array:
        factor = by[:, None, None]
        scaled = trial.states * np.where(columns[which], factor, 1.0)
        return _off(policy, trial, scaled, trial.inputs * np.where(sent[which], factor, 1.0))

    for start in (1.0, -1.0):
        each = _solved(off, np.full(len(groups), start), 1e-4 * start)
        for group, by in zip(groups, each, strict=True):
            if not 1 / LARGEST < abs(by) < LARGEST or abs(by - 1) < ONE:
                continue
            by = -1.0 if abs(by + 1) < ONE else float(f"{by:.3g}")
            if (group, round(float(np.log(abs(by))), 2), by > 0) not in tried:
                yield Row(policy, log=MARGIN, names=group, by=by, fitted=True)


def _solved(off: Callable[[Array, Array], Array], start: Array, small: float) -> list[float]:
    """Minimise the residuals of B problems, over one number each, by Gauss-Newton.

    Args:
        off: returns the residuals (B, T, m) of the problems with given indices, at given numbers.
        start: (B,) where to start.
        small: the step of the finite differences.

    Returns:
        The numbers; NaN where the residuals don't depend on it.
    """
    by, left = np.array(start), np.arange(len(start))
    for _ in range(ROUNDS):
        if not len(left):
            break
        both = off(np.tile(left, 2), np.concatenate([by[left], by[left] + small]))
        here = both[: len(left)]
        slope = (both[len(left) :] - here) / small
        size = (slope**2).sum(axis=(1, 2))
        step = -(slope * here).sum(axis=(1, 2)) / np.where(size > 0, size, np.nan)
        by[left] += step
        left = left[np.isfinite(by[left]) & ~(np.abs(step) < 1e-6 * np.abs(by[left]))]
    return [float(one) for one in by]


def _off(policy: Policy, trial: Trial, states: Array, inputs: Array) -> Array:
    """Return the logged commands minus the policy's, in units of the largest, (B, T, m).

    Args:
        policy: the policy.
        trial: the trial, for the inputs held before it.
        states: (B, T, n) its states, as they are assumed to have been.
        inputs: (B or 1, T, m) its inputs likewise.
    """
    past = policy.past if trial.start_inputs is None else trial.start_inputs
    asked = policy.commands(states[:, : trial.steps], past)
    off: Array = (np.clip(inputs, policy.low, policy.high) - asked) / np.maximum(
        np.abs(asked).max(axis=1, keepdims=True), 1e-12
    )
    return off


def _origins(model: Model, own: Ran, trial: Trial, logged: Sequence[str]) -> Iterator[Row]:
    """Yield each state from another zero in the log, and all of them as a program passed them.

    States that are off by d change a command by the gains times d; of one state, its sensor's zero
    may differ.
    """
    policy, names = own.policy, model.state_names
    if policy.gain is None:
        return
    run = commanded(policy, trial)
    free = (run.sent > policy.low) & (run.sent < policy.high)
    free &= (run.asked > policy.low) & (run.asked < policy.high)
    if free.any(axis=1).sum() < STEPS_TO_JUDGE:
        return
    off = ((run.sent - run.asked) / run.size)[free]
    gains = (policy.gain[: len(free), :, : model.n] / run.size[:, None])[free]
    size = (gains**2).sum(axis=0)
    each = gains.T @ off / np.where(size > 0, size, np.inf)
    for i, name in enumerate(names):
        by = float(f"{each[i]:.3g}")
        if name in logged and by:
            told = found("log.zero", name, ran=own.id, size="small" if by > 0 else "large", add=by)
            told = told.also(off=Quantity(abs(by), model.states[name]))
            told = told.also(tables=(f"[log.state.{name}]",))
            moved = by * (np.arange(model.n) == i)
            yield Row(policy, log=MARGIN, names=(name,), off=moved, of_log=told, told=told)
    joint = np.linalg.lstsq(gains, off, rcond=1e-6)[0]
    does = np.abs(gains * joint).max(axis=0) > SLIGHT * np.abs(off).max(initial=1e-12)
    if does.sum() >= 2:
        shares = zip(model.states.items(), joint, does, strict=True)
        beside = tuple(f"{n} {with_unit(figure(x, 2), u)}" for (n, u), x, is_ in shares if is_)
        told = found("run.origin", ran=own.id, off=beside)
        yield Row(
            policy, program=MARGIN * int(does.sum()), off=np.where(does, joint, 0.0), told=told
        )


def _smoothed(model: Model, own: Ran, trial: Trial) -> Iterator[Row]:
    """Yield the states that a first-order filter passed on, with the share that fits best.

    One filter serves all states, the velocities, or one of them.
    """
    policy, names = own.policy, own.policy.state_names
    if policy.gain is None:
        return
    T, rates = min(trial.steps, policy.horizon), velocities(model)
    fed = np.abs(policy.gain[..., : len(names)]).max(axis=(0, 1)) > 0
    some = [name for name, is_ in zip(names, fed, strict=True) if is_]
    moving = [name for name in some if name in rates]
    groups = [some, moving, [n for n in some if n not in moving], *([n] for n in some)]
    smooth = filtered(trial.states[:T], SHARES)
    for group in filter(None, dict.fromkeys(map(tuple, groups))):
        passed = np.where(np.isin(names, group), smooth, trial.states[:T])
        left = (_off(policy, trial.until(T), passed, trial.inputs[None, :T]) ** 2).mean(axis=(1, 2))
        share = float(SHARES[int(np.argmin(left))])
        lag = Quantity(share / (1 - share) * trial.dt, "s")
        told = found("run.smoothed", ran=own.id, states=group, share=share, lag=lag)
        yield Row(policy, program=MARGIN, names=group, share=share, told=told)


def _clipped(own: Ran, trial: Trial) -> Iterator[Row]:
    """Yield the policy with commands that are cut inside their limits.

    A cut repeats one value to the last digit wherever the policy asks for more, and nowhere else.
    """
    policy, cuts, cut = own.policy, dict[str, list[float]](), np.zeros(trial.steps, bool)
    run, low, high = commanded(policy, trial), policy.low.copy(), policy.high.copy()
    for j, name in enumerate(policy.input_names):
        for sign, limits in ((-1, low), (1, high)):
            at = _cut(policy, run, j, sign)
            if at is not None:
                limits[j] = run.sent[at, j][0]
                cuts.setdefault(name, []).append(float(limits[j]))
                cut[: len(at)] |= at
    # unlike what is sent before a run and after it
    held = ((low > policy.low) & (low >= policy.past)) | (
        (high < policy.high) & (high <= policy.past)
    )
    if cuts and not held.any():
        at = tuple(f"{n} = {number(v)}" for n, ends in cuts.items() for v in ends)
        told = found("run.clipped", *cuts, ran=own.id, share=float(cut.mean()), at=at)
        yield Row(replace(policy, low=low, high=high), program=0.0, told=told)


def _cut(policy: Policy, run: Commanded, j: int, sign: float) -> Any:
    """Return the steps (T,) at which an input was cut at its largest or smallest value; or None."""
    u, wanted, size = sign * run.sent[:, j], sign * run.asked[:, j], float(run.size[j])
    end = float(u.max(initial=-np.inf))
    limit = float(policy.high[j] if sign > 0 else -policy.low[j])
    at, more = u >= end - FINE**2 * size, wanted > end + SLIGHT * size
    enough = at.sum() >= max(STEPS_TO_JUDGE, CUT * len(u)) and end < limit - SLIGHT * size
    both = float((at & more).sum())
    return at if enough and both >= 0.8 * max(at.sum(), more.sum()) else None


def _later(own: Ran, trial: Trial, waits: bool) -> Iterator[Row]:
    """Yield the policy from the later step that fits the first command best.

    The program's clock ran before, if the log begins before the run; else the log begins late.
    """
    policy, most = own.policy, min(trial.finite_steps, own.policy.horizon)

    def left(k: int) -> float:
        T = min(most, policy.horizon - k)
        if T < STEPS_TO_JUDGE:
            return np.inf
        run = commanded(policy.after(k), trial.until(T))
        return float(np.median((((run.asked - run.sent) / run.size) ** 2).mean(axis=1)))

    stride = max(1, policy.horizon // COARSE)
    best = min(range(0, policy.horizon, stride), key=left)
    best = min(range(max(0, best - stride), best + stride + 1), key=left)
    if not best:
        return
    late, price = policy.dt * best, MARGIN * (1 + best / policy.horizon)
    clock = found("run.clock", ran=own.id, step=best, seconds=late)
    begun = found("log.begun_late", ran=own.id, late=Quantity(late, "s"))
    yield Row(
        policy.after(best),
        log=None if waits else price,
        program=price if waits else None,
        told=clock,
        of_log=begun,
        steps=best,
    )


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
) -> Suspicion:
    """Check whether a trial is a run of its candidate, and if not, whose it is.

    Args:
        task: the task with latency and units.
        trial: the trial, with gaps bridged; its candidate is `own`.
        own: the candidate that it is said to have run.
        others: candidates that it may have run instead, in order of proposal.
        logged: the states that a column holds; None: all.
    """
    trial, late = trial.until(task.horizon), latest(task)
    ran = follows(own.policy, trial, late)
    if ran is None or (ran.alike and ran.error < 1e-5):
        return Suspicion(ran)
    rivals = [(follows(c.policy, trial, late), c.id) for c in others[-OTHERS:] if c.id != own.id]
    alike = [(f.error, n, evidence(ran.apart, f.apart)) for f, n in rivals if f and f.alike]
    if sure := [one for one in alike if one[2] > DECISIVE]:
        left, name, nats = min(sure)
        near = name if left < max(CLEAR, SAME * ran.error) else ""
        return Suspicion(ran, found("log.another", ran=own.id, other=name, nats=nats), near)
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
    units, facts = task.model.inputs, dict[str, Any]()
    if ran.beyond:
        j = trial.input_names.index(ran.beyond)
        facts = {"beyond": ran.beyond, "logged": span(trial.inputs[:, j])}
        facts["limits"] = limits_of(task, j)
    until = Quantity(ran.until_s if ran.opens else 0.0, "s")
    rms = Quantity(ran.rms, units[ran.input])
    why = found("log.not_run", ran.input, ran=own.id, rms=rms, until=until, **facts)
    return Suspicion(ran, why, asked=some)
