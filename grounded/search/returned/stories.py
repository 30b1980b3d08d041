"""START HERE: tell how a run's commands came about that are not its policy's on the logged states.

Every story is a row: what it makes of the log's columns (an account of `grounded.accounts.table`,
an offset, any factor), or of the policy by a program that passed it the wrong things (states in
another unit or order, a time in ms, none at all). All rows are scored by the same terms, in nats:
what is left of the commands, given the policy and what it was fed; how far the robot is then from
its prediction; and a price. A log that is read otherwise must be nearer to its prediction; a
program's run need not be. So where the fault lies follows from the terms.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import combinations
from typing import Any

import numpy as np

from grounded.accounts.table import Account, of_commands, unit_named
from grounded.findings import Finding, Quantity, found
from grounded.frozen import Array
from grounded.model import Model
from grounded.policy import Policy
from grounded.result import with_unit
from grounded.search.candidate import Candidate
from grounded.search.returned.as_predicted import apart, multiplied
from grounded.search.returned.who_drove import (
    CLEAR,
    DECISIVE,
    EXPLAINED,
    FINE,
    Following,
    evidence,
    follows,
    latest,
    states_ago,
)
from grounded.task import Task
from grounded.trial import Trial

LEADS = 0.7  # [nats] by which a story must lead as logged, and that a number costs that is no unit
ALIKE = 3.0  # [nats] where the commands are alike as logged
MANY = 12  # rows that are compared in full
ONE, LARGEST = 0.03, 100.0  # factors nearer to 1 are none; largest factor, or its inverse
NEARLY_ALL = 0.95  # of the steps that tell two policies apart: one must be nearer in these
TIMES = {"ms": 1e3, "us": 1e6, "minutes": 1 / 60}  # units of a time that should be in seconds
ROUNDS = 12  # Gauss-Newton iterations; more than two are only needed at limits or wrapped angles
AGES = (0.0, 1.0, 2.0)  # [steps] of the states acted on that rows are first compared with


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
        names: columns that have to be multiplied.
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
    kind: Kind, finding: Finding | None, own: Candidate, run: Trial, error: float, **other: Any
) -> Story:
    """Return a story with its score.

    Args:
        kind: what it is about.
        finding: what to tell of it.
        own: the candidate whose commands these are.
        run: the trial as it was by the story.
        error: what is left of the commands, relative to their size.
        other: further fields of `Story`.
    """
    return Story(kind, finding, float(np.log(error + FINE)), apart(own, run), **other)


@dataclass(frozen=True, eq=False)
class Row:
    """What a story makes of a trial and of the policy, before any score.

    Args:
        kind: UNIT, LOG or PROGRAM.
        run: the trial as its policy would have seen it.
        policy: as it acts on that.
        finding: what is told; None for columns times a factor.
        price: before a log is seen [nats].
        names: columns that are multiplied.
        by: the factor.
    """

    kind: Kind
    run: Trial
    policy: Policy
    finding: Finding | None = None
    price: float = 0.0
    names: tuple[str, ...] = ()
    by: float = 1.0


def stories(
    task: Task,
    own: Candidate,
    trial: Trial,
    plain: Following | None,
    *,
    acts: bool = False,
    logged: Sequence[str] | None = None,
) -> list[Story]:
    """Return what explains a trial's commands clearly better than that they are as logged.

    Args:
        task: the task of the candidate.
        own: the candidate.
        trial: the trial, which is said to be its run.
        plain: the comparison of its commands with the policy's.
        acts: whether other commands than those held before a run are sent elsewhere in its log.
        logged: the states that a column holds; None: all.

    Returns:
        The stories, the likeliest first.
    """
    if plain is None or (plain.alike and plain.error < CLEAR) or not trial.inputs.any():
        return []
    trial = trial.until(min(trial.finite_steps, task.horizon, own.policy.horizon))
    logged = task.model.state_names if logged is None else logged
    rows = [*_of_log(task, own, trial, logged)]
    if not plain.alike and not plain.beyond:
        rows += _of_program(task, own, trial, acts=acts)
    before, late, some = _left(plain), latest(task), list[Story]()
    for row in _nearest(rows):
        fit = follows(row.policy, row.run, late)
        if fit is None:
            continue
        program = row.kind is Kind.PROGRAM
        share = _moved(own, trial, fit) if program else 1.0
        if not fit.alike or fit.error >= EXPLAINED * share:
            continue
        left = _left(fit) / share
        gained = np.log((before + FINE) / (left + FINE))
        unit = row.kind is Kind.UNIT and not row.price
        if gained < (ALIKE if plain.alike and not unit else LEADS) + row.price:
            continue
        if not unit and not evidence(plain, fit) > DECISIVE:
            continue
        if program and not _tells(plain, fit):
            continue
        seen = trial if program else row.run
        some.append(
            scored(
                row.kind,
                _without_feedback(own, trial, fit, row) if program else row.finding,
                own,
                seen,
                left,
                price=row.price,
                names=row.names,
                by=row.by,
            )
        )
    return sorted(some, key=lambda one: one.left)


def _left(ran: Following) -> float:
    """Return the rms difference of the commands from the policy's, in units of their size."""
    return float(np.sqrt(np.nanmean((ran.off / ran.fine) ** 2))) * FINE


