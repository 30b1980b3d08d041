"""Candidates for states and inputs without a matching name: by unit, or all that are left.

A unit in a table's header, such as `boom_angle [deg]`, fits a state in rad, but not an input in
N m. If exactly one number fits the unit of exactly one state or input, it is proposed; unsure,
unless nothing else is left of either.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

from grounded_trials.logs.inspect_evidence import as_stated
from grounded_trials.logs.inspect_guess import Guess, clock_of
from grounded_trials.logs.inspect_log import LogReport
from grounded_trials.logs.stated_units import Stated, factor_between, may_be, unit_of

PARTS = re.compile(r"covariance|layout|(orientation|rotation)\.[xyzw]$")  # no signals by themselves
MOST = 20  # largest number of candidates


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
    moving = [f.path for t in log.topics for f in t.fields if f.low != f.high]
    left = [p for p in moving if p not in taken and not PARTS.search(p)]
    lost = [guess for guess in guesses if not guess.path and not guess.others]
    fits = {g.name: [p for p in left if _goes_with(stated.unit(p), units[g.name])] for g in lost}
    alone = {
        name: paths[0]
        for name, paths in fits.items()
        if len(paths) == 1 and sum(paths[0] in some for some in fits.values()) == 1
    }
    found = []
    for guess in guesses:
        name = guess.name
        if name in alone:
            one = replace(_by_unit(guess, alone[name], log), sure=len(lost) == len(left) == 1)
            found.append(as_stated(stated, units[name], one))
        elif name in fits:

            def named(path: str, unit: str = units[name]) -> bool:  # by ROS's conventions
                return unit_of(path, joints) in ("", unit) and may_be(path, unit, joints)

            unsaid = [path for path in left if not stated.unit(path) and named(path)]
            known = [path for path in unsaid if unit_of(path, joints)]
            rest = tuple(p for p in fits[name] or known or unsaid if p not in alone.values())
            found.append(replace(guess, others=rest[:MOST]))
        else:
            found.append(guess)
    return tuple(_offering(guess, units[guess.name], stated, log) for guess in found)


def _offering(guess: Guess, wanted: str, stated: Stated, log: LogReport) -> Guess:
    """Give a guess without a path the factor and clock of the first number offered for it."""
    if guess.path or not guess.others:
        return guess
    topic = next(t for t in log.topics for f in t.fields if f.path == guess.others[0])
    scale = stated.factor(guess.others[0], wanted)
    return replace(guess, scale=scale, clock=clock_of(log, topic))


def _by_unit(guess: Guess, path: str, log: LogReport) -> Guess:
    topic, field = next((t, f) for t in log.topics for f in t.fields if f.path == path)
    why = "no name matches; of the remaining numbers only this one has a unit that fits"
    return replace(guess, path=path, field=field, clock=clock_of(log, topic), reasons=(why,))


def _goes_with(said: str, wanted: str) -> bool:
    return bool(said) and factor_between(said, wanted) is not None
