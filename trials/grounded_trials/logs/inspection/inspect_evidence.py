"""Check a guessed [log] table against the samples of the log: units, derivatives, model steps.

Names mislead, but a rate is the derivative of its position in every log. Each guess is therefore
compared with its rivals by the samples:

- joints: a JointState names the joint of each of its numbers (`joint_names`);
- units: the unit by the ROS message type, against the unit of the model;
- derivatives: where the model has dq/dt = w, the samples of w must follow those of q. Their ratio
  shows degrees (57.3) and signs (-1);
- steps: among rivals for an input, and for positions with their rates that names don't
  distinguish, those with which the model's steps fit the log clearly best.

Every guess that is changed or confirmed states its reason; if the samples can't decide, it stays
unsure.

Refused as commands is what the robot measured: joint positions and speeds, or the path of a state.
A model whose input is a state's own number explains that state by itself, and nothing else.

Signals without a matching name get candidates among the numbers that are left (`from_the_rest`). A
unit in a table's header, such as `boom_angle [deg]`, fits a state in rad, but not an input in N m.
If exactly one number fits the unit of exactly one state or input, it is proposed; unsure, unless
nothing else is left of either. As many numbers as names of one unit are proposed in the log's
order, unsure.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from grounded.frozen import Array
from grounded.model import Model
from grounded.result import listed
from grounded_trials.logs.inspection.inspect_groups import by_groups
from grounded_trials.logs.inspection.inspect_guess import (
    COMMAND_TOPIC,
    PARTS,
    SIMULATED_S,
    Guess,
    clock_of,
    commands_of,
    taking,
)
from grounded_trials.logs.inspection.inspect_log import LogReport, TopicReport
from grounded_trials.logs.inspection.inspect_pairs import (
    COMBINATIONS,
    FOLLOWS,
    Signals,
    agreed,
    follows,
    paired,
    velocities,
)
from grounded_trials.logs.inspection.inspect_steps import by_steps
from grounded_trials.logs.inspection.joint_names import (
    by_efforts,
    in_order,
    joint_names,
    joint_units,
    of_joint,
)
from grounded_trials.logs.stated_units import (
    Stated,
    bare_command,
    factor_between,
    may_be,
    unit_of,
    without_role,
    without_unit,
)

LATEST = 0.5  # s: a command is sought up to this long before the angle that follows it
JOINT = re.compile(r"\.(position|velocity)\[\d+\]$")  # numbers of a JointState
AHEAD = re.compile(r"\.linear\.x$")  # of a Twist or an Odometry
FEW = 3  # command topics named in a reason
MOST = 20  # largest number of candidates


def weigh(
    log: LogReport,
    model: Model,
    states: Sequence[Guess],
    inputs: Sequence[Guess],
    joints: Mapping[str, tuple[str, ...]] | None = None,
) -> tuple[tuple[Guess, ...], tuple[Guess, ...]]:
    """Check guesses against the log's samples.

    Args:
        log: an inspected log.
        model: whose states and inputs are sought.
        states: one guess for each state, in order.
        inputs: one guess for each input, in order.
        joints: the result of `joint_names`, if already known.

    Returns:
        The changed or confirmed guesses for states and for inputs, with reasons.
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
    turning = [guesses[name] for name in model.state_names if units[name] in ("rad", "deg")]
    stated = Stated.by(log.files)
    angles = {p for g in turning for p in (g.path, *g.others)}
    signals = Signals(log, guesses.values(), angles, stated)
    guesses |= _not_followed(guesses, model, log, signals)
    guesses |= _speed_asked(guesses, model, log)
    signals.read([p for g in guesses.values() for p in (g.path, *g.others) if p])
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
    found = tuple(guesses[g.name] for g in states)
    return found, only_commands(found, [guesses[g.name] for g in inputs], log)


def as_stated(stated: Stated, wanted: str, guess: Guess) -> Guess:
    """Return the guess with the factor between the unit that the log states and the model's."""
    said, factor = stated.unit(guess.path), stated.factor(guess.path, wanted)
    why = f"{stated.by_whom(guess.path)} says {said}, the model {wanted}"
    if said and guess.scale == 1 and factor_between(f"{said}/s", wanted) is not None:
        return replace(guess, sure=False, reasons=(*guess.reasons, why))  # deg, of a rate
    if abs(factor - 1) < 1e-9:
        return guess
    return replace(guess, scale=guess.scale * factor, reasons=(*guess.reasons, why))


def _taken_by_inputs(guesses: Mapping[str, Guess], model: Model) -> dict[str, Guess]:
    """Remove what is assigned to inputs from states: a command is not a measurement.

    A heading follows its turn rate's command so closely that this seemed to be the turn rate.
    """
    commands = {guesses[name].path: name for name in model.input_names if guesses[name].path}
    found = {}
    for name in model.state_names:
        guess = guesses[name]
        if guess.path in commands and bare_command(guess.path) != without_unit(guess.path):
            why = f"{guess.path} is the command '{commands[guess.path]}'"
            others = tuple(path for path in guess.others if path not in commands)
            found[name] = Guess(name, "", "", False, others, None, (why,))
            continue
        rest = tuple(path for path in guess.others if path not in commands)
        if rest != guess.others and guess.path not in commands:
            said = [f"{p} is the command '{commands[p]}'" for p in guess.others if p in commands]
            reasons = (*guess.reasons, *said)
            found[name] = replace(guess, others=rest, sure=not rest, reasons=reasons)
    return found


