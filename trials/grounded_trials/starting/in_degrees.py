"""Inputs that are angles in radians by the model, and degrees by their values in the log.

No plan limits them then: [limits] are the range seen, and 23 rad are three turns of a steering that
goes from -23 to 23 degrees.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

from grounded_trials.logs.inspection.inspect_guess import Guess

TURN = 2 * math.pi  # a larger command of an angle is doubted
FOLLOWED = 0.3  # of such a command, that a state in rad reaches if it is a joint of several turns
DEFLECTED = re.compile(r"steer|rudder|aileron|elevator|flap|wheel_angle")  # follows no such state

Range = tuple[float, float] | None


def in_degrees(
    inputs: Sequence[Guess], units: Mapping[str, str], ranges: Mapping[str, Range]
) -> tuple[Guess, ...]:
    """Return the inputs, those that are probably in degrees as unsure, with the reason.

    Args:
        inputs: guesses for the inputs.
        units: of all states and inputs, in the model.
        ranges: lowest and highest value of each state and input in the log, in the model's unit if
            the guesses are right; None if it is not known.
    """
    peaks = {n: max(map(abs, ends)) for n, ends in ranges.items() if ends and units[n] == "rad"}
    names = {guess.name for guess in inputs}
    moved = max((peak for name, peak in peaks.items() if name not in names), default=0.0)
    found = []
    for guess in inputs:
        peak, ends = peaks.get(guess.name, 0.0), ranges.get(guess.name)
        joint = moved >= FOLLOWED * peak and not DEFLECTED.search(guess.name.lower())
        if ends and peak > TURN and not joint:
            why = (
                f"in rad by the model, but {ends[0]:.3g} to {ends[1]:.3g} in the log: if that is "
                f"in degrees, set scale = {math.pi / 180:.8g} here, and [limits] in rad"
            )
            guess = replace(guess, sure=False, reasons=(*guess.reasons, why))
        found.append(guess)
    return tuple(found)
