"""What the numbers of a log say about a guessed [log] table: units, derivatives, the model's steps.

Names mislead; a rate is the derivative of its position in every log. So each guess is tried against
its rivals with the log's own samples:

- joints: a JointState says which of its numbers is which joint (`joint_names`);
- units: what a ROS type measures, against the unit that the model states;
- derivatives: where the model says dq/dt = w, the samples of w must follow those of q. Their slope
  tells degrees (57.3) and signs (-1);
- steps: of the rivals for an input, and of positions with their rates that no name tells apart,
  those with which the model's steps fit the log clearly best.

Every guess that is changed or confirmed says by what; where the numbers can't decide it stays
unsure.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from grounded.model import Model
from grounded.result import listed
from grounded_trials.logs.following import follows
from grounded_trials.logs.inspect_groups import by_groups
from grounded_trials.logs.inspect_guess import SIMULATED_S, Guess
from grounded_trials.logs.inspect_log import LogReport
from grounded_trials.logs.inspect_pairs import (
    COMBINATIONS,
    FOLLOWS,
    Signals,
    agreed,
    paired,
    velocities,
)
from grounded_trials.logs.inspect_steps import by_steps
from grounded_trials.logs.joint_names import (
    by_efforts,
    in_order,
    joint_names,
    joint_units,
    of_joint,
)
from grounded_trials.logs.stated_units import Stated, factor_between, unit_of


def weigh(
    log: LogReport,
    model: Model,
    states: Sequence[Guess],
    inputs: Sequence[Guess],
    joints: Mapping[str, tuple[str, ...]] | None = None,
) -> tuple[tuple[Guess, ...], tuple[Guess, ...]]:
    """The guesses, with what the log's numbers say for and against them.

    Args:
        log: that was looked through.
        model: whose states and inputs are sought.
        states: one guess for each state, in order; `inputs` likewise.
        inputs: see `states`.
        joints: what `joint_names` says of the log, where it was asked already.
    """
    units = {**model.states, **model.inputs}
    joints = joint_names(log) if joints is None else joints
    guesses = {guess.name: guess for guess in (*states, *inputs)}
    guesses = {
        name: of_joint(guess, units[name], joints, log, sent=name in model.inputs)
        for name, guess in guesses.items()
    }
    unnamed = {name for name in model.state_names if not guesses[name].path}
    guesses |= in_order(guesses, units, joints, log)
    measured = joint_units(joints)
    guesses = {name: _unit(guess, units[name], measured) for name, guess in guesses.items()}
    guesses |= _by_unit(guesses, model)
    guesses |= _speed_asked(guesses, model, log)
    turning = [guesses[name] for name in model.state_names if units[name] in ("rad", "deg")]
    stated = Stated.by(log.files)
    angles = {p for g in turning for p in (g.path, *g.others)}
    signals = Signals(log, guesses.values(), angles, stated)
    guesses |= _speed(guesses, model, signals)
    pairs = [(q, w) for q, w in velocities(model).items() if q in guesses and w in guesses]
    for pair in sorted(pairs, key=lambda qw: not any(guesses[name].path for name in qw)):
        guesses |= paired(guesses, pair, signals, units, log, measured)
    for pair in pairs:
        guesses |= agreed(guesses, pair, signals, units, log, measured)
    bare = [pair for pair in pairs if unnamed.issuperset(pair)]
    guesses |= by_groups(model, guesses, bare, signals, measured)
    told = by_efforts(guesses, model.input_names, joints, signals, log)
    guesses |= {name: guess for name, guess in told.items() if guess.sure}
    guesses |= by_steps(model, guesses, signals)
    guesses |= by_efforts(guesses, model.input_names, joints, signals, log)
    guesses |= _taken_by_inputs(guesses, model)
    guesses = {name: _as_logged(guess, log) for name, guess in guesses.items()}
    guesses = {name: as_stated(stated, units[name], guess) for name, guess in guesses.items()}
    return tuple(guesses[g.name] for g in states), tuple(guesses[g.name] for g in inputs)


def as_stated(stated: Stated, wanted: str, guess: Guess) -> Guess:
    """The guess with the factor between the unit that the log states and the model's."""
    said, factor = stated.unit(guess.path), stated.factor(guess.path, wanted)
    why = f"{stated.by_whom(guess.path)} says {said}, the model {wanted}"
    if said and guess.scale == 1 and factor_between(f"{said}/s", wanted) is not None:
        return replace(guess, sure=False, reasons=(*guess.reasons, why))  # deg, of a rate
    if abs(factor - 1) < 1e-9:
        return guess
    return replace(guess, scale=guess.scale * factor, reasons=(*guess.reasons, why))


