"""Detect positions in another unit where no velocity is logged, such as those of a wheeled robot.

A kinematic model (a unicycle, a bicycle) has no speeds among its states, so only the commands say
how far the robot moves. If its positions move as the commands say, but a power of ten as far, while
the heading turns as they say, no physics explains it: weak motors and slip change the distance by a
part of it, and a robot that stands still has positions that follow nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from grounded.frozen import Array
from grounded.instruments.odd_trial import predicted
from grounded.instruments.other_units import unusable
from grounded.model import Model
from grounded.result import listed
from grounded.trial import Trial

FACTORS = (1e6, 1e3, 1e2, 1e-2, 1e-3, 1e-6)  # motion in the log over that by the commands
NEAR = 1.25  # factor within which the ratio is one of these
SHAPE, FOLLOWS = 0.9, 0.8  # least correlation with the predicted motion: of positions, of the rest
SIZED = 2.0  # factor within which the rest must move as far as predicted
LEAST = 20  # fewest predictions


@dataclass(frozen=True)
class Positions:
    """Positions that move `factor` times as far as the commands say; `ratio` is as measured."""

    names: tuple[str, ...]
    factor: float
    ratio: float

    @property
    def described(self) -> str:
        """One clause: what is wrong, and the evidence."""
        one, large = len(self.names) == 1, self.factor > 1
        size = self.factor if large else 1 / self.factor
        return (
            f"{listed(self.names)} look{'s' * one} {size:.6g} times too "
            f"{'large' if large else 'small'}: {'it moves' if one else 'they move'} "
            f"{self.ratio:.2g} times as far as the commands say, and the rest moves as they say"
        )

    @property
    def mend(self) -> str:
        """The instruction that corrects it."""
        tables = listed(f"[log.state.{name}]" for name in self.names)
        return (
            f"Multiply the scale in {tables} by {1 / self.factor:.6g} (a missing scale is 1), and "
            f"{listed(self.names)} of the target if it was made from this log"
        )


def positions_off(model: Model, trial: Trial, shown: Sequence[int]) -> Positions | None:
    """Return the positions of a trial that are in another unit; None if none are.

    Args:
        model: however crude.
        trial: of its states and inputs.
        shown: indices of the states with a sensor.
    """
    units = list(model.states.values())
    known = [i for i in shown if np.isfinite(trial.states[:, i]).any()]
    lengths = [i for i in known if units[i] == "m"]
    if len(lengths) < 2 or len(lengths) == len(known) or any(units[i] == "m/s" for i in known):
        return None
    with np.errstate(all="ignore"):
        ahead = predicted(model, trial, known) if np.isfinite(trial.inputs).all() else None
        if ahead is None or len(ahead[0]) < LEAST:
            return None
        start, then, logged = ahead
        made, seen = model.difference(then, start), model.difference(logged, start)
        for group in (lengths, *([i] for i in lengths)):
            ratio, alike = _followed(made[:, group], seen[:, group])
            factor = next((f for f in FACTORS if f / NEAR < ratio < f * NEAR), None)
            rest = [_followed(made[:, [i]], seen[:, [i]]) for i in known if i not in group]
            fits = all(1 / SIZED < r < SIZED and c > FOLLOWS for r, c in rest)
            if factor and alike > SHAPE and fits:
                return Positions(tuple(model.state_names[i] for i in group), factor, ratio)
    return None


def judge_positions(model: Model, trials: Sequence[Trial], hidden: Sequence[str] = ()) -> None:
    """Raise an error if the positions of trials are in another unit.

    Args:
        model: however crude.
        trials: of its states and inputs.
        hidden: states without a sensor.

    Raises:
        GroundedError: naming the trials, the positions and the scale that corrects them.
    """
    shown = [i for i, name in enumerate(model.state_names) if name not in hidden]
    found = [positions_off(model, trial, shown) for trial in trials]
    first = next((one for one in found if one), None)
    if first:
        same = (first.names, first.factor)
        odd = [k for k, one in enumerate(found) if one and (one.names, one.factor) == same]
        raise unusable(trials, odd, first.described, first.mend)


def _followed(made: Array, seen: Array) -> tuple[float, float]:
    """Return how many times as far as predicted some states move, and the correlation."""
    both, size = float((made * seen).sum()), float((made**2).sum())
    return both / max(size, 1e-300), both / max(np.sqrt(size * float((seen**2).sum())), 1e-300)