def _moved(own: Candidate, trial: Trial, fit: Following) -> float:
    """Return how far the commands that moved most did, relative to their size, at most 1.

    What a program sends that hardly moves is near to any commands that hardly move.
    """
    far = np.abs(trial.inputs - own.policy.past).max(axis=0) * FINE / fit.fine
    return float(np.clip(far.max(), FINE, 1.0))


def _nearest(rows: Sequence[Row]) -> list[Row]:
    """Return the rows that explain the commands best, each policy's compared at once."""
    score = dict[int, float]()
    groups = dict[int, list[int]]()
    for k, row in enumerate(rows):
        groups.setdefault(id(row.policy), []).append(k)
    for some in groups.values():
        policy, runs = rows[some[0]].policy, [rows[k].run for k in some]
        T, past = len(runs[0].inputs), runs[0].start_inputs
        states = np.stack([run.states[:T] for run in runs])
        sent = np.clip(np.stack([run.inputs for run in runs]), policy.low, policy.high)
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
            score[k] = float(np.log(error + FINE)) + rows[k].price
    return [rows[k] for k in sorted(score, key=lambda k: score[k])[:MANY]]


# --- the log ------------------------------------------------------------------------------------


def _of_log(task: Task, own: Candidate, trial: Trial, logged: Sequence[str]) -> Iterator[Row]:
    """Yield the columns that may be in another unit, of another sign or off, as read otherwise."""
    model, policy, far = task.model, own.policy, apart(own, trial)
    names = (*model.state_names, *model.input_names)
    guessed = {*model.state_names} - {*logged}
    tried = [
        (tuple(names[k] for k in one.columns), 1 / one.factor, 0.0)
        for one in (*full_scales(task, trial.inputs), *of_commands(model, trial.inputs))
    ]
    known = {(group, round(float(np.log(abs(by))), 2), by > 0) for group, by, _ in tried}
    groups = list(dict.fromkeys((*(group for group, *_ in tried), model.state_names)))
    for start in (1.0, -1.0):
        for group, by in zip(groups, _factors(policy, trial, groups, start), strict=True):
            if not 1 / LARGEST < abs(by) < LARGEST or abs(by - 1) < ONE:
                continue
            by = -1.0 if abs(by + 1) < ONE else float(f"{by:.3g}")
            if (group, round(float(np.log(abs(by))), 2), by > 0) not in known:
                tried.append((group, by, LEADS))
    for group, by, price in tried:
        if guessed & {*group}:
            continue
        run = multiplied(trial, group, by)
        if apart(own, run) <= far:
            yield Row(Kind.UNIT, run, policy, None, price, group, by)
    states = [name for name in model.state_names if name in logged]
    for name, off in zip(states, _offsets(policy, trial, states), strict=True):
        if not np.isfinite(off) or not off:
            continue
        off = float(f"{off:.3g}")
        moved = np.where(np.isin(trial.state_names, name), trial.states - off, trial.states)
        run = replace(trial, states=moved)
        if apart(own, run) <= far:
            size = "large" if off > 0 else "small"
            told = found("log.zero", name, ran=own.id, size=size)
            told = told.also(off=Quantity(abs(off), model.states[name]), add=-off)
            yield Row(
                Kind.LOG, run, policy, told.also(tables=(f"[log.state.{name}]",)), LEADS, (name,)
            )


