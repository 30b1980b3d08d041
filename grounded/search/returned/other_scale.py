"""Check whether a log is a run of its candidate if some of its columns are multiplied by a factor.

Units are tried first: degrees instead of radians, percent, thousandths, the other sign. Then any
constant factor with which the policy sends the logged commands (by Gauss-Newton, since commands are
linear in the states up to limits). A wheel of another size than in the program, for example, scales
every length that it measures; a gyro mounted upside down flips the sign of angles.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from grounded.accounts.table import unit_named
from grounded.frozen import Array
from grounded.model import Model
from grounded.policy import Policy
from grounded.result import with_unit
from grounded.search.candidate import Candidate
from grounded.search.returned.as_predicted import apart, multiplied
from grounded.search.returned.who_drove import (
    DECISIVE,
    FINE,
    Following,
    evidence,
    follows,
    latest,
)
from grounded.task import Task
from grounded.trial import Trial

THOUSAND, PERCENT, CENTI = (1e-3, 1e3), (1e-2, 1e2), 1e-2
ANGULAR = (("rad", "rad/s"), ("rad",), ("rad/s",))  # groups of units that may be in degrees
IN_DEGREES = ("deg", "deg/s")  # units that may be in radians
LENGTHS = (("m", "m/s"), ("m",), ("m/s",))  # units of what one wheel measures
NEARLY = 0.1  # largest difference of commands with another unit, relative to an input's size
EXACT, CLOSE = 0.01, 0.05  # the same for a unit that is certain, and for any factor
# largest share of the original difference left by a unit, and by any factor (many are tried)
UNITS_LEAVE, LEAVES = 0.5, 0.25
ALL = 0.05  # share left by a factor or offset that is stated although commands are nearly alike
LARGEST = 100.0  # largest factor, or its inverse
ONE, FAR = 0.03, 0.2  # factors nearer to 1 are ignored; FAR if the commands are alike without one
ROUNDS = 12  # Gauss-Newton iterations; more than two are only needed at limits or wrapped angles


def other_units(
    task: Task, trial: Trial, own: Candidate, plain: Following | None
) -> tuple[tuple[str, ...], float]:
    """Return the signals and the factor with which a log is a run of its candidate.

    Args:
        task: the task of the candidate.
        trial: the trial cut from the log.
        own: the candidate.
        plain: the comparison of its commands without a factor.

    Returns:
        Signals and factor; (), 1 if none helps or is needed, or if the log is too noisy to compare.
    """
    if plain is None or (plain.alike and plain.error < EXACT):
        return (), 1.0
    trial, late = trial.until(task.horizon), latest(task)
    if plain.alike and plain.error < NEARLY:  # only a factor that explains all of it counts
        return _any_factor(task.model, own, trial, plain, late, ALL * _left(plain), ONE)
    least, best = np.inf, (tuple[str, ...](), 1.0, np.inf, np.inf)
    for names, factor in (*full_scales(task, trial.inputs), *units_tried(task.model)):
        found = follows(own.policy, mended := multiplied(trial, names, factor), late)
        if found is None or not found.alike or found.error >= NEARLY:
            continue
        if (left := _left(found)) >= UNITS_LEAVE * _left(plain):
            continue
        if plain.alike and not evidence(plain, found) > DECISIVE:
            continue
        if (away := _farther(own, trial, mended)) is None:
            continue
        if (by := away + np.log(left + FINE)) < least:
            least, best = by, (tuple(names), float(factor), found.error, left)
    names, factor, error, left = best
    if names and error >= EXACT:
        any_, by = _any_factor(task.model, own, trial, plain, late, 0.5 * left)
        return (any_, by) if any_ else (names, factor)
    if names:
        return names, factor
    return _any_factor(task.model, own, trial, plain, late, LEAVES * _left(plain))


def _farther(own: Candidate, trial: Trial, mended: Trial) -> float | None:
    """Return how much farther from its prediction a log is without a fault [nats], if not at all.

    None if it is farther: then that is not what is wrong with it.
    """
    away = apart(own, mended) - apart(own, trial)
    return away if away <= 0 else None


def any_factor(task: Task, own: Candidate, trial: Trial) -> tuple[tuple[str, ...], float]:
    """Return columns and a factor with which a trial is a run of a candidate; (), 1 for none."""
    trial, late = trial.until(task.horizon), latest(task)
    if (plain := follows(own.policy, trial, late)) is None:
        return (), 1.0
    return _any_factor(task.model, own, trial, plain, late, LEAVES * _left(plain))


def _any_factor(
    model: Model,
    own: Candidate,
    trial: Trial,
    plain: Following,
    late: int,
    most: float,
    least: float | None = None,
) -> tuple[tuple[str, ...], float]:
    """Return the columns and factor that fit best and leave less than `most`; (), 1 for none.

    Factors within `least` of 1 are ignored: FAR if the commands are alike without one, else ONE.
    """
    best, found, policy = min(most, CLOSE), (tuple[str, ...](), 1.0), own.policy
    trial = trial.until(min(trial.finite_steps, policy.horizon))
    least = (FAR if plain.alike else ONE) if least is None else least
    groups = list(_scaled_together(model))
    factors = [_factors(policy, trial, groups, start) for start in (1.0, -1.0)]
    for names, *each in zip(groups, *factors, strict=True):
        for by in each:
            if not 1 / LARGEST < abs(by) < LARGEST or abs(by - 1) < least:
                continue
            fit = follows(policy, mended := multiplied(trial, names, by), late)
            if _farther(own, trial, mended) is None:
                continue
            if fit and fit.alike and _left(fit) < best and evidence(plain, fit) > DECISIVE:
                best = _left(fit)
                found = names, -1.0 if abs(by + 1) < ONE else float(f"{by:.3g}")
    return found


def any_offset(
    task: Task, own: Candidate, trial: Trial, names: Sequence[str], plain: Following | None
) -> tuple[str, float, float] | None:
    """Return the state in `names` and the offset without which a trial is a candidate's run.

    With it, what is left of the commands then, relative to their size.

    A position's weak gain may hide an offset: the trial then counts as a run of the candidate, but
    follows it far better without the offset. `plain` compares its commands as they are.
    """
    if plain is None or plain.error < EXACT:
        return None
    late, policy = latest(task), own.policy
    trial = trial.until(min(trial.finite_steps, task.horizon, policy.horizon))
    most = ALL if plain.alike else LEAVES
    best, found = min(most * _left(plain), CLOSE), None
    for name, by in zip(names, _offsets(policy, trial, names), strict=True):
        if not np.isfinite(by):
            continue
        fit = follows(policy, mended := _less(trial, name, by), late)
        if _farther(own, trial, mended) is None:
            continue
        if fit and fit.alike and _left(fit) < best and evidence(plain, fit) > DECISIVE:
            best, found = _left(fit), (name, float(f"{by:.3g}"), fit.error)
    return found


def _left(ran: Following) -> float:
    """Return the rms difference of the commands from the policy's, in units of their size."""
    return float(np.sqrt(np.nanmean((ran.off / ran.fine) ** 2))) * FINE


