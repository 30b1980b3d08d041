"""The likelihood at one theta and its derivatives: one pass of the filter over the records.

    eps(theta): the whitened innovations;        W = d eps / d theta  (`extended.sensitivity`)
    g = -W' eps: gradient of the log-likelihood for fixed gains;       N = W'W: information

The sum of squares of eps is the residual in units of the noise; the log-likelihood adds the
log-determinants; N is the information of the data about theta. The filter's gains depend on theta
too, through A = f_x; `exact` adds their contribution to the gradient,

    sum_t <(q q' - N) A P, dA / d theta>                           q, N: the smoother's

Records are independent, so parts of them run in parallel (`grounded.engine.each`). The division
into parts depends on the records alone, and parts are summed in order, so the result does not
depend on the number of workers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from grounded.compile import System
from grounded.engine import SentOnce, each
from grounded.estimate import Measurement, NoiseStd, Record
from grounded.estimate.extended import Filtered, Track, filter_batch, sensitivity
from grounded.estimate.record import RecordBatch, batch_of
from grounded.estimate.steps import ModelSteps
from grounded.filter.kalman import smoother
from grounded.fit.unknowns import Unknowns
from grounded.frozen import Array

PART = 8  # records in a part: the lanes of the widest vector registers
SMALL = 8_000  # total steps up to which records are not divided
APART = 1e-4  # half the span of a difference, relative to an unknown's value or scale
BLOCKS = 60  # approximate number of time blocks whose gradients are kept for intervals
Wanted = Literal["value", "slopes", "exact"]


@dataclass(frozen=True, eq=False)
class FitData(SentOnce):
    """Everything that a likelihood needs except theta and the noise."""

    system: System
    records: tuple[Record, ...]
    measurement: Measurement
    unknowns: Unknowns
    last: dict[bytes, RecordBatch] = field(default_factory=dict, init=False)  # last one, by latency

    @property
    def steps(self) -> int:
        """Total number of steps."""
        return sum(record.steps for record in self.records)

    @cached_property
    def parts(self) -> tuple[FitData, ...]:
        """The data divided into parts of a few records each."""
        if self.steps <= SMALL or len(self.records) <= PART:
            return (self,)
        starts = range(0, len(self.records), PART)
        return tuple(replace(self, records=self.records[i : i + PART]) for i in starts)

    @property
    def pieces(self) -> int:
        """Number of time blocks of each record, for intervals."""
        return max(1, round(BLOCKS / len(self.records)))

    def batch(self, theta: Array) -> RecordBatch:
        """Return the records as a batch, with inputs delayed by theta's latencies."""
        latency = self.unknowns.unpack(theta)[1]
        if (found := self.last.get(latency.tobytes())) is None:
            found = batch_of(self.records, self.measurement, self.system.n, latency)
            self.last.clear()
            self.last[latency.tobytes()] = found
        return found


@dataclass(frozen=True, eq=False)
class Linear:
    """Derivatives at a point, over all samples."""

    N: Array  # (k, k) W'W
    g: Array  # (k,) gradient of the log-likelihood
    scores: Array  # (blocks, k) W' eps of each time block


@dataclass(frozen=True, eq=False)
class Pass:
    """The result of a filter's pass over one part."""

    track: Track
    loglik: Array  # (B,) of each record; minus infinity where the filter diverged
    count: int  # number of measured samples
    slopes: Linear | None
    status: str


@dataclass(frozen=True, eq=False)
class Point:
    """The likelihood at one theta."""

    theta: Array
    noise: NoiseStd
    passes: tuple[Pass, ...]  # one for each part of the data

    @property
    def loglik(self) -> float:
        """Log-likelihood of the innovations; minus infinity if the filter diverged."""
        return float(sum(one.loglik.sum() for one in self.passes))

    @property
    def count(self) -> int:
        """Number of measured samples."""
        return sum(one.count for one in self.passes)

    @property
    def status(self) -> str:
        """Status of the filter, that of the first part in which it diverged, if any."""
        stopped = [one.status for one in self.passes if not np.isfinite(one.loglik).all()]
        return (stopped or [self.passes[0].status])[0]


