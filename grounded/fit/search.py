"""The search for the most likely parameters, delays, thresholds and noise.

Three kinds of unknown are moved in turn until the likelihood stops rising: parameters and delays
(Gauss-Newton, `gauss_newton`), thresholds (scanned), the noise (`grounded.estimate.likelihood`).
The noise is not a nuisance: it decides what is an error of the model and what is not. It starts
large, while the model is wrong, and shrinks with it.

A threshold (the car's stall) changes the likelihood in steps: its slope is zero almost everywhere,
and Gauss and Newton can't move it. It is scanned over its bounds, coarse first, then between the
neighbours of the best; so are delays that may start far off. At each value the other unknowns are
credited with what their own linear problem promises, so that a delay is compared with the best lag
beside it, not with the lag of another delay.

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

ROUNDS = 8  # of parameters, thresholds, noise
STIRRED = 0.5  # [nats] a climb that gains less leaves thresholds and noise where they are
STUCK = 1.0  # [nats] a climb that ends though its slopes promise more has not converged
REVIVE = 0.2  # of the rough noise: where each search for the noise begins at least
LONG = 400  # steps; longer records are cut, so that the filter runs over the pieces at once


@dataclass(frozen=True, eq=False)
class SearchEnd:
    """Where a search ended: the last climb, the noise then and at its start, and why."""

    data: FitData
    climb: Climb
    noise: NoiseStd
    start_noise: NoiseStd
    thresholds: NDArray[np.bool_]  # (k,) unknowns that a scan has moved
    status: str


def data_of(
    model: Model, records: Sequence[Record], measurement: Measurement, unknowns: Unknowns
) -> FitData:
    """Records for a search; long ones whose states are measured directly are cut into pieces."""
    pieces: list[Record] = []
    direct = all(i >= 0 for i in measurement.states)  # else a piece would not know its start
    for record in records:
        span = float(record.times[-1] - record.times[0])
        many = -(-record.steps // LONG) if direct else 1
        pieces += [record] if many <= 1 else cut(record, span / many)
    return FitData(model.system, tuple(pieces), measurement, unknowns)


def first_search(data: FitData, rng: np.random.Generator, tick: Stages) -> SearchEnd:
    """From the start values; of much data on a draw, from where the whole is soon climbed."""
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
    """Parameters, thresholds and noise in turn until the likelihood stops rising."""
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
        _tell(tick, data, at)
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
            both = (end.slopes, linear(data, at))  # at a kink the exact ones can be far off
            promise = min(marquardt_step(data, at.theta, each, ~still, 1e-3)[1] for each in both)
            status = "converged"
            if at is end.at and promise > STUCK:
                status = f"no step rises, though slopes promise {promise:.1f} nats"
            break
        later = _noise(data, at.theta, noise, rng)
        there = point(data, later, at.theta, at)
        if there.loglik > at.loglik:
            at, noise = there, later
    found = Climb(at, linear(data, at), 0, status)
    return SearchEnd(data, found, noise, start_noise, thresholds, status)


def _tell(tick: Stages, data: FitData, at: Point) -> None:
    """A round begins; what would be said if it were the last."""
    values = zip(data.unknowns.names, at.theta, data.unknowns.units, strict=True)
    told = ", ".join(f"{name} = {value:.5g} {unit}" for name, value, unit in values)
    tick.so_far = f"so far, not at the top yet: {told}"
    tick(f"climb, {at.count} samples")


def _stopped(at: Point) -> Climb:
    k = len(at.theta)
    nothing = Linear(np.zeros((k, k)), np.zeros(k), np.zeros((0, k)))
    return Climb(at, nothing, 0, at.status)


def _noise(
    data: FitData, theta: Array, noise: NoiseStd | None, rng: np.random.Generator
) -> NoiseStd:
    """The most likely noise at theta, from where it was or from scratch."""
    p, latency = data.unknowns.unpack(theta)
    records = enough(data.records, rng)
    batch = batch_of(records, data.measurement, data.system.n, latency)
    rough = first_noise(batch, data.measurement)
    if noise is None:
        noise = rough
    else:  # a variance that sank while the model was wrong would not rise again by itself
        noise = NoiseStd(
            np.maximum(noise.process, REVIVE * rough.process),
            np.maximum(noise.measurement, REVIVE * rough.measurement),
            noise.dt,
        )
    found = maximum_likelihood(data.system, p, batch, data.measurement, noise, rounds=2, wide=True)
    return found.noise


def _delays(data: FitData, at: Point) -> Point:
    """Each fitted latency from a scan over whole steps: it may begin far off."""
    first = len(data.unknowns.columns)
    free = ~quiet(data, linear(data, at))
    for i in range(first, data.unknowns.k):
        grid = np.arange(0.0, data.unknowns.high[i] + 1e-9, max(at.noise.dt, 0.02))
        at = profile_of(data, at, i, grid, free)[0]
    return at


COARSE, FINE, ZOOMS = 21, 5, 4
DROP = 3.67  # [nats]
GRID = 10  # points between a value that is as good and one that is not
LEVEL = 0.05  # [nats] as good as equal
QUIET = 1e-2  # information over the whole range below which a slope says nothing


def quiet(data: FitData, slopes: Linear) -> NDArray[np.bool_]:
    """Unknowns (k,) on which the innovations do not depend to first order."""
    information = np.diag(slopes.N) * data.unknowns.scale**2
    return np.asarray(information < QUIET)


def profile_of(
    data: FitData,
    at: Point,
    i: int,
    grid: Array,
    free: NDArray[np.bool_] | None,
) -> tuple[Point, Array]:
    """The best point with unknown i on a grid, and the profile (len(grid),) [nats].

    The other unknowns are moved by one step of theirs if that is better than leaving them.

    Args:
        data: the records.
        at: where the others are.
        i: the unknown that is scanned.
        grid: its values.
        free: which others may move, (k,); None: none.
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
    """The best value of unknown i: over its bounds, or within `width` of where it is.

    Stays where it is if nothing is better.
    """
    low, high = data.unknowns.low[i], data.unknowns.high[i]
    if width is not None:
        low, high = max(low, at.theta[i] - width), min(high, at.theta[i] + width)
    grid, best = np.linspace(low, high, COARSE), at
    for round_ in range(ZOOMS):
        others = (
            free if round_ == 0 and width is None else None
        )  # small steps hardly matter to them
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
    """The middle of the values that are as good as the best: the likelihood is flat between them.

    An end of the level is where the next sample lies, and nothing says that it is the threshold.
    """
    beside = level[np.argsort(np.abs(level - np.median(level)))]
    for value in beside:
        if fall(data, best, i, value) < LEVEL:
            return _with(data, best, i, value)
    return best


def likelihood_interval(
    data: FitData, at: Point, i: int, inflation: float = 1.0
) -> tuple[float, float]:
    """The values of unknown i around the best whose log-likelihood is within DROP of it.

    The likelihood of a threshold is rough: the outermost such value counts, sought as far as it has
    fallen for good. A bound of the unknown is returned where it never falls that far.

    Args:
        data: the records.
        at: the best point.
        i: the unknown.
        inflation: what DROP is multiplied by where innovations are correlated.
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
    """The same point but for unknown i."""
    theta = at.theta.copy()
    theta[i] = value
    return point(data, at.noise, theta, at)