def _scaled_together(model: Model) -> Iterator[tuple[str, ...]]:
    """Yield groups of columns that one wrong constant may scale: single, a wheel's, a gyro's."""
    yield from ((name,) for name in (*model.state_names, *model.input_names))
    for units in (*LENGTHS, *ANGULAR, (*LENGTHS[0], *ANGULAR[0])):
        names = tuple(name for name, unit in model.states.items() if unit in units)
        if len(names) > 1:
            yield names
    yield from (*_of_one_sensor(model), *_of_one_unit(model))


def _of_one_sensor(model: Model) -> list[tuple[str, ...]]:
    """Return pairs of a position and its velocity: a reversed encoder flips both."""
    from grounded.places import integrals

    names = model.state_names
    return [(names[one.i], names[one.j]) for one in integrals(model) if one.exact]


def _of_one_unit(model: Model) -> list[tuple[str, ...]]:
    """Return groups of inputs with the same unit, which are probably logged alike."""
    units = list(model.inputs.values())
    every = dict.fromkeys(unit for unit in units if units.count(unit) > 1)
    return [tuple(n for n, own in model.inputs.items() if own == unit) for unit in every]


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

    return _solved(off, np.zeros(len(names)), 1e-4)


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


def _less(trial: Trial, name: str, constant: float) -> Trial:
    states = np.array(trial.states)
    states[:, trial.state_names.index(name)] -= constant
    return replace(trial, states=states)


def units_tried(model: Model) -> Iterator[tuple[Sequence[str], float]]:
    """Yield groups of signals and factors that correct another unit or sign of the group."""
    angular = [[n for n, u in model.states.items() if u in units] for units in ANGULAR]
    turns = (*ANGULAR[0], *IN_DEGREES)
    angular += [[n] for n, u in model.states.items() if u in turns]
    angular += [[n] for n, u in model.inputs.items() if u in turns]
    single = [[name] for name in (*model.state_names, *model.input_names)]
    pure = [name for name, unit in model.inputs.items() if unit == "1"]
    yield from ((names, f) for f in (np.pi / 180, 180 / np.pi) for names in angular if names)
    yield from ((pure, f) for f in PERCENT if pure)
    together = [*single, *_of_one_unit(model), *_of_one_sensor(model)]
    yield from ((names, f) for f in (*THOUSAND, -1.0) for names in together)
    lengths = [[n for n, u in model.states.items() if u in units] for units in LENGTHS]
    yield from ((names, f) for f in THOUSAND for names in lengths if len(names) > 1)
    yield from ((names, CENTI) for names in lengths if names)


def full_scales(task: Task, inputs: Array) -> Iterator[tuple[Sequence[str], float]]:
    """Yield inputs that exceed their limits, with the factors from percent and thousandths of them.

    Args:
        task: with the limits, whose larger one is taken as 100 % or 1000.
        inputs: the commands (T, m) of a log.
    """
    for j, (name, unit) in enumerate(task.model.inputs.items()):
        low, high = task.low[j], task.high[j]
        full = max(abs(low), abs(high))
        most = np.nanmax(np.abs(inputs[:, j]), initial=0.0)
        known = full == 1 and unit == "1"  # tried anyway
        if np.isfinite(full) and not known and most > full:
            yield from (([name], float(full * by)) for by in (PERCENT[0], THOUSAND[0]))


def of_full_scale(task: Task, names: Sequence[str], by: float) -> str:
    """Return `percent of 10 N` if a factor converts an input from that; "" otherwise."""
    if len(names) != 1 or names[0] not in task.model.inputs:
        return ""
    j = task.model.input_names.index(names[0])
    full = float(max(abs(task.low[j]), abs(task.high[j])))
    parts = {PERCENT[0]: "percent", THOUSAND[0]: "thousandths"}
    part = next((name for one, name in parts.items() if np.isclose(by, full * one)), "")
    return part and f"{part} of {with_unit(f'{full:g}', task.model.inputs[names[0]])}"


def unit_by_factor(model: Model, names: Sequence[str], by: float) -> str:
    """Return the unit of signals in a log that a factor converts to the model's; "" if unknown."""
    own = {**model.states, **model.inputs}
    return unit_named((own[name] for name in names), 1 / by) if names else ""
