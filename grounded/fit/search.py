"""The search for the most likely parameters, delays, thresholds and noise.

Three kinds of unknown are moved in turn until the likelihood stops rising: parameters and delays
(Gauss-Newton, `gauss_newton`), thresholds (`scan`), and the noise (`grounded.estimate.likelihood`).
The noise is not a nuisance: it decides what is an error of the model and what is not. It starts
large, while the model is wrong, and shrinks with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from grounded.estimate import Measurement, Noise, Record, cut
from grounded.estimate.batch import batch_of
from grounded.estimate.likelihood import enough, first_noise, maximum_likelihood
from grounded.fit.gauss_newton import Climb, Data, Linear, Point, climb, linear, point
from grounded.fit.scan import coarse_to_fine, quiet, scan
from grounded.fit.unknowns import Unknowns
from grounded.frozen import Array
from grounded.model import Model

ROUNDS = 8  # of parameters, thresholds, noise
STIRRED = 0.5  # [nats] a climb that gains less leaves thresholds and noise where they are
REVIVE = 0.2  # of the rough noise: where each search for the noise begins at least
LONG = 400  # steps; longer records are cut, so that the filter runs over the pieces at once


@dataclass(frozen=True, eq=False)
class Found:
    """Where a search ended: the last climb, the noise then and at its start, and why."""

    data: Data
    climb: Climb
    noise: Noise
    start_noise: Noise
    thresholds: NDArray[np.bool_]  # (k,) unknowns that a scan has moved
    status: str


def data_of(
    model: Model, records: Sequence[Record], measurement: Measurement, unknowns: Unknowns
) -> Data:
    """Records for a search; long ones whose states are measured directly are cut into pieces."""
    pieces: list[Record] = []
    direct = all(i >= 0 for i in measurement.states)  # else a piece would not know its start
    for record in records:
        span = float(record.times[-1] - record.times[0])
        many = -(-record.steps // LONG) if direct else 1
        pieces += [record] if many <= 1 else cut(record, span / many)
    return Data(model.system, tuple(pieces), measurement, unknowns)


def first_search(data: Data, rng: np.random.Generator) -> Found:
    """From the start values; much data are searched on a draw of them first."""
    draw = enough(data.records, rng)
    if 2 * sum(r.steps for r in draw) > sum(r.steps for r in data.records):
        return search(data, data.unknowns.start, None, rng)
    rough = search(replace(data, records=tuple(draw)), data.unknowns.start, None, rng)
    if not np.isfinite(rough.climb.at.loglik):
        return rough
    found = search(data, rough.climb.at.theta, rough.noise, rng)
    return replace(found, start_noise=rough.start_noise)


def search(data: Data, theta: Array, noise: Noise | None, rng: np.random.Generator) -> Found:
    """Parameters, thresholds and noise in turn until the likelihood stops rising."""
    new = noise is None
    noise = _noise(data, theta, None, rng) if noise is None else noise
    at, start_noise = point(data, noise, theta), noise
    thresholds = np.zeros(len(theta), dtype=bool)
    if not np.isfinite(at.loglik):
        return Found(data, _stopped(at), noise, noise, thresholds, at.filtered.status)
    if new:
        at = _delays(data, noise, at)
    status = "still rising"
    for round_ in range(ROUNDS):
        before = at.loglik
        slopes = linear(data, at)
        still = quiet(data, slopes) | thresholds
        at = climb(data, noise, at, ~still).at
        if round_ == 0 or at.loglik - before > STIRRED:
            for i in np.flatnonzero(still & np.isfinite(data.unknowns.scale)):
                width = None if new and round_ == 0 else 0.05 * data.unknowns.scale[i]
                moved = coarse_to_fine(data, noise, at, int(i), ~still, width)
                thresholds[i] |= moved is not at
                at = moved
        if at.loglik - before < STIRRED and round_ > 0:
            status = "converged"
            break
        later = _noise(data, at.theta, noise, rng)
        there = point(data, later, at.theta, at)
        if there.loglik > at.loglik:
            at, noise = there, later
    found = Climb(at, linear(data, at), 0, status)
    return Found(data, found, noise, start_noise, thresholds, status)


def _stopped(at: Point) -> Climb:
    k = len(at.theta)
    nothing = Linear(np.zeros((0, k)), np.zeros(0), np.zeros(0, dtype=np.int64))
    return Climb(at, nothing, 0, at.filtered.status)


def _noise(data: Data, theta: Array, noise: Noise | None, rng: np.random.Generator) -> Noise:
    """The most likely noise at theta, from where it was or from scratch."""
    p, latency = data.unknowns.unpack(theta)
    records = enough(data.records, rng)
    batch = batch_of(records, data.measurement, data.system.n, latency)
    rough = first_noise(batch, data.measurement, round(float(np.median(batch.dt[batch.valid])), 9))
    if noise is None:
        noise = rough
    else:  # a variance that sank while the model was wrong would not rise again by itself
        noise = Noise(
            np.maximum(noise.process, REVIVE * rough.process),
            np.maximum(noise.measurement, REVIVE * rough.measurement),
            noise.dt,
        )
    found = maximum_likelihood(data.system, p, batch, data.measurement, noise, rounds=2, wide=True)
    return found.noise


def _delays(data: Data, noise: Noise, at: Point) -> Point:
    """Each fitted latency from a scan over whole steps: it may begin far off."""
    first = len(data.unknowns.columns)
    free = ~quiet(data, linear(data, at))
    for i in range(first, data.unknowns.k):
        grid = np.arange(0.0, data.unknowns.high[i] + 1e-9, max(noise.dt, 0.02))
        at = scan(data, noise, at, i, grid, free)[0]
    return at