def unit_by_factor(model: Model, names: Sequence[str], by: float) -> str:
    """Return the unit of signals in a log that a factor converts to the model's; "" if unknown."""
    own = {**model.states, **model.inputs}
    return unit_named((own[name] for name in names), 1 / by) if names else ""


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


def of_full_scale(task: Task, names: Sequence[str], by: float) -> str:
    """Return `percent of 10 N` if a factor converts an input from that; "" otherwise."""
    if len(names) != 1 or names[0] not in task.model.inputs:
        return ""
    j = task.model.input_names.index(names[0])
    full = float(max(abs(task.low[j]), abs(task.high[j])))
    parts = {"percent": 1e-2, "thousandths": 1e-3}
    part = next((name for name, one in parts.items() if np.isclose(by, full * one)), "")
    return part and f"{part} of {with_unit(f'{full:g}', task.model.inputs[names[0]])}"


def _factors(
    policy: Policy, trial: Trial, groups: Sequence[Sequence[str]], start: float
) -> list[float]:
    """Return for each group of columns the factor with which the policy sends the commands best."""
    states, inputs = (
        np.array([[name in names for name in every] for names in groups])[:, None]
        for every in (trial.state_names, trial.input_names)
    )

    def off(which: Array, by: Array) -> Array:
        factor = by[:, None, None]
        scaled = trial.states * np.where(states[which], factor, 1.0)
        return _off(policy, trial, scaled, trial.inputs * np.where(inputs[which], factor, 1.0))

    return _solved(off, np.full(len(groups), start), 1e-4 * start)


def _offsets(policy: Policy, trial: Trial, names: Sequence[str]) -> list[float]:
    """Return for each state the offset without which the policy sends the commands best."""
    columns = np.array([[name == one for one in trial.state_names] for name in names])

    def off(which: Array, by: Array) -> Array:
        shifted = trial.states - by[:, None, None] * columns[which][:, None]
        return _off(policy, trial, shifted, trial.inputs[None])

    return _solved(off, np.zeros(len(names)), 1e-4) if names else []


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


# --- the program --------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Way:
    """One way in which a program may misuse a candidate."""

    policy: Policy  # as it acts on what the program passes
    finding: Finding
    names: tuple[str, ...] = ()  # states that are passed multiplied, or in another's place
    factor: float = 1.0
    order: tuple[str, ...] = ()  # all states, as they are passed; () if in the right order

    def passed(self, trial: Trial) -> Trial:
        """Return a trial with its states as the program passed them."""
        if not self.order:
            return multiplied(trial, self.names, self.factor)
        order = [trial.state_names.index(name) for name in self.order]
        return replace(trial, states=trial.states[:, order])


def _of_program(task: Task, own: Candidate, trial: Trial, *, acts: bool) -> Iterator[Row]:
    """Yield the trial as a program passed it to its candidate, which is not as it is logged."""
    held = np.abs(trial.inputs - own.policy.past).max(axis=1) <= 1e-9
    over = bool(held.all()) and not acts
    for way in ways(task.model, own, unsent=bool(held[0]), over=over):
        # at the limits one state may explain as much as all, but a program passes all in one unit
        price = LEADS * (1 - len(way.names) / task.model.n)
        yield Row(
            Kind.PROGRAM, way.passed(trial), way.policy, way.finding, price, way.names, way.factor
        )


