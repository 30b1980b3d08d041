"""Detect lengths in another unit that only the model reveals: positions alone, or all of them.

A kinematic model (a unicycle, a bicycle) has no speeds among its states, so only the commands say
how far the robot moves. If its positions move as the commands say, but a power of ten as far, while
the heading turns as they say, no physics explains it: weak motors and slip change the distance by a
part of it, and a robot that stands still has positions that follow nothing.

If positions and their velocities are all in mm, they agree with each other. Then gravity, gains and
torques accelerate the robot a thousand times as much as in the model, whose calibrated predictions
explain almost nothing of it, but most of it once all lengths are divided (`_lengths`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.frozen import Array
from grounded.instruments.finding import unusable
from grounded.instruments.predictions.mistaken import other_input_units
from grounded.instruments.predictions.short_runs import Ahead, predicted
from grounded.instruments.units.odd_trial import ratios_of
from grounded.model import Model
from grounded.result import listed
from grounded.trial import Trial

FACTORS = (1e6, 1e3, 1e2, 1e-2, 1e-3, 1e-6)  # motion in the log over that by the commands
NEAR = 1.25  # factor within which the ratio is one of these
SHAPE, FOLLOWS = 0.9, 0.8  # least correlation with the predicted motion: of positions, of the rest
SIZED = 2.0  # factor within which the rest must move as far as predicted
LEAST = 20  # fewest predictions
UNITS = {1e3: "mm", 1e2: "cm", 1e-3: "km"}  # in which a length in m is so many times too large
SAMPLES = 120  # of a trial that calibrated predictions start from
ALONE = 3.0  # factor within which positions must move as their velocities say
ALL = (1e3, 1e2, 1e-2, 1e-3)  # times too large that all lengths may be
MISSED, EXPLAINED = 0.8, 0.7  # share of a velocity's change that is missed: as logged, and divided
TIED = 0.1  # by how much more of another velocity's change may be missed
ALIKE = 0.6  # least correlation of its change with that prediction
ACROSS = 4.0  # factor within which the uncalibrated model must then predict its size


@dataclass(frozen=True)
class Positions:
    """Lengths that change `factor` times as much as the commands say; `ratio` is as measured.

    Args:
        names: of the states.
        factor: how many times too large they are.
        ratio: how many times as far as predicted they move.
        missed: share of the change of the velocity `of` that predictions miss as it is logged and
            divided by the factor, for lengths with their velocities.
        of: that velocity; "" for positions alone.
    """

    names: tuple[str, ...]
    factor: float
    ratio: float
    missed: tuple[float, float] = (0.0, 0.0)
    of: str = ""

    @property
    def described(self) -> str:
        """One clause: what is wrong, and the evidence."""
        one, large = len(self.names) == 1, self.factor > 1
        size = self.factor if large else 1 / self.factor
        if self.of:
            unit = f" (in {UNITS[self.factor]}?)" if self.factor in UNITS else ""
            with_it, without = (f"{100 * share:.0f} %" for share in reversed(self.missed))
            way = f"divided by {size:g}" if large else f"times {size:g}"
            return (
                f"{listed(self.names)} look{'s' * one} {size:g} times too "
                f"{'large' if large else 'small'}{unit}: {way}, the model misses {with_it} of how "
                f"{self.of} changes in 0.25 s, instead of {without}"
            )
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
    if any(units[i] == "m/s" for i in known):
        return _lengths(model, trial, known)
    lengths = [i for i in known if units[i] == "m"]
    if len(lengths) < 2 or len(lengths) == len(known):
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


def _lengths(model: Model, trial: Trial, known: Sequence[int]) -> Positions | None:
    """Return all lengths and velocities of a trial if all are in another unit; None if not.

    The inputs must not be lengths themselves, which would be in that unit, too.

    Args:
        model: however crude.
        trial: of its states and inputs.
        known: indices of the states with values.
    """
    units = list(model.states.values())
    lengths = [i for i in known if units[i].partition("/")[0] == "m"]
    fast = [i for i in known if units[i] == "m/s"]
    if any(unit.partition("/")[0] == "m" for unit in model.inputs.values()):
        return None
    exact = [ratio for one, ratio in ratios_of(model, [trial], known)[0] if one.exact]
    if not all(1 / ALONE < ratio < ALONE for ratio in exact):
        return None  # one signal alone is off: see `other_units`
    with np.errstate(all="ignore"):
        logged = _missed(model, trial, known, fast)
        if logged is None or not (logged > MISSED).any():  # as it is in nearly every log
            return None
        for factor in ALL:
            states = np.array(trial.states)
            states[:, lengths] /= factor
            other = replace(trial, states=states)
            divided, ahead = _missed(model, other, known, fast), predicted(model, other, known)
            if divided is None or ahead is None:
                continue
            k = int(np.argmax(logged - divided))
            start, then, seen = (x[:, [fast[k]]] for x in ahead)
            ratio, alike = _followed(then - start, seen - start)
            right = divided[k] < EXPLAINED < MISSED < logged[k] and alike > ALIKE
            right = right and not _by_inputs(model, trial, known, fast[k])
            if right and (divided < logged + TIED).all() and 1 / ACROSS < ratio < ACROSS:
                names = tuple(model.state_names[i] for i in lengths)
                shares = float(logged[k]), float(divided[k])
                of = model.state_names[fast[k]]
                return Positions(names, factor, ratio * factor, shares, of)
    return None


def _by_inputs(model: Model, trial: Trial, known: Sequence[int], i: int) -> bool:
    """Check whether inputs in another unit explain a velocity as well: commands in percent."""
    for change in other_input_units(model, [trial]):
        missed = _missed(model, change.mended(trial), known, [i])
        if missed is not None and missed[0] < EXPLAINED:
            return True
    return False


def _missed(model: Model, trial: Trial, known: Sequence[int], some: Sequence[int]) -> Array | None:
    """Return the share of some states' changes that the calibrated model misses; None if unknown.

    Parameters may move within their bounds, and commands may act late.
    """
    ahead = Ahead(model, trial, known, SAMPLES)
    if not ahead.enough or not np.isfinite(trial.inputs).all():
        return None
    fit = ahead.best([np.ones(model.m)], free=False)
    found: Array = (fit.rms / np.maximum(ahead.moved, 1e-12))[list(some)]
    return found


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
