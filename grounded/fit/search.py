"""Search for the most likely parameters, delays, thresholds and noise.

Three kinds of unknowns are optimised in turn until the likelihood stops increasing: parameters and
delays (`gauss_newton`), thresholds (by scanning), and the noise (`grounded.estimate.likelihood`).
The noise decides which errors are the model's. It starts large, while the model is wrong, and
shrinks as the model improves.

The likelihood is piecewise constant in a threshold (the car's stall): its derivative is zero almost
everywhere, so Gauss-Newton can't move it. A threshold is scanned over its bounds, coarsely first,
then between the neighbours of the best value; so are delays, whose start may be far off. At each
value the predicted gain of the other unknowns' linear problem is added, so that each value of a
delay, for instance, is compared with the lag that suits it best.

The interval of a threshold is the set of values whose log-likelihood lies within DROP of the best:
3.67 nats, the 95 % point for a threshold (Hansen 2000), more than the 1.92 of a smooth unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from grounded.estimate import Measurement, NoiseStd, Record, cut
from grounded.estimate.likelihood import enough, first_noise, maximum_likelihood
from grounded.estimate.record import batch_of
from grounded.fit.gauss_newton import Climb, climb, marquardt_step
from grounded.fit.point import FitData, Linear, Point, fall, linear, point
from grounded.fit.unknowns import Unknowns
from grounded.frozen import Array
from grounded.model import Model
from grounded.progress import Stages

ROUNDS = 8  # most rounds of parameters, thresholds, noise
STIRRED = 0.5  # [nats] gain of a climb below which thresholds and noise are not searched again
STUCK = 1.0  # [nats] predicted gain above which a climb that ended has not converged
REVIVE = 0.2  # least start of each noise search, as a fraction of the rough noise
LONG = 400  # steps; longer records are cut, so that the filter runs over the pieces in parallel


@dataclass(frozen=True, eq=False)
class SearchEnd:
    """The result of a search: the last climb, the noise at its end and start, and the status."""

    data: FitData
    climb: Climb
    noise: NoiseStd
    start_noise: NoiseStd
    thresholds: NDArray[np.bool_]  # (k,) unknowns that were moved by a scan
    status: str


def data_of(
    model: Model, records: Sequence[Record], measurement: Measurement, unknowns: Unknowns
) -> FitData:
    """Return the data of a search; long records of directly measured states are cut to pieces."""
    pieces: list[Record] = []
    direct = all(i >= 0 for i in measurement.states)  # else the start of a piece is unknown
    for record in records:
        span = float(record.times[-1] - record.times[0])
        many = -(-record.steps // LONG) if direct else 1
        pieces += [record] if many <= 1 else cut(record, span / many)
    return FitData(model.system, tuple(pieces), measurement, unknowns)


def first_search(data: FitData, rng: np.random.Generator, tick: Stages) -> SearchEnd:
    """Search from the start values; with much data, on a random part of the records."""
    draw = enough(data.records, rng)
    if 2 * sum(r.steps for r in draw) <= data.steps:
        data = replace(data, records=tuple(draw))
    return search_parameters(data, data.unknowns.start, None, rng, tick)


def search_parameters(
    data: FitData,
    theta: Array,
    noise: NoiseStd | None,
    rng: np.random.Generator,
    tick: Stages,
) -> SearchEnd:
    """Optimise parameters, thresholds and noise in turn until the likelihood stops increasing."""
    new = noise is None
    tick("noise")
    noise = _noise(data, theta, None, rng) if noise is None else noise
    at, start_noise = point(data, noise, theta), noise
    thresholds = np.zeros(len(theta), dtype=bool)
    if not np.isfinite(at.loglik):
        return SearchEnd(data, _stopped(at), noise, noise, thresholds, at.status)
    if new:
        at = _delays(data, at)
    status = "still rising"
    for round_ in range(ROUNDS):
        _tell(tick, data, at, f", round {round_ + 1} of at most {ROUNDS}")
        before = at.loglik
        slopes = linear(data, at)
        still = quiet(data, slopes) | thresholds
        end = climb(data, noise, at, ~still)
        at = end.at
        if round_ == 0 or at.loglik - before > STIRRED:
            for i in np.flatnonzero(still & np.isfinite(data.unknowns.scale)):
                width = None if new and round_ == 0 else 0.05 * data.unknowns.scale[i]
                moved = coarse_to_fine(data, at, int(i), ~still, width)
                thresholds[i] |= moved is not at
                at = moved
        if at.loglik - before < STIRRED and round_ > 0:
            both = (end.slopes, linear(data, at))  # at a kink the exact gradient can be far off
            promise = min(marquardt_step(data, at.theta, each, ~still, 1e-3)[1] for each in both)
            status = "converged"
            if at is end.at and promise > STUCK:
                status = f"no step improves, though derivatives promise {promise:.1f} nats"
            break
        later = _noise(data, at.theta, noise, rng)
        there = point(data, later, at.theta, at)
        if there.loglik > at.loglik:
            at, noise = there, later
    found = Climb(at, linear(data, at), 0, status)
    return SearchEnd(data, found, noise, start_noise, thresholds, status)


def _tell(tick: Stages, data: FitData, at: Point, part: str) -> None:
    """Report that a round begins, and set the text for an interruption."""
    values = zip(data.unknowns.names, at.theta, data.unknowns.units, strict=True)
    told = ", ".join(f"{name} = {value:.5g} {unit}" for name, value, unit in values)
    tick.so_far = f"so far, not converged yet: {told}"
    tick(f"fit, {at.count} samples", part)


def _stopped(at: Point) -> Climb:
    k = len(at.theta)
    nothing = Linear(np.zeros((k, k)), np.zeros(k), np.zeros((0, k)))
    return Climb(at, nothing, 0, at.status)


def _noise(
    data: FitData, theta: Array, noise: NoiseStd | None, rng: np.random.Generator
) -> NoiseStd:
    """Return the most likely noise at theta, starting from `noise` or from scratch."""
    p, latency = data.unknowns.unpack(theta)
    records = enough(data.records, rng)
    batch = batch_of(records, data.measurement, data.system.n, latency)
    rough = first_noise(batch, data.measurement)
    if noise is None:
        noise = rough
    else:  # a variance that became tiny while the model was wrong would not grow again
        noise = NoiseStd(
            np.maximum(noise.process, REVIVE * rough.process),
            np.maximum(noise.measurement, REVIVE * rough.measurement),
            noise.dt,
        )
    found = maximum_likelihood(data.system, p, batch, data.measurement, noise, rounds=2, wide=True)
    return found.noise


def _delays(data: FitData, at: Point) -> Point:
    """Scan each fitted latency over whole steps, since its start may be far off."""
    first = len(data.unknowns.columns)
    free = ~quiet(data, linear(data, at))
    for i in range(first, data.unknowns.k):
        grid = np.arange(0.0, data.unknowns.high[i] + 1e-9, max(at.noise.dt, 0.02))
        at = profile_of(data, at, i, grid, free)[0]
    return at


COARSE, FINE, ZOOMS = 21, 5, 4  # points of the first grid, half of the later ones; zooms
DROP = 3.67  # [nats] drop of the log-likelihood at the ends of a threshold's interval
GRID = 10  # points between a value inside an interval and one outside
LEVEL = 0.05  # [nats] difference treated as equal
QUIET = 1e-2  # information over the whole range below which a derivative counts as zero


def quiet(data: FitData, slopes: Linear) -> NDArray[np.bool_]:
    """Return which unknowns (k,) do not change the innovations to first order."""
    information = np.diag(slopes.N) * data.unknowns.scale**2
    return np.asarray(information < QUIET)


def profile_of(
    data: FitData,
    at: Point,
    i: int,
    grid: Array,
    free: NDArray[np.bool_] | None,
) -> tuple[Point, Array]:
    """Return the best point with unknown i on a grid, and the profile (len(grid),) [nats].

    The other unknowns are moved by one step if that is better than leaving them.

    Args:
        data: the records.
        at: the values of the others.
        i: the unknown that is scanned.
        grid: its values.
        free: which others may move, (k,); None for none.
    """
    others = np.zeros(data.unknowns.k, dtype=bool) if free is None else free.copy()
    others[i] = False
    profile, best, score = np.full(len(grid), -np.inf), at, at.loglik
    if free is None:
        profile = at.loglik - np.array([fall(data, at, i, value) for value in grid])
        if profile.max() > score:
            best = _with(data, at, i, grid[np.argmax(profile)])
        return best, profile
    for g, value in enumerate(grid):
        here = _with(data, at, i, value)
        profile[g] = here.loglik
        if not np.isfinite(here.loglik):
            continue
        if others.any():
            delta, promise = marquardt_step(data, here.theta, linear(data, here), others, 1e-3)
            profile[g] += promise
        if profile[g] > score:
            best, score = here, float(profile[g])
            if others.any():
                moved = point(data, at.noise, here.theta + delta, here)
                best = moved if moved.loglik > here.loglik else here
    return best, profile


def coarse_to_fine(
    data: FitData,
    at: Point,
    i: int,
    free: NDArray[np.bool_],
    width: float | None = None,
) -> Point:
    """Return the point with the best value of unknown i, over its bounds or within `width`.

    The point is unchanged if no value is better.
    """
    low, high = data.unknowns.low[i], data.unknowns.high[i]
    if width is not None:
        low, high = max(low, at.theta[i] - width), min(high, at.theta[i] + width)
    grid, best = np.linspace(low, high, COARSE), at
    for round_ in range(ZOOMS):
        others = free if round_ == 0 and width is None else None  # small steps hardly affect them
        best, profile = profile_of(data, best, i, grid, others)
        top = np.flatnonzero(profile > profile.max() - LEVEL)
        step = grid[1] - grid[0]
        if len(top) > 2:
            break
        low, high = max(low, grid[top[0]] - step), min(high, grid[top[-1]] + step)
        grid = np.linspace(low, high, 2 * FINE + 1)
    if best.loglik < at.loglik + LEVEL:
        return at
    return _centred(data, best, i, grid[top])


def _centred(data: FitData, best: Point, i: int, level: Array) -> Point:
    """Return the point in the middle of the values that are as good as the best.

    The likelihood is flat between them. The ends of the flat part are where the next samples lie,
    and are no more likely than the middle.
    """
    beside = level[np.argsort(np.abs(level - np.median(level)))]
    for value in beside:
        if fall(data, best, i, value) < LEVEL:
            return _with(data, best, i, value)
    return best


def likelihood_interval(
    data: FitData, at: Point, i: int, inflation: float = 1.0
) -> tuple[float, float]:
    """Return the interval of unknown i in which the log-likelihood is within DROP of the best.

    The likelihood of a threshold is rough, so the outermost such values are searched for, until the
    likelihood has dropped by three times as much. If it never drops that far, the end is a bound.

    Args:
        data: the records.
        at: the best point.
        i: the unknown.
        inflation: factor on DROP for correlated innovations.
    """
    drop = DROP * inflation
    ends = (float(data.unknowns.low[i]), float(data.unknowns.high[i]))
    low, high = (_end(data, at, i, bound, drop) for bound in ends)
    return low, high


def _end(data: FitData, at: Point, i: int, bound: float, drop: float) -> float:
    best = float(at.theta[i])
    span = abs(bound - best)
    if span == 0 or fall(data, at, i, bound) < drop:
        return bound
    sign, step, good = np.sign(bound - best), 1e-3 * span, 0.0
    while step < span:
        fallen = fall(data, at, i, best + sign * step)
        good = step if fallen < drop else good
        if fallen > 3 * drop:
            break
        step *= 2
    far = min(step, span)
    grid = np.linspace(good, far, GRID + 1)[1:-1]
    inside = [g for g in grid if fall(data, at, i, best + sign * g) < drop]
    width = (far - good) / GRID
    good = max([good, *inside])
    outside = min(far, good + width)
    for _ in range(3):
        middle = 0.5 * (good + outside)
        if fall(data, at, i, best + sign * middle) < drop:
            good = middle
        else:
            outside = middle
    return float(best + sign * outside)


def _with(data: FitData, at: Point, i: int, value: float) -> Point:
    """Return the point with another value of unknown i."""
    theta = at.theta.copy()
    theta[i] = value
    return point(data, at.noise, theta, at)