def point(
    data: FitData,
    noise: NoiseStd,
    theta: Array,
    near: Point | None = None,
    wanted: Wanted = "slopes",
) -> Point:
    """Run the filter once at theta.

    Args:
        data: the records.
        noise: process and measurement noise.
        theta: (k,).
        near: a nearby point, which saves time.
        wanted: the likelihood alone ("value"), or derivatives too ("slopes", "exact").
    """
    about = [None] * len(data.parts) if near is None else [one.track for one in near.passes]
    asked = (noise, theta, data.pieces, wanted)
    passes = each(_pass, data.parts, about, [asked] * len(about))
    return Point(theta, noise, tuple(passes))


def linear(data: FitData, at: Point) -> Linear:
    """Return the derivatives at a point of finite likelihood."""
    if any(one.slopes is None for one in at.passes):
        at = point(data, at.noise, at.theta, at)
    return _sum([one.slopes for one in at.passes if one.slopes is not None])


def exact(data: FitData, at: Point) -> Linear:
    """Return the derivatives including the dependence of the filter's gains on the parameters."""
    passes = point(data, at.noise, at.theta, at, "exact").passes
    return _sum([one.slopes for one in passes if one.slopes is not None])


def differenced(data: FitData, at: Point) -> Linear:
    """Return the derivatives with a gradient by differences of the log-likelihood itself.

    `exact` differentiates A = f_x at the track's points, but the filter takes the slope over its
    uncertainty. For a state that no sensor measures, in a model that bends, they differ by much.
    """
    slopes, unknowns = linear(data, at), data.unknowns
    gradient = np.zeros(unknowns.k)
    for i in range(unknowns.k):
        size = APART * min(unknowns.scale[i], max(abs(at.theta[i]), 1e-3))
        low, high = np.clip(
            at.theta[i] + np.array([-size, size]), unknowns.low[i], unknowns.high[i]
        )
        gradient[i] = (fall(data, at, i, low) - fall(data, at, i, high)) / (high - low)
    return replace(slopes, g=gradient)


def fall(data: FitData, at: Point, i: int, value: float) -> float:
    """Return the loss of log-likelihood with another value of unknown i.

    Only the records that the change affects are filtered again: a threshold acts on few samples.
    """
    theta = at.theta.copy()
    theta[i] = value
    many = len(data.parts)
    return float(sum(each(_fall, data.parts, at.passes, [(at.noise, at.theta, theta)] * many)))


def _pass(part: FitData, about: Track | None, asked: tuple[NoiseStd, Array, int, Wanted]) -> Pass:
    noise, theta, pieces, wanted = asked
    batch, p = part.batch(theta), part.unknowns.unpack(theta)[0]
    steps = ModelSteps(part.system, p, batch, wide=True)
    f = filter_batch(batch, part.measurement, noise, steps, about)
    k, loglik = part.unknowns.k, np.full(len(part.records), -np.inf)
    slopes = Linear(np.zeros((k, k)), np.zeros(k), np.zeros((len(part.records) * pieces, k)))
    if np.isfinite(f.loglik):
        numbers = batch.seen.sum(axis=(0, 2)) * np.log(2 * np.pi)
        loglik = -0.5 * ((f.eps**2).sum(axis=(0, 2)) + f.gains.logdet.sum(axis=0) + numbers)
        if wanted != "value":
            slopes = _slopes(part, batch, theta, f, pieces)
        if wanted == "exact":
            slopes = replace(slopes, g=slopes.g + _by_gains(part, batch, theta, f))
    track = Track(f.x, f.std, f.x_prior)
    return Pass(track, loglik, batch.count, None if wanted == "value" else slopes, f.status)


def _sum(parts: Sequence[Linear]) -> Linear:
    N, g = sum(one.N for one in parts), sum(one.g for one in parts)
    return Linear(np.asarray(N), np.asarray(g), np.concatenate([one.scores for one in parts]))


def _slopes(part: FitData, batch: RecordBatch, theta: Array, f: Filtered, pieces: int) -> Linear:
    seen, block = batch.seen, _blocks(batch, pieces)[batch.seen]
    W, eps = whitened(part, batch, theta, f)[seen], f.eps[seen]
    count = batch.seen.shape[1] * pieces
    scores = [np.bincount(block, column * eps, minlength=count) for column in W.T]
    return Linear(W.T @ W, -W.T @ eps, np.stack(scores, axis=1))