def ways(model: Model, own: Candidate, *, unsent: bool, over: bool = False) -> Iterator[Way]:
    """Yield the ways in which a program may have misused its candidate.

    Args:
        model: the model with the units of the states.
        own: the candidate.
        unsent: whether the first command is the one held before the run, so that none was sent.
        over: whether all are.
    """
    policy, right, ran = own.policy, model.state_names, own.id
    for unit, factor in TIMES.items():
        if factor < 1 or not unsent:
            yield Way(_at_times(policy, factor), found("run.passed", ran=ran, time=unit))
    if over:
        yield Way(_at_times(policy, np.inf), found("run.passed", ran=ran, time="a clock"))
    yield Way(_at_times(policy, 0.0), found("run.passed", ran=ran, time="no unit: it stays 0"))
    if policy.gain is None:
        return
    yield Way(replace(policy, gain=None, reference=None), found("run.unfed", ran=ran))
    for account in of_commands(model):
        if max(account.columns) < model.n:
            group, factor = tuple(right[k] for k in account.columns), 1 / account.factor
            unit = unit_named((model.states[one] for one in group), factor)
            how: dict[str, Any] = {"unit": unit} if unit else {"times": factor}
            passed = found("run.passed", ran=ran, states=group, order=right, **how)
            yield Way(policy, passed, group, factor)
    for order in _orders(right):
        moved = tuple(was for was, now in zip(right, order, strict=True) if was != now)
        passed = found("run.passed", ran=ran, passed=order, order=right)
        yield Way(policy, passed, moved, order=order)


def _orders(right: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    """Yield wrong orders of states that occur: two exchanged, some of the first ones last, sorted.

    A program has positions before velocities where the model has them after, for example.
    """
    pairs = combinations(range(len(right)), 2)
    orders = [tuple({i: j, j: i}.get(k, k) for k in range(len(right))) for i, j in pairs]
    named = [tuple(right[k] for k in order) for order in orders]
    named += [right[k:] + right[:k] for k in range(1, len(right))]
    yield from (one for one in dict.fromkeys((*named, tuple(sorted(right)))) if one != right)


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


def _tells(plain: Following, fit: Following) -> bool:
    """Return whether a policy explains nearly all commands in which it differs from the plain one.

    Many policies hold an input at the same limit: such commands are no evidence for one of them.
    """
    size = fit.fine / FINE
    with np.errstate(invalid="ignore"):
        told = np.abs(plain.off - fit.off) > EXPLAINED * size
        nearer = np.abs(fit.off) < np.abs(plain.off) / 2
    return bool(told.any() and nearer[told].mean() >= NEARLY_ALL)


def _without_feedback(own: Candidate, trial: Trial, fit: Following, row: Row) -> Finding | None:
    """Return the finding of a row; of a policy without feedback, whether other states were fed.

    Commands without feedback depend on time alone, which may be off by one step.
    """
    if row.policy.gain is not None or own.policy.gain is None:
        return row.finding
    asked = trial.inputs[: len(fit.off)] - fit.off
    around = np.stack([np.roll(asked, k, axis=0)[1:-1] for k in (-1, 0, 1)])
    known = np.isfinite(around).all(axis=(0, 2))
    sent, around = trial.inputs[1 : len(fit.off) - 1][known], around[:, known]
    off = sent - np.clip(sent, around.min(axis=0), around.max(axis=0))
    beside = (np.abs(off) <= CLEAR * fit.fine / FINE).all(axis=1).mean() >= NEARLY_ALL
    return row.finding if beside else found("run.other_states", ran=own.id)


def fed_nothing(own: Candidate, trial: Trial, ran: Following) -> bool:
    """Return whether a run's commands are the feed-forward to the last digits, unlike the policy's.

    Args:
        own: the candidate.
        trial: the run.
        ran: the comparison of its commands with the policy's.
    """
    policy, T = own.policy, min(trial.finite_steps, own.policy.horizon)
    if policy.gain is None:
        return False
    size = ran.fine / FINE
    asked = np.clip(policy.feedforward[:T], policy.low, policy.high)
    alone = np.abs(trial.inputs[:T] - asked) / size
    off = np.abs(ran.off[np.isfinite(ran.off).all(axis=1)]) / size
    apart_ = float(np.sqrt((off**2).mean())) if len(off) else 0.0
    return bool(alone.max(initial=0.0) < FINE and apart_ > 10 * FINE)


def likeliest(some: Iterable[Story | None], as_logged: Story) -> Story:
    """Return the story that explains a log best; `as_logged` unless one leads it clearly."""
    better = [one for one in some if one and one.left < as_logged.left - LEADS]
    return min(better, key=lambda one: one.left, default=as_logged)
