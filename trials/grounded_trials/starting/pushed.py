"""A car or rover that no speed command drives: its skeleton gets the motor command of the log.

The skeletons are driven by a desired speed. Where a log has none, but one command of a motor (a
duty, a throttle, a voltage), that is the input, under its own name and in its own unit, and `gain`
is the speed per unit of it that the log shows.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from grounded_trials.logs.inspection.guess import Guess
from grounded_trials.logs.inspection.inspect_log import LogReport
from grounded_trials.logs.inspection.names import COMMAND_TOPIC
from grounded_trials.logs.inspection.relations import Signals
from grounded_trials.logs.stated_units import Stated, command_unit
from grounded_trials.starting.skeletons import Skeleton, driven_by

SPEED = re.compile(r"speed|veloc|(^|[/._])vel([/._]|$)|cmd_vel|linear|geschw|vitesse")
MOTOR = re.compile("throttle|duty|pwm|motor|volt|current|power|effort|torque|(^|[/._])(gas|esc)")
STEERS = re.compile("steer|servo|lenk")
DRIVEN = 0.25  # of the largest command: smaller ones say little, friction stops the robot
STEADY = 0.05  # of the largest speed: by less it changes within `WITHIN` at a steady speed
WITHIN = 0.5  # [s]
STEADY_SAMPLES = 20  # samples at a steady speed; of fewer the largest ratio is taken
GAIN_RANGE = 5.0  # the gain's bounds are that many times smaller and larger


def pushed(plain: Skeleton, sent: Mapping[str, str], units: Mapping[str, str]) -> Skeleton:
    """Return a skeleton driven by the log's only motor command, if that has no speed command.

    Args:
        plain: a skeleton with the input `speed`.
        sent: paths of the log's commands, by their names.
        units: units by path, where the log states them.
    """
    if any(SPEED.search(path.lower()) for path in sent.values()):
        return plain
    motors = {
        name: path
        for name, path in sent.items()
        if MOTOR.search(path.lower()) and not STEERS.search(path.lower())
    }
    motors = {n: p for n, p in motors.items() if COMMAND_TOPIC.search(p.lower())} or motors
    if len(motors) != 1:
        return plain
    ((name, path),) = motors.items()
    return pushed_by(plain, name, command_unit(name, path, units))


def pushed_by(plain: Skeleton, command: str, unit: str) -> Skeleton:
    """Return a skeleton with a command in place of `speed`; for its gain see `with_gain`."""
    per = "m/s" if unit == "1" else f"m/s/({unit})" if " " in unit else f"m/s/{unit}"
    return driven_by(plain, {"speed": (command, unit)}, gain=f'1.0, "{per}", 0.2, 5.0')


def with_gain(plain: Skeleton, found: Mapping[str, Guess], log: LogReport) -> Skeleton:
    """Return such a skeleton with the gain that the log shows; others unchanged.

    Args:
        plain: a skeleton of any kind.
        found: the log's signals, by the skeleton's names.
        log: the log.
    """
    told = plain.params.get("gain", "").split('"')
    v, drive = found.get("v"), next((n for n in plain.inputs if f"p.gain * a.{n}" in _v(plain)), "")
    u = found.get(drive)
    if drive in ("", "speed") or v is None or u is None or not (v.path and u.path):
        return plain
    if not (seen := _gain(v, u, log)):
        return plain
    low, high = sorted((seen / GAIN_RANGE, seen * GAIN_RANGE))
    text = f'{seen:.3g}, "{told[1]}", {low:.2g}, {high:.2g}'
    return replace(plain, params={**plain.params, "gain": text})


def _v(plain: Skeleton) -> str:
    return next((line for line in plain.lines if line.startswith('"v":')), "")


def _gain(v: Guess, u: Guess, log: LogReport) -> float:
    """Return the median of v / u at steady speeds, else the largest ratio; 0 if unknown."""
    gridded = Signals(log, (), Stated.by(log.files)).grid((v.path, u.path))
    if gridded is None:
        return 0.0
    step, (speed, command) = gridded
    speed, command = v.scale * speed, u.scale * command
    most = float(np.abs(command).max())
    if not most > 0:
        return 0.0
    wide = max(round(WITHIN / step), 1)
    changed = np.full(len(speed), np.inf)
    changed[wide:] = np.abs(speed[wide:] - speed[:-wide])
    steady = (changed < STEADY * np.abs(speed).max()) & (np.abs(command) > DRIVEN * most)
    if steady.sum() >= STEADY_SAMPLES:
        return float(np.median(speed[steady] / command[steady]))
    return float(np.abs(speed).max() / most)