def whitened(part: FitData, batch: RecordBatch, theta: Array, f: Filtered) -> Array:
    """Return W, the derivative of a pass's whitened innovations, (T + 1, B, ny, k)."""
    return sensitivity(f, _change_of_the_next_state(part, batch, theta, f))


def _by_gains(part: FitData, batch: RecordBatch, theta: Array, f: Filtered) -> Array:
    """Return the gains' contribution to the gradient of the log-likelihood, (k,)."""
    unknowns, more = part.unknowns, np.zeros(part.unknowns.k)
    p, back = unknowns.unpack(theta)[0], smoother(f.gains, f.eps, covariances=True)
    assert back.whole is not None
    q = back.r[1:, ..., None]
    said = (q * q.swapaxes(-1, -2) - back.whole[1:]) @ f.A @ f.gains.posterior[:-1]
    for h, mask in batch.steps_of:
        rows = batch.valid if mask is None else mask & batch.valid
        x, u = f.x[:-1][rows], batch.u[rows]
        A = part.system.linearise(x, u, p, h)[0]
        for i, column in enumerate(unknowns.columns):
            moved, size = p.copy(), 1e-5 * max(abs(p[column]), 1e-3)
            moved[column] += size
            change = (part.system.linearise(x, u, moved, h)[0] - A) / size
            more[i] += float(np.sum(said[rows] * change))
    return more


def _change_of_the_next_state(
    part: FitData, batch: RecordBatch, theta: Array, f: Filtered
) -> Array:
    """Return f_theta along the filtered track, (T, B, n, k)."""
    unknowns, (T, B, n) = part.unknowns, f.more.shape
    p = unknowns.unpack(theta)[0]
    out = np.zeros((T, B, n, unknowns.k))
    params = len(unknowns.columns)
    for h, mask in batch.steps_of:
        rows = batch.valid if mask is None else mask & batch.valid
        x, u = f.x[:-1][rows], batch.u[rows]
        _, f_u, f_p = part.system.sensitivities(x, u, p, h)
        found = np.empty((len(x), n, unknowns.k))
        found[..., :params] = f_p[..., list(unknowns.columns)]
        for i, inputs in enumerate(unknowns.delayed):
            moved = batch.u_latency[rows][:, None, list(inputs)]
            found[..., params + i] = np.sum(f_u[..., list(inputs)] * moved, axis=-1)
        out[rows] = found
    return out


def _blocks(batch: RecordBatch, pieces: int) -> NDArray[np.int64]:
    """Return a block number for each sample, (T + 1, B, ny): contiguous in time, in one record."""
    T1, B, ny = batch.seen.shape
    within = np.arange(T1)[:, None] * pieces // np.maximum(batch.lengths + 1, 1)
    number = np.minimum(within, pieces - 1) + pieces * np.arange(B)
    return np.asarray(np.repeat(number[..., None], ny, axis=2))


def _fall(part: FitData, here: Pass, asked: tuple[NoiseStd, Array, Array]) -> float:
    noise, as_it_is, theta = asked
    acts = _acts(part, here.track, as_it_is, theta)
    if not acts.any():
        return 0.0
    some = tuple(r for r, a in zip(part.records, acts, strict=True) if a)
    track = here.track
    about = Track(track.x[:, acts], track.std[:, acts], track.x_prior[:, acts])
    changed = part if acts.all() else replace(part, records=some)
    there = _pass(changed, about, (noise, theta, 1, "value"))
    return float(here.loglik[acts].sum() - there.loglik.sum())


def _acts(part: FitData, track: Track, as_it_is: Array, theta: Array) -> NDArray[np.bool_]:
    """Return which records (B,) are affected by the change to theta, along their tracks."""
    (p, latency), (here, before) = part.unknowns.unpack(theta), part.unknowns.unpack(as_it_is)
    if (latency != before).any():
        return np.ones(len(part.records), dtype=bool)
    one, other = (
        ModelSteps(part.system, values, part.batch(as_it_is), wide=True).along(
            track.x[:-1], track.std[:-1]
        )
        for values in (here, p)
    )
    apart = [
        (a != b).reshape(*a.shape[:2], -1).any(axis=(0, 2)) for a, b in zip(one, other, strict=True)
    ]
    return np.asarray(np.any(apart, axis=0))
