"""Find where a robot stood still under commands that had moved it before: a wall, a stop, no power.

No model is needed. Commands vary in such a stretch, while every state keeps to its noise; and the
robot set off from rest with commands that were no larger. So a held pose is none (its commands are
constant), nor a dead zone or a friction that holds a robot (it would not have set off with less).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from grounded.frozen import Array, white_noise
from grounded.model import Model
from grounded.trial import Trial

LEAST_S, LEAST = 1.0, 20  # shortest stretch [s], and in steps
NOISE, SHARE = 8.0, 0.02  # a still state's largest range: of its noise, and of its range in all
MOVED = 3.0  # times that range: the robot moves
VARIED = 0.15  # share of an input's range by which commands must vary in such a stretch


@dataclass(frozen=True)
class Halted:
    """A stretch in which nothing moved [s], and the inputs that should have moved something."""

    begins: float
    ends: float
    inputs: tuple[str, ...]


def halted(model: Model, trial: Trial) -> Halted | None:
    """Return the longest stretch in which the robot stood still under commands, or None.

    Args:
        model: its states' units tell rates, which are zero at rest.
        trial: without gaps.
    """
    steps = max(LEAST, round(LEAST_S / trial.dt))
    known = trial.until(trial.known_steps)
    x, u = known.states[:-1], known.inputs
    if len(u) < 4 * steps or not (np.isfinite(x).all() and np.isfinite(u).all()):
        return None
    still = _still(model, x, steps)
    sent, spread = (_over(abs(u), steps).mean(axis=2), np.ptp(u, axis=0))
    begins = _setting_off(x, still, steps)
    if not begins.any():
        return None
    enough = _reaching(sent, sent[begins])
    best: tuple[int, int] = (0, 0)
    for first, last in _stretches(still & enough):
        best = max(best, (first, last + steps), key=lambda one: one[1] - one[0])
    first, last = best
    if not last:
        return None
    low, high = np.percentile(u[first:last], (10, 90), axis=0)  # a last step moved the robot again
    moved = high - low > VARIED * spread
    if not moved.any():
        return None
    names = tuple(n for n, told in zip(trial.input_names, moved, strict=True) if told)
    around = [one for one in _stretches(still) if one[0] <= first <= one[1]]
    first, last = around[0][0], around[0][1] + steps
    return Halted(first * trial.dt, last * trial.dt, names)


def _reaching(sent: Array, least: Array) -> NDArray[np.bool_]:
    """Return which commands (T, m) are no smaller, in every input, than one of `least` (k, m).

    Only those of `least` count that are not larger than another: they are taken by their sum.
    """
    reach, rest = np.zeros(len(sent), bool), least
    while len(rest):
        smallest = rest[np.argmin(rest.sum(axis=1))]
        reach |= (sent >= smallest).all(axis=1)
        rest = rest[~(rest >= smallest).all(axis=1)]
    return reach


def _ranges(signal: Array, steps: int) -> Array:
    """Return the range of a signal (T, k) in each of its windows, (T - steps + 1, k)."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    ends = (maximum_filter1d(signal, steps, axis=0), minimum_filter1d(signal, steps, axis=0))
    first = steps // 2  # the filters are centred
    return np.asarray(ends[0] - ends[1])[first : first + len(signal) - steps + 1]


def _over(signal: Array, steps: int) -> Array:
    """Return all windows of a signal (T, k) as (T - steps + 1, k, steps)."""
    return np.asarray(sliding_window_view(signal, steps, axis=0))


def _rest(x: Array) -> Array:
    """Return the range within which each state is still, (n,)."""
    return np.asarray(np.maximum(NOISE * white_noise(x), SHARE * np.ptp(x, axis=0)))


def _still(model: Model, x: Array, steps: int) -> NDArray[np.bool_]:
    """Return in which windows every state keeps to its noise, rates to that about zero."""
    most, means = _rest(x), _over(x, steps).mean(axis=2)
    rates = np.array([unit.endswith("/s") for unit in model.states.values()])
    moved = np.maximum(_ranges(x, steps), np.where(rates, np.abs(means), 0.0))
    return np.asarray((moved <= most).all(axis=1))


def _setting_off(x: Array, still: NDArray[np.bool_], steps: int) -> NDArray[np.bool_]:
    """Return the windows that begin after half of one at rest, and in which the robot moves."""
    moves = (_ranges(x, steps) > MOVED * _rest(x)).any(axis=1)
    before = np.zeros_like(still)
    before[steps:] = still[:-steps]
    return before & moves


def _stretches(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the first and last index of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2)]
