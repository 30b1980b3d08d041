"""Numbers of a log for the states and inputs that no name gives: by their unit, or all to choose.

What a table's head says in brackets, `boom_angle [deg]`, fits a state in rad and no input in N m.
Where one number alone is left in the unit of one state or input alone, it is proposed, unsure.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

from grounded_trials.logs.inspect_evidence import as_stated
from grounded_trials.logs.inspect_guess import Guess
from grounded_trials.logs.inspect_log import LogReport
from grounded_trials.logs.stated_units import Stated, factor_between, may_be, unit_of

PARTS = re.compile("covariance|layout")  # of messages: no robot's numbers
MOST = 20  # numbers of the log to choose from


def from_the_rest(
    guesses: Sequence[Guess],
    units: Mapping[str, str],
    log: LogReport,
    joints: Mapping[str, str] | None = None,
) -> tuple[Guess, ...]:
    """The guesses, where those without a path get what the rest of the log may be to them.

    Args:
        guesses: of states and inputs.
        units: of the model, by their names.
        log: that was looked through.
        joints: units of joints' numbers by their paths, see `joint_units`.
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
            one = _by_unit(guess, alone[name], log)
            found.append(as_stated(stated, units[name], one))
        elif name in fits:

            def named(path: str, unit: str = units[name]) -> bool:  # by ROS's conventions
                return unit_of(path, joints) in ("", unit) and may_be(path, unit, joints)

            unsaid = [path for path in left if not stated.unit(path) and named(path)]
            rest = tuple(p for p in fits[name] or unsaid if p not in alone.values())
            found.append(replace(guess, others=rest[:MOST]))
        else:
            found.append(guess)
    return tuple(found)


def _by_unit(guess: Guess, path: str, log: LogReport) -> Guess:
    topic, field = next((t, f) for t in log.topics for f in t.fields if f.path == path)
    why = "no name says it; of the numbers left it alone has a unit that fits"
    clock = "header" if topic.stamped else "log"
    return replace(guess, path=path, field=field, clock=clock, reasons=(why,))


def _goes_with(said: str, wanted: str) -> bool:
    return bool(said) and factor_between(said, wanted) is not None
