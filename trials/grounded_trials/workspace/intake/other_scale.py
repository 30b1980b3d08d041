"""Whether a log is a run of its candidate once some of its columns are multiplied.

Units are tried first: degrees for radians, percent, thousandths, the other sign. Else any constant
factor is sought: the one with which the policy sends what was logged (Gauss-Newton, since commands
are linear in the states up to limits). A wheel of another size than the program believes scales
every length that it measures, a gyro that is mounted upside down turns the sign of the angles.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from grounded.frozen import Array
from grounded.model import Model
from grounded.policy import Policy
from grounded.result import listed
from grounded.search.candidate import Candidate
from grounded.task import Task
from grounded.trial import Trial
from grounded_trials.workspace.config import FILE
from grounded_trials.workspace.intake.who_drove import (
    DECISIVE,
    FINE,
    Following,
    evidence,
    follows,
    latest,
)

THOUSAND, PERCENT = (1e-3, 1e3), (1e-2, 1e2)
ANGULAR = (("rad", "rad/s"), ("rad",), ("rad/s",))  # groups of units that may be in degrees
IN_DEGREES = ("deg", "deg/s")  # units that may be in radians
LENGTHS = (("m", "m/s"), ("m",), ("m/s",))  # what one wheel measures
NAMED = (  # by what a column is multiplied, and what that says of it
    (np.pi / 180, " (in degrees)"),
    (180 / np.pi, " (radians for degrees)"),
    (1e-2, " (in percent)"),
    (1e2, " (not in percent)"),
    *((factor, "") for factor in THOUSAND),
)
NEARLY = 0.1  # of an input's size: what other units must leave of the difference
EXACT, CLOSE = 0.01, 0.05  # of an input's size: leaves a unit, or any factor, that is surely it
UNITS_LEAVE, LEAVES = 0.5, 0.25  # of the difference at most: units, any factor (many are tried)
LARGEST = 100.0  # factor, or its inverse
ONE, FAR = 0.03, 0.2  # factors nearer to 1 say nothing; of commands that are alike as they are
ROUNDS = 12  # of Gauss-Newton, more than two only where limits or turns make it no straight line


def other_units(
    task: Task, trial: Trial, own: Candidate, plain: Following | None
) -> tuple[tuple[str, ...], float]:
    """The signals with which a log is a run of its candidate once they are multiplied, and by what.

    Degrees for radians or the other way round, thousandths or thousands; (), 1 where nothing helps,
    or nothing needs to: a log so noisy that any commands could follow from it is nobody's.
    `plain`: how its commands follow as they are.
    """
    if plain is None or (plain.alike and plain.error < NEARLY):
        return (), 1.0
    trial, late = trial.until(task.horizon), latest(task)
    least, best = UNITS_LEAVE * _left(plain), (tuple[str, ...](), 1.0, np.inf)
    for names, factor in units_tried(task.model):
        found = follows(own.policy, _multiplied(trial, names, factor), late)
        if found is None or not found.alike or found.error >= NEARLY:
            continue
        if (left := _left(found)) < least and (
            not plain.alike or evidence(plain, found) > DECISIVE
        ):
            least, best = left, (tuple(names), float(factor), found.error)
    names, factor, error = best
    if names and error >= EXACT:
        any_, by = _any_factor(task.model, own.policy, trial, plain, late, 0.5 * least)
        return (any_, by) if any_ else (names, factor)
    if names:
        return names, factor
    return _any_factor(task.model, own.policy, trial, plain, late, LEAVES * _left(plain))


def any_factor(task: Task, policy: Policy, trial: Trial) -> tuple[tuple[str, ...], float]:
    """The columns and the factor with which a trial is a run of a policy; (), 1 for nothing."""
    trial, late = trial.until(task.horizon), latest(task)
    if (plain := follows(policy, trial, late)) is None:
        return (), 1.0
    return _any_factor(task.model, policy, trial, plain, late, LEAVES * _left(plain))


def _any_factor(
    model: Model, policy: Policy, trial: Trial, plain: Following, late: int, most: float
) -> tuple[tuple[str, ...], float]:
    """What makes a trial follow a policy best, which leaves less than `most`; (), 1 for nothing."""
    best, found = min(most, CLOSE), (tuple[str, ...](), 1.0)
    trial = trial.until(min(trial.finite_steps, policy.horizon))
    least = FAR if plain.alike else ONE
    for names in _scaled_together(model):
        for start in (1.0, -1.0):
            by = _factor(policy, trial, names, start)
            if not 1 / LARGEST < abs(by) < LARGEST or abs(by - 1) < least:
                continue
            fit = follows(policy, _multiplied(trial, names, by), late)
            if fit and fit.alike and _left(fit) < best and evidence(plain, fit) > DECISIVE:
                best = _left(fit)
                found = names, -1.0 if abs(by + 1) < ONE else float(f"{by:.3g}")
    return found


def any_offset(
    task: Task, policy: Policy, trial: Trial, names: Sequence[str]
) -> tuple[str, float] | None:
    """The state, one of `names`, and the constant without which a trial is a run of a policy."""
    trial, late = trial.until(task.horizon), latest(task)
    if (plain := follows(policy, trial, late)) is None or plain.alike:
        return None
    trial = trial.until(min(trial.finite_steps, policy.horizon))
    best, found = min(LEAVES * _left(plain), CLOSE), None
    for name in names:
        by = _solved(partial(_off_from, policy, trial, name), 0.0, 1e-4)
        if not np.isfinite(by):
            continue
        fit = follows(policy, _less(trial, name, by), late)
        if fit and fit.alike and _left(fit) < best and evidence(plain, fit) > DECISIVE:
            best, found = _left(fit), (name, float(f"{by:.3g}"))
    return found


def _left(ran: Following) -> float:
    """Root mean square of the commands less those of the policy, in units of the largest."""
    return float(np.sqrt(np.nanmean((ran.off / ran.fine) ** 2))) * FINE


def _scaled_together(model: Model) -> Iterator[tuple[str, ...]]:
    """Columns that one wrong constant may scale: each alone, those of a wheel or of a gyro."""
    yield from ((name,) for name in (*model.state_names, *model.input_names))
    for units in (*LENGTHS, *ANGULAR, (*LENGTHS[0], *ANGULAR[0])):
        names = tuple(name for name, unit in model.states.items() if unit in units)
        if len(names) > 1:
            yield names
    yield from (*_of_one_sensor(model), *_of_one_unit(model))


def _of_one_sensor(model: Model) -> list[tuple[str, ...]]:
    """A position and its velocity: an encoder that is mounted the other way round turns both."""
    from grounded.instruments.kinematics import integrals

    names = model.state_names
    return [(names[one.i], names[one.j]) for one in integrals(model) if one.exact]


def _of_one_unit(model: Model) -> list[tuple[str, ...]]:
    """Inputs of one unit: whoever logs one torque in N mm does so with all."""
    units = list(model.inputs.values())
    every = dict.fromkeys(unit for unit in units if units.count(unit) > 1)
    return [tuple(n for n, own in model.inputs.items() if own == unit) for unit in every]


def _factor(policy: Policy, trial: Trial, names: Sequence[str], start: float) -> float:
    """What columns are multiplied by, so that the policy sends the logged commands."""
    return _solved(lambda by: _off(policy, _multiplied(trial, names, by)), start, 1e-4 * start)


def _solved(off: Callable[[float], Array], start: float, small: float) -> float:
    """The number at which what is off is least, by Gauss-Newton; NaN where nothing hangs on it."""
    by = start
    for _ in range(ROUNDS):
        here, near = off(by), off(by + small)
        slope = (near - here) / small
        size = float((slope**2).sum())
        if size <= 0:
            return np.nan
        step = -float((slope * here).sum()) / size
        by += step
        if not np.isfinite(by) or abs(step) < 1e-6 * abs(by):
            break
    return by


def _off(policy: Policy, trial: Trial) -> Array:
    """What was logged as sent, less what the policy sends, in units of the largest, (T, m)."""
    past = policy.past if trial.start_inputs is None else trial.start_inputs
    asked = policy.commands(trial.states[None, : trial.steps], past)[0]
    off: Array = (np.clip(trial.inputs, policy.low, policy.high) - asked) / np.maximum(
        np.abs(asked).max(axis=0), 1e-12
    )
    return off


def _off_from(policy: Policy, trial: Trial, name: str, zero: float) -> Array:
    return _off(policy, _less(trial, name, zero))


def _multiplied(trial: Trial, names: Sequence[str], factor: float) -> Trial:
    states, inputs = (
        np.array([factor if name in names else 1.0 for name in every])
        for every in (trial.state_names, trial.input_names)
    )
    return replace(trial, states=trial.states * states, inputs=trial.inputs * inputs)


def _less(trial: Trial, name: str, constant: float) -> Trial:
    states = np.array(trial.states)
    states[:, trial.state_names.index(name)] -= constant
    return replace(trial, states=states)


def units_tried(model: Model) -> Iterator[tuple[Sequence[str], float]]:
    """Signals that may be in another unit together, or of the other sign, and what mends it."""
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


def units_told(names: Sequence[str], by: float, mapped: bool) -> str:
    """What is wrong with the units of a log, and what mends it; `mapped`: by a [log] table."""
    which = listed(names)
    if by == -1:
        its = "its scale" if len(names) == 1 else "the scale of each"
        mend = f"multiply {its} by -1 in {FILE}'s [log] (1 where none is given)"
        alone = f"append {which} times -1 and run it again, or take it in with --data"
        return f"with {which} of the other sign: {mend if mapped else alone}"
    size = f"{max(abs(by), 1 / abs(by)):.4g} times too {'large' if abs(by) < 1 else 'small'}"
    size += " and of the other sign" * (by < 0)
    told = next((text for factor, text in NAMED if np.isclose(by, factor, rtol=1e-6)), None)
    mend = f"multiply the scale of {which} by {by:.6g} in {FILE}'s [log] (1 where none is given)"
    if told is None:
        mend += "; if the log is right, the robot's program measures it wrong"
    if not mapped:
        mend = f"append {which} times {by:.6g} and run it again, or take it in with --data"
    return f"with {which} {size}{told or ''}: {mend}"