def _as_logged(guess: Guess, log: LogReport) -> Guess:
    """Return the guess with the clock and the range of its final signal."""
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
    if known == unit and others != guess.others:  # rivals with another unit don't count
        guess = replace(guess, others=others, sure=not others)
    if known == unit:
        role = "in ROS messages linear.x is the speed forwards; " * bool(AHEAD.search(guess.path))
        return replace(guess, reasons=(*guess.reasons, f"{role}its unit is {unit}"))
    fits = [path for path in guess.others if unit_of(path, joints) == unit]
    if fits:
        rest = tuple(p for p in guess.others if p != fits[0])
        why = f"its unit is {unit}, while that of {guess.path} is {known}"
        return replace(guess, path=fits[0], others=(guess.path, *rest), reasons=(why,), field=None)
    why = f"its unit should be {unit}, but in the log it is {known}"
    return replace(guess, sure=False, reasons=(*guess.reasons, why))


def _by_unit(guesses: Mapping[str, Guess], model: Model) -> dict[str, Guess]:
    """Assign inputs without a matching name to the only remaining command in their unit.

    The Twist of a wheeled robot, for example, has one changing number in m/s and one in rad/s.
    """
    taken = {guesses[name].path for name in model.input_names if guesses[name].path}
    found = {}
    for name in (n for n in model.input_names if not guesses[n].path):
        left, unit = tuple(p for p in guesses[name].others if p not in taken), model.inputs[name]
        fits = [path for path in left if unit and unit_of(path) == unit]
        rivals = [n for n in model.input_names if n != name and not guesses[n].path]
        alone = len(fits) == 1 and all(model.inputs[n] != unit for n in rivals)
        why = f"no name matches; the only command in {unit}"
        found[name] = (
            replace(guesses[name], path=fits[0], others=(), sure=True, reasons=(why,))
            if alone
            else replace(guesses[name], others=left)
        )
    return found


def _not_followed(
    guesses: Mapping[str, Guess], model: Model, log: LogReport, signals: Signals
) -> dict[str, Guess]:
    """Ask for the command of an angle if the angle does not follow it: a Pose may hold torques."""
    found = {}
    taken = {guesses[name].path for name in model.state_names}
    for name in model.input_names:
        guess, angle = guesses[name], guesses.get(without_role(name))
        if angle is None or not angle.path or not guess.is_angle or angle.name == name:
            continue
        both = signals.grid((angle.path, guess.path))
        if both is not None and (value := _lagged(both[0], *both[1])) < FOLLOWS:
            asked = commands_of(log, replace(guess, path="", sure=False, field=None), taken)
            why = f"{angle.name} does not follow {guess.path} (correlation {value:.2f})"
            found[name] = replace(asked, reasons=(why, *asked.reasons))
    return found


def _lagged(step: float, angle: Array, command: Array) -> float:
    """Return the largest correlation of an angle with its command up to LATEST earlier."""
    most = min(round(LATEST / step), len(angle) - 20)
    pairs = [(angle[k:], command[: len(command) - k]) for k in range(max(most, 0) + 1)]
    moved = [(a, c) for a, c in pairs if a.std() > 1e-9 and c.std() > 1e-9]
    return max((float(np.corrcoef(a, c)[0, 1]) for a, c in moved), default=0.0)


def _speed_asked(guesses: Mapping[str, Guess], model: Model, log: LogReport) -> dict[str, Guess]:
    """Give a speed without a matching name all unnamed numbers of the log as candidates."""
    name = str(model.roles.get("speed", ""))
    taken = {guess.path for guess in guesses.values()}
    if name not in guesses or guesses[name].path or guesses[name].others:
        return {}
    fields = [f for f in log.numbers if f.low != f.high and f.path not in taken]
    bare = [f.path for f in fields if re.search(r"\.data(\[\d+\])?$", f.path)]
    return {name: replace(guesses[name], others=tuple(bare[:COMBINATIONS]))}


def _speed(guesses: Mapping[str, Guess], model: Model, signals: Signals) -> dict[str, Guess]:
    """Assign the speed to the unnamed number that correlates with the speed of the position."""
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
    why = f"no name matches; it follows the speed of {listed(position)}, correlation "
    why += f"{best:.3f}, {slope:.3g} times as large"
    return {name: replace(guesses[name], path=path, others=rivals[:3], reasons=(why,))}


def is_measured(topic: str, kind: str, path: str) -> bool:
    """Check whether a number is a joint's position or speed, on a topic that is not of commands.

    Args:
        topic: name of the topic.
        kind: the topic's message type.
        path: of the number.
    """
    if not kind.endswith("/JointState") or COMMAND_TOPIC.search(topic.lower()):
        return False
    return JOINT.search(path) is not None


