"""fit: the parameters of any model from trials, by maximum likelihood of the innovations.

Three kinds of unknown are moved in turn until the likelihood stops rising: parameters and delays
(Gauss-Newton, `gauss_newton`), thresholds (`scan`), and the noise (`grounded.estimate.likelihood`).
The noise is not a nuisance: it decides what is an error of the model and what is not. It starts
large, while the model is wrong, and shrinks with it.

The last quarter of the time is held out: it judges the model before and after, one step and a
second ahead (`prediction`), then joins the rest for the final values and their intervals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from grounded.errors import GroundedError
from grounded.estimate import Measurement, Noise, Record, cut, of_states
from grounded.estimate.batch import batch_of
from grounded.estimate.likelihood import enough, first_noise, maximum_likelihood
from grounded.estimate.record import part, records_of
from grounded.fit.gauss_newton import Climb, climb
from grounded.fit.innovations import Data, Point, linear, point
from grounded.fit.interval import Spread, spread
from grounded.fit.prediction import PredictionError, prediction_error
from grounded.fit.scan import coarse_to_fine, likelihood_interval, quiet, scan
from grounded.fit.unknowns import Latency, Unknowns, unknowns_of
from grounded.frozen import Array
from grounded.model import Model
from grounded.task import Task
from grounded.trial import Trial

ROUNDS = 8  # of parameters, thresholds, noise
STIRRED = 0.5  # [nats] a climb that gains less leaves thresholds and noise where they are
REVIVE = 0.2  # of the rough noise: where each search for the noise begins at least
LONG = 400  # steps; longer records are cut, so that the filter runs over the pieces at once


@dataclass(frozen=True, eq=False)
class Estimate:
    """One fitted quantity with its 95 % interval; `std` is infinite where not identified."""

    value: float
    std: float
    low: float
    high: float
    unit: str
    identified: bool
    start: float


@dataclass(frozen=True, eq=False)
class Fit:
    """What a fit found.

    `params` holds the model's parameters and, if fitted, `latency` or `latency:<input>` [s].
    """

    params: Mapping[str, Estimate]
    model: Model  # with the fitted values
    latency: Array  # (m,) [s]
    noise: Noise
    loglik: float
    status: str  # converged, still rising, or why it stopped
    sentence: str
    before: PredictionError | None  # on held-out time; None: too little data to hold any out
    after: PredictionError | None
    samples: int
    covariance: Array = field(repr=False)  # (k, k), in the order of params

    def __post_init__(self) -> None:
        object.__setattr__(self, "params", MappingProxyType(dict(self.params)))


def fit(
    model: Model | Task,
    trials: Sequence[Trial | Record],
    names: Sequence[str] | None = None,
    *,
    latency: Array | None = None,
    fit_latency: Latency = "known",
    measurement: Measurement | None = None,
    hold_out: float = 0.25,
    horizon_s: float = 1.0,
    rng: np.random.Generator | None = None,
) -> Fit:
    """Parameters of a model from trials, with intervals.

    Args:
        model: where to begin, with bounds; a task also says the latency.
        trials: real trials, or records with clocks of their own.
        names: parameters to fit; None: all.
        latency: of each input [s], known, or where to begin, (m,); None: zero (or the task's).
        fit_latency: "known", "common" (fit one for all inputs) or "each".
        measurement: what the records measure; None: the states as they are.
        hold_out: share of the time that judges the fit.
        horizon_s: how far ahead predictions are judged [s].
        rng: draws the trials that the noise is estimated on, if there are very many.

    Raises:
        GroundedError: for an unknown name, trials that do not fit the model, or too short ones.
    """
    if isinstance(model, Task):
        latency = model.latency if latency is None else latency
        model = model.model
    delay = np.zeros(model.m) if latency is None else np.asarray(latency, float)
    measurement = of_states(model) if measurement is None else measurement
    unknowns = unknowns_of(model, names, delay, fit_latency)
    records = records_of(model, trials)
    if max(r.steps for r in records) < 3:
        raise GroundedError("a fit needs a trial of at least 3 steps")
    rng = np.random.default_rng(0) if rng is None else rng
    train, test = _held_out(records, hold_out, horizon_s, measurement)
    first = _first(_data(model, train, measurement, unknowns), rng)
    before = after = None
    if test and np.isfinite(first.climb.at.loglik):
        before, after = _judged(model, test, measurement, unknowns, first, horizon_s)
        last = _search(
            _data(model, records, measurement, unknowns), first.climb.at.theta, first.noise, rng
        )
    else:
        last = first
    return _report(model, unknowns, last, before, after)


@dataclass(frozen=True, eq=False)
class _Found:
    data: Data
    climb: Climb
    noise: Noise
    start_noise: Noise
    thresholds: NDArray[np.bool_]
    status: str


def _data(
    model: Model, records: Sequence[Record], measurement: Measurement, unknowns: Unknowns
) -> Data:
    pieces: list[Record] = []
    direct = all(i >= 0 for i in measurement.states)  # else a piece would not know its start
    for record in records:
        span = float(record.times[-1] - record.times[0])
        many = -(-record.steps // LONG) if direct else 1
        pieces += [record] if many <= 1 else cut(record, span / many)
    return Data(model.system, tuple(pieces), measurement, unknowns)


def _first(data: Data, rng: np.random.Generator) -> _Found:
    """From the start values; much data are searched on a draw of them first."""
    draw = enough(data.records, rng)
    if 2 * sum(r.steps for r in draw) > sum(r.steps for r in data.records):
        return _search(data, data.unknowns.start, None, rng)
    rough = _search(replace(data, records=tuple(draw)), data.unknowns.start, None, rng)
    if not np.isfinite(rough.climb.at.loglik):
        return rough
    found = _search(data, rough.climb.at.theta, rough.noise, rng)
    return replace(found, start_noise=rough.start_noise)


def _search(data: Data, theta: Array, noise: Noise | None, rng: np.random.Generator) -> _Found:
    """Parameters, thresholds and noise in turn until the likelihood stops rising."""
    new = noise is None
    noise = _noise(data, theta, None, rng) if noise is None else noise
    at, start_noise = point(data, noise, theta), noise
    thresholds = np.zeros(len(theta), dtype=bool)
    if not np.isfinite(at.loglik):
        return _Found(data, _stopped(at), noise, noise, thresholds, at.filtered.status)
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
    return _Found(data, found, noise, start_noise, thresholds, status)


def _stopped(at: Point) -> Climb:
    from grounded.fit.innovations import Linear

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


def _held_out(
    records: Sequence[Record], share: float, horizon_s: float, measurement: Measurement
) -> tuple[list[Record], list[Record]]:
    """The first and the last part of every record.

    Whole records where they are short, or where the state in their middle is not measured.
    """
    train, test = [], []
    if any(i < 0 for i in measurement.states):
        horizon_s = np.inf
    long = [r for r in records if share * (r.times[-1] - r.times[0]) > 1.5 * horizon_s]
    if share > 0 and len(long) * 2 >= len(records):
        for record in records:
            edge = round((1 - share) * record.steps)
            train.append(part(record, 0, edge) if record in long else record)
            if record in long:
                test.append(part(record, edge, record.steps))
        return train, test
    every = round(1 / share) if share > 0 else 0
    if every and len(records) >= every:
        test = list(records[every - 1 :: every])
        return [r for r in records if r not in test], test
    return list(records), []


def _judged(
    model: Model,
    test: Sequence[Record],
    measurement: Measurement,
    unknowns: Unknowns,
    found: _Found,
    horizon_s: float,
) -> tuple[PredictionError, PredictionError]:
    """Held-out prediction errors of the model before and after, each with its own noise."""
    pairs = ((unknowns.start, found.start_noise), (found.climb.at.theta, found.noise))
    judged = []
    for theta, noise in pairs:
        p, latency = unknowns.unpack(theta)
        there = model.with_values(dict(zip(model.param_names, p.tolist(), strict=True)))
        judged.append(
            prediction_error(
                there, test, horizon_s, latency=latency, measurement=measurement, noise=noise
            )
        )
    return judged[0], judged[1]


def _report(
    model: Model,
    unknowns: Unknowns,
    last: _Found,
    before: PredictionError | None,
    after: PredictionError | None,
) -> Fit:
    at = last.climb.at
    params, wide = _estimates(unknowns, last)
    p, latency = unknowns.unpack(at.theta)
    return Fit(
        params=params,
        model=model.with_values(dict(zip(model.param_names, p.tolist(), strict=True))),
        latency=latency,
        noise=last.noise,
        loglik=at.loglik,
        status=last.status,
        sentence=_sentence(unknowns, params, wide, last),
        before=before,
        after=after,
        samples=at.batch.count,
        covariance=wide.covariance,
    )


def _estimates(unknowns: Unknowns, found: _Found) -> tuple[dict[str, Estimate], Spread]:
    at, scanned = found.climb.at, np.zeros(unknowns.k, dtype=bool)
    if not np.isfinite(at.loglik):
        k = unknowns.k
        wide = Spread(np.full(k, np.inf), np.zeros((k, k)), ())
    else:
        scanned = quiet(found.data, found.climb.slopes) | found.thresholds
        smooth, scanned = ~scanned, scanned & np.isfinite(unknowns.scale)
        wide = spread(found.climb.slopes, smooth)
    params: dict[str, Estimate] = {}
    for i, name in enumerate(unknowns.names):
        value, std = float(at.theta[i]), float(wide.std[i])
        low, high = value - 1.96 * std, value + 1.96 * std
        if scanned[i]:
            low, high = likelihood_interval(found.data, found.noise, at, i)
            std = (high - low) / (2 * 1.96)
        range_ = unknowns.high[i] - unknowns.low[i]
        std = np.inf if high - low >= range_ else std
        known = bool(np.isfinite(std) and std < range_ / np.sqrt(12))
        low, high = max(low, float(unknowns.low[i])), min(high, float(unknowns.high[i]))
        start = float(unknowns.start[i])
        params[name] = Estimate(value, std, low, high, unknowns.units[i], known, start)
    return params, wide


def _sentence(
    unknowns: Unknowns, params: Mapping[str, Estimate], wide: Spread, found: _Found
) -> str:
    if not np.isfinite(found.climb.at.loglik):
        return f"nothing was fitted: {found.status}; check units, signs and start values"
    parts = [found.status]
    unknown = [name for name, estimate in params.items() if not estimate.identified]
    if unknown:
        parts.append("the data do not identify " + ", ".join(unknown))
    for group in wide.together:
        if len(group) > 1:
            names = ", ".join(unknowns.names[i] for i in group)
            parts.append(f"only a combination of {names} is identified")
    theta = found.climb.at.theta
    edge = np.isclose(theta, unknowns.low) | np.isclose(theta, unknowns.high)
    held = [unknowns.names[i] for i in np.flatnonzero(edge) if params[unknowns.names[i]].identified]
    if held:
        parts.append("at a bound: " + ", ".join(held))
    return "; ".join(parts)
