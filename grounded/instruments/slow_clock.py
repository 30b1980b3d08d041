"""Stamps of another pace: every rate is off its position's derivative by one and the same factor.

A clock that runs at half speed halves all derivatives. Told sensor by sensor that is a wrong scale
of each; where two or more agree, and none contradicts, it is the clock.
"""

from __future__ import annotations

from collections.abc import Sequence, Set

import numpy as np

from grounded.instruments.finding import Finding
from grounded.model import Model
from grounded.trial import Trial

ALIKE = 0.1  # of the factor: how nearly the ratios agree
CHORD_S = 0.5  # over which a way is measured: noise lengthens short ones
LEAST_M = 1.0  # chords' lengths of the speed's own: less was not driven


def told_by_the_clock(
    model: Model, trials: Sequence[Trial], found: Sequence[Finding], refuted: Set[str]
) -> list[Finding]:
    """The findings, with one of the clock in place of several scales that it explains.

    Args:
        model: whose roles name the position and the speed.
        trials: real ones.
        found: of each sensor.
        refuted: effects that two sensors which agree rule out, `sensor_scale:w` among them.
    """
    rates = [one for one in found if one.kind == "scale" and not one.corrected]
    ratios = [one.scale for one in rates]
    if (way := _speed_over_way(model, trials)) is not None:
        ratios.append(way)
    if len(ratios) < 2 or not rates or any(name.startswith("sensor_scale:") for name in refuted):
        return list(found)
    pace = float(np.exp(np.mean(np.log(ratios))))
    if max(abs(r / pace - 1) for r in ratios) > ALIKE or abs(pace - 1) < 2 * ALIKE:
        return list(found)
    names = "+".join(one.signal for one in rates)
    text = (
        f"the clock, not a sensor: every rate is {pace:.3g} times that of its position over the "
        f"stamps, so a second of them is {1 / pace:.3g} s of the run: correct the stamps, times "
        f"{1 / pace:.3g}, and take the logs in again"
    )
    at = min(found.index(one) for one in rates)
    rest = [one for one in found if one not in rates]
    return [*rest[:at], Finding(names, text, "scale", scale=pace), *rest[at:]]


def _speed_over_way(model: Model, trials: Sequence[Trial]) -> float | None:
    """The speed that is shown over that of the way in the plane; None where nothing shows both."""
    position, speed = model.roles.get("position", ()), model.roles.get("speed")
    if len(position) < 2 or not isinstance(speed, str):
        return None
    names = model.state_names
    at = [names.index(name) for name in position]
    shown = gone = 0.0
    for trial in trials:
        every = max(1, round(CHORD_S / trial.dt))
        places = trial.states[::every, at]
        size = np.abs(trial.states[:, names.index(speed)])
        along = np.concatenate([[0.0], np.cumsum((size[1:] + size[:-1]) / 2 * trial.dt)])[::every]
        chords, driven = np.linalg.norm(np.diff(places, axis=0), axis=1), np.diff(along)
        known = np.isfinite(chords) & np.isfinite(driven)
        shown, gone = shown + float(driven[known].sum()), gone + float(chords[known].sum())
    return shown / gone if min(shown, gone) > LEAST_M else None