def only_commands(
    states: Sequence[Guess], inputs: Sequence[Guess], log: LogReport
) -> tuple[Guess, ...]:
    """Return the inputs without numbers that are measured, each with the reason.

    Args:
        states: guesses for the states.
        inputs: guesses for the inputs.
        log: an inspected log.
    """
    of_state = {guess.path: guess.name for guess in states if guess.path}
    fields = [(t, f.path) for t in log.topics for f in t.fields]
    refused = {path: "measured" for t, path in fields if is_measured(t.topic, t.type, path)}
    refused |= {path: f"the state {name}" for path, name in of_state.items()}
    found = []
    for guess in inputs:
        others = tuple(path for path in guess.others if path not in refused)
        if guess.path in refused:
            why = f"{guess.path} is {refused[guess.path]}, not a command"
            guess = Guess(guess.name, "", "", False, others, None, (why,))
        missing = () if guess.path else _not_recorded(log.topics)
        reasons = tuple(dict.fromkeys((*guess.reasons, *missing)))
        found.append(replace(guess, others=others, reasons=reasons))
    return tuple(found)


def _not_recorded(topics: Sequence[TopicReport]) -> tuple[str, ...]:
    """Return a reason that names the command topics without messages."""
    empty = [t.topic for t in topics if not t.messages and COMMAND_TOPIC.search(t.topic.lower())]
    have = "has" if len(empty) == 1 else "have"
    return (f"{listed(empty[:FEW])} {have} no messages: record the commands",) if empty else ()


def from_the_rest(
    guesses: Sequence[Guess],
    units: Mapping[str, str],
    log: LogReport,
    joints: Mapping[str, str] | None = None,
) -> tuple[Guess, ...]:
    """Give guesses without a path candidates among the unassigned numbers of the log.

    Args:
        guesses: of states and inputs.
        units: of the model, by name.
        log: an inspected log.
        joints: units of joints' numbers by path, see `joint_units`.
    """
    stated, taken = Stated.by(log.files), {guess.path for guess in guesses}
    moving = log.moving
    left = [p for p in moving if p not in taken and not PARTS.search(p)]
    lost = [guess for guess in guesses if not guess.path and not guess.others]
    fits = {g.name: [p for p in left if _goes_with(stated.unit(p), units[g.name])] for g in lost}
    alone = {
        name: paths[0]
        for name, paths in fits.items()
        if len(paths) == 1 and sum(paths[0] in some for some in fits.values()) == 1
    }
    ordered = _in_logs_order(fits)
    found = []
    for guess in guesses:
        name = guess.name
        if name in ordered:
            found.append(as_stated(stated, units[name], _ordered(guess, *ordered[name], log)))
        elif name in alone:
            one = replace(_alone_by_unit(guess, alone[name], log), sure=len(lost) == len(left) == 1)
            found.append(as_stated(stated, units[name], one))
        elif name in fits:

            def named(path: str, unit: str = units[name]) -> bool:  # by ROS's conventions
                return unit_of(path, joints) in ("", unit) and may_be(path, unit, joints)

            unsaid = [path for path in left if not stated.unit(path) and named(path)]
            known = [path for path in unsaid if unit_of(path, joints)]
            given = {*alone.values(), *(path for path, _ in ordered.values())}
            rest = tuple(p for p in fits[name] or known or unsaid if p not in given)
            found.append(replace(guess, others=rest[:MOST]))
        else:
            found.append(guess)
    return tuple(_offering(guess, units[guess.name], stated, log) for guess in found)


def _in_logs_order(fits: Mapping[str, list[str]]) -> dict[str, tuple[str, tuple[str, ...]]]:
    """Return (number, the others) for names that share exactly as many numbers of their unit."""
    found = {}
    for name, paths in fits.items():
        alike = [other for other, some in fits.items() if some == paths]
        sole = all(some == paths or not {*some} & {*paths} for some in fits.values())
        if sole and 1 < len(paths) == len(alike):
            path = paths[alike.index(name)]
            found[name] = (path, tuple(p for p in paths if p != path))
    return found


def _ordered(guess: Guess, path: str, others: tuple[str, ...], log: LogReport) -> Guess:
    why = f"no name matches; {listed((path, *others))} have a unit that fits, in the log's order"
    return taking(replace(guess, others=others), path, log, why)


def _offering(guess: Guess, wanted: str, stated: Stated, log: LogReport) -> Guess:
    """Give a guess without a path the factor and clock of the first number offered for it."""
    if guess.path or not guess.others:
        return guess
    topic = next(t for t in log.topics for f in t.fields if f.path == guess.others[0])
    scale = stated.factor(guess.others[0], wanted)
    return replace(guess, scale=scale, clock=clock_of(log, topic))


def _alone_by_unit(guess: Guess, path: str, log: LogReport) -> Guess:
    why = "no name matches; of the remaining numbers only this one has a unit that fits"
    return taking(guess, path, log, why)


def _goes_with(said: str, wanted: str) -> bool:
    return bool(said) and factor_between(said, wanted) is not None