def _taken_by_inputs(guesses: Mapping[str, Guess], model: Model) -> dict[str, Guess]:
    """States without the rivals that are commands: what an input was found at is no measurement."""
    commands = {guesses[name].path: name for name in model.input_names if guesses[name].path}
    found = {}
    for name in model.state_names:
        guess = guesses[name]
        rest = tuple(path for path in guess.others if path not in commands)
        if rest != guess.others and guess.path not in commands:
            said = [f"{p} is the command '{commands[p]}'" for p in guess.others if p in commands]
            reasons = (*guess.reasons, *said)
            found[name] = replace(guess, others=rest, sure=not rest, reasons=reasons)
    return found


def _as_logged(guess: Guess, log: LogReport) -> Guess:
    """The guess with the clock and the range of the signal that it ended at."""
    for topic in log.topics:
        for field in topic.fields:
            if field.path == guess.path:
                simulated = topic.skew_s is not None and abs(topic.skew_s) > SIMULATED_S
                clock = "header" if topic.stamped and not simulated else "log"
                return replace(guess, field=field, clock=clock)
    return replace(guess, clock=guess.clock or "log")


def _unit(guess: Guess, unit: str, joints: Mapping[str, str]) -> Guess:
    known = unit_of(guess.path, joints)
    if not known or unit in ("", "1"):
        return guess
    others = tuple(path for path in guess.others if unit_of(path, joints) in ("", unit))
    if known == unit and others != guess.others:  # rivals of another unit are none
        guess = replace(guess, others=others, sure=not others)
    if known == unit:
        return replace(guess, reasons=(*guess.reasons, f"its unit is {unit}"))
    fits = [path for path in guess.others if unit_of(path, joints) == unit]
    if fits:
        rest = tuple(p for p in guess.others if p != fits[0])
        why = f"its unit is {unit}, that of {guess.path} {known}"
        return replace(guess, path=fits[0], others=(guess.path, *rest), reasons=(why,), field=None)
    why = f"its unit should be {unit}, the log's is {known}"
    return replace(guess, sure=False, reasons=(*guess.reasons, why))


def _by_unit(guesses: Mapping[str, Guess], model: Model) -> dict[str, Guess]:
    """Inputs that no name gives, each at the only command left that is in its unit.

    A Twist of a robot on wheels has one number in m/s that moves and one in rad/s.
    """
    taken = {guesses[name].path for name in model.input_names if guesses[name].path}
    found = {}
    for name in (n for n in model.input_names if not guesses[n].path):
        left, unit = tuple(p for p in guesses[name].others if p not in taken), model.inputs[name]
        fits = [path for path in left if unit and unit_of(path) == unit]
        rivals = [n for n in model.input_names if n != name and not guesses[n].path]
        alone = len(fits) == 1 and all(model.inputs[n] != unit for n in rivals)
        why = f"no name says it; the only command in {unit}"
        found[name] = (
            replace(guesses[name], path=fits[0], others=(), sure=True, reasons=(why,))
            if alone
            else replace(guesses[name], others=left)
        )
    return found


def _speed_asked(guesses: Mapping[str, Guess], model: Model, log: LogReport) -> dict[str, Guess]:
    """A speed that no name gives, with the numbers of the log that have no name as its rivals."""
    name = str(model.roles.get("speed", ""))
    taken = {guess.path for guess in guesses.values()}
    if name not in guesses or guesses[name].path or guesses[name].others:
        return {}
    fields = [f for t in log.topics for f in t.fields if f.low != f.high and f.path not in taken]
    bare = [f.path for f in fields if re.search(r"\.data(\[\d+\])?$", f.path)]
    return {name: replace(guesses[name], others=tuple(bare[:COMBINATIONS]))}


def _speed(guesses: Mapping[str, Guess], model: Model, signals: Signals) -> dict[str, Guess]:
    """The number without a name that goes with the speed of the position."""
    name, position = str(model.roles.get("speed", "")), model.roles.get("position", ())
    axes = [guesses[axis].path for axis in position if axis in guesses]
    if name not in guesses or guesses[name].path or not axes or not all(axes):
        return {}
    tried = []
    for path in guesses[name].others:
        gridded = signals.grid((*axes, path))
        if gridded is not None:
            step, (*places, speed) = gridded
            by = [
                signals.stated.factor(p, model.states[n])
                for n, p in zip(position, axes, strict=True)
            ]
            steps = np.sqrt(sum(np.diff(f * p) ** 2 for f, p in zip(by, places, strict=True)))
            speed = speed * signals.stated.factor(path, model.states[name])
            found = follows(np.concatenate([[0.0], np.cumsum(steps)]), speed, step)
            tried.append((found.correlation, found.slope, path))
    good = sorted((one for one in tried if one[0] > FOLLOWS), reverse=True)
    if not good:
        return {name: replace(guesses[name], others=())}
    best, slope, path = good[0]
    rivals = tuple(p for value, _, p in good[1:] if best - value < 0.05)
    why = f"no name says it; it goes with the speed of {listed(position)}, correlation "
    why += f"{best:.3f}, {slope:.3g} times as large"
    return {name: replace(guesses[name], path=path, others=rivals[:3], reasons=(why,))}
