"""Levenberg and Marquardt's climb of the likelihood for a given noise, within bounds.

What is fitted, parameters of the model and delays of its inputs, is one vector theta (`Unknowns`).
The least-squares problem are the whitened innovations of the filter and their slopes,

    eps(theta): the filter's, with f(.; theta);      W = d eps / d theta  (`extended.sensitivity`)
    delta = -(W'W + lambda diag(W'W))^-1 W' eps,     theta <- clip(theta + delta)

The sum of squares of eps is what is left unexplained, measured in the noise; the log-likelihood
adds the log-determinants; W'W is the information that the data hold about theta. Because every step
of a trial starts from what the filter knows, noise of the measurements does not bias the fit, as it
does in one-step least squares (errors in variables).

The filter's gains depend on theta too, through A = f_x. Gauss and Newton leave that out, and where
the model stiffens with theta the step then leads down and theta would stay where it began. So a
climb that rises no further goes on with the exact slope (`exact`), and ends where that has none:

    d loglik / d theta = -W' eps + sum_t <(q q' - N) A P, dA / d theta>    q, N: the smoother's

A step counts if the log-likelihood rises; else lambda grows. Unknowns at a bound that would leave
it are held; directions of which the data say nothing are not moved.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from grounded.compile import System
from grounded.errors import GroundedError, nearest
from grounded.estimate import Measurement, NoiseStd, Record
from grounded.estimate.extended import Filtered, filter_batch, sensitivity
from grounded.estimate.record import RecordBatch, batch_of
from grounded.estimate.steps import ModelSteps
from grounded.filter.kalman import smoother
from grounded.frozen import Array
from grounded.model import Model

Latency = Literal["known", "common", "each"]
LONGEST = 0.5  # [s] no latency is sought beyond
STDS = 3.0  # prior standard deviations that a parameter without bounds may move
BOUNDS = (
    "what may move has bounds, Param(value, unit, low, high), or a prior, Param(value, unit, std=s)"
)


@dataclass(frozen=True, eq=False)
class Unknowns:
    """theta = [parameters, latencies]: names, bounds, scales, and the way back to the model.

    The scale is a natural size of a change: the width of the bounds where both are given.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    start: Array  # (k,)
    low: Array  # (k,) may be -inf
    high: Array  # (k,) may be inf
    scale: Array  # (k,)
    columns: tuple[int, ...]  # of the model's parameters that are fitted
    delayed: tuple[tuple[int, ...], ...]  # inputs that each fitted latency delays
    values: Array  # all parameters of the model
    latency: Array  # (m,) [s] of all inputs

    @property
    def k(self) -> int:
        """Number of unknowns."""
        return len(self.names)

    def unpack(self, theta: Array) -> tuple[Array, Array]:
        """All parameter values and all latencies [s] at theta."""
        p, latency = self.values.copy(), self.latency.copy()
        p[list(self.columns)] = theta[: len(self.columns)]
        for value, inputs in zip(theta[len(self.columns) :], self.delayed, strict=True):
            latency[list(inputs)] = value
        return p, latency

    def less(self, index: int) -> Unknowns:
        """The same without one unknown, which stays at its start."""
        kept = np.delete(np.arange(self.k), index)
        names, units = (tuple(each[i] for i in kept) for each in (self.names, self.units))
        columns = tuple(c for i, c in enumerate(self.columns) if i != index)
        first = len(self.columns)
        delayed = tuple(d for i, d in enumerate(self.delayed, first) if i != index)
        arrays = {key: getattr(self, key)[kept] for key in ("start", "low", "high", "scale")}
        return replace(self, names=names, units=units, columns=columns, delayed=delayed, **arrays)

    def clipped(self, theta: Array) -> Array:
        """Theta within the bounds."""
        return np.asarray(np.clip(theta, self.low, self.high))


def unknowns_of(
    model: Model, names: Sequence[str] | None, latency: Array, fit_latency: Latency
) -> Unknowns:
    """Checks the names and gathers bounds.

    Args:
        model: gives values and bounds.
        names: parameters to fit; None: all uncertain ones.
        latency: of each input [s], known or where to begin, (m,).
        fit_latency: "known" (not fitted), "common" (one for all inputs), or "each".

    Raises:
        GroundedError: for a name that is not an uncertain parameter, or nothing to fit.
    """
    names = model.uncertain if names is None else tuple(names)
    for name in names:
        if name not in model.params:
            raise GroundedError(
                f"'{name}' is not a parameter of model '{model.name}': "
                + nearest(name, model.params)
            )
        if not model.params[name].uncertain:
            raise GroundedError(f"'{name}' is a constant of model '{model.name}': {BOUNDS}")
    if fit_latency not in ("known", "common", "each"):
        raise GroundedError(f"fit_latency must be known, common or each, got '{fit_latency}'")
    params = [model.params[name] for name in names]
    choices: dict[str, list[tuple[int, ...]]] = {
        "known": [],
        "common": [tuple(range(model.m))],
        "each": [(j,) for j in range(model.m)],
    }
    delayed = choices[fit_latency]
    labels = ["latency"] if fit_latency == "common" else []
    if fit_latency == "each":
        labels = [f"latency:{name}" for name in model.input_names]
    if not names and not labels:
        raise GroundedError(f"model '{model.name}' has no uncertain parameter to fit: {BOUNDS}")
    far = [np.inf if p.std is None else STDS * p.std for p in params]  # where no bound is given
    low = [p.value - f if p.low is None else p.low for p, f in zip(params, far, strict=True)]
    high = [p.value + f if p.high is None else p.high for p, f in zip(params, far, strict=True)]
    low, high = low + [0.0] * len(delayed), high + [LONGEST] * len(delayed)
    start = [p.value for p in params] + [float(latency[inputs[0]]) for inputs in delayed]
    width = np.array(high) - np.array(low)
    size = np.maximum(np.abs(start), 1e-3)
    return Unknowns(
        names=(*names, *labels),
        units=(*(p.unit for p in params), *("s" for _ in delayed)),
        start=np.array(start, float),
        low=np.array(low, float),
        high=np.array(high, float),
        scale=np.where(np.isfinite(width), width, size),
        columns=tuple(model.param_names.index(name) for name in names),
        delayed=tuple(delayed),
        values=np.array(model.values),
        latency=np.array(latency, float),
    )


ENOUGH = 0.002  # [nats] a step that promises less, a sixteenth of a std, is the last
NOTHING = 1e-9  # of the largest eigenvalue (scaled): below it the data say nothing


@dataclass(frozen=True, eq=False)
class Climb:
    """Where a climb ended and why."""

    at: Point
    slopes: Linear
    steps: int
    status: str


def climb(
    data: FitData,
    noise: NoiseStd,
    start: Point,
    free: NDArray[np.bool_],
    max_steps: int = 20,
) -> Climb:
    """Climbs from a point; only `free` unknowns (k,) move.

    Args:
        data: the records.
        noise: held fixed.
        start: a point at this noise, whose filter got through.
        free: which unknowns may move, (k,).
        max_steps: steps that count, at most.
    """
    at, damping, last = start, 1e-3, max_steps
    slopes_at: Callable[[FitData, Point], Linear] = linear
    slopes = linear(data, at)
    for step in range(max_steps):
        at, slopes, damping, status = _step(data, noise, at, slopes, free, damping, slopes_at)
        if status != "rising" and slopes_at is exact:
            return Climb(at, slopes, step, status)
        if status != "rising":
            damping, slopes_at, slopes = 1e-3, exact, exact(data, at)
            last = min(last, step + 1 + max_steps // 2)
        if step + 1 == last:
            break
    return Climb(at, slopes, max_steps, "out of steps")


def _step(
    data: FitData,
    noise: NoiseStd,
    at: Point,
    slopes: Linear,
    free: NDArray[np.bool_],
    damping: float,
    slopes_at: Callable[[FitData, Point], Linear],
) -> tuple[Point, Linear, float, str]:
    for _ in range(12):
        delta, promise = marquardt_step(data, at.theta, slopes, free, damping)
        if promise < ENOUGH:
            return at, slopes, damping, "converged"
        there = point(data, noise, data.unknowns.clipped(at.theta + delta), at)
        if there.loglik > at.loglik:
            gain = there.loglik - at.loglik
            later = slopes_at(data, there)
            if not np.isfinite(later.W).all():
                return at, slopes, damping, "slopes are not finite"
            status = "rising" if gain > ENOUGH else "converged"
            return there, later, max(damping / 10, 1e-8), status
        damping *= 10
    return at, slopes, damping, "no step rises further"


def marquardt_step(
    data: FitData, theta: Array, slopes: Linear, free: NDArray[np.bool_], damping: float
) -> tuple[Array, float]:
    """The damped step (k,) and the gain in nats that the linear problem promises of it."""
    unknowns = data.unknowns
    N, g = slopes.W.T @ slopes.W, slopes.g
    stuck = ((theta <= unknowns.low) & (g < 0)) | ((theta >= unknowns.high) & (g > 0))
    use = np.flatnonzero(free & ~stuck & (np.diag(N) > 0))
    delta = np.zeros(unknowns.k)
    if len(use) == 0:
        return delta, 0.0
    scale = 1 / np.sqrt(np.diag(N)[use])
    scaled = N[np.ix_(use, use)] * np.outer(scale, scale)
    values, vectors = np.linalg.eigh(scaled)
    said = values > NOTHING * values[-1]
    along = vectors[:, said].T @ (g[use] * scale)
    delta[use] = scale * (vectors[:, said] @ (along / (values[said] + damping)))
    delta = unknowns.clipped(theta + delta) - theta
    return delta, float(g @ delta - 0.5 * delta @ N @ delta)


@dataclass(frozen=True, eq=False)
class FitData:
    """Records with what measures them: all that a likelihood needs beside theta and the noise."""

    system: System
    records: tuple[Record, ...]
    measurement: Measurement
    unknowns: Unknowns
    last: dict[bytes, RecordBatch] = field(default_factory=dict, init=False)  # by latency, one

    @property
    def steps(self) -> int:
        """Of all records."""
        return sum(record.steps for record in self.records)

    def batch(self, theta: Array) -> RecordBatch:
        """The records side by side, inputs delayed as theta says."""
        latency = self.unknowns.unpack(theta)[1]
        if (found := self.last.get(latency.tobytes())) is None:
            found = batch_of(self.records, self.measurement, self.system.n, latency)
            self.last.clear()
            self.last[latency.tobytes()] = found
        return found


@dataclass(frozen=True, eq=False)
class Point:
    """The likelihood at one theta."""

    theta: Array
    batch: RecordBatch
    filtered: Filtered

    @property
    def loglik(self) -> float:
        """Of the innovations; minus infinity where the filter did not get through."""
        return self.filtered.loglik


@dataclass(frozen=True, eq=False)
class Linear:
    """A point with its slopes; a row is a sample that was seen."""

    W: Array  # (rows, k)
    eps: Array  # (rows,)
    block: NDArray[np.int64]  # (rows,) the piece of time that a row belongs to
    more: Array | float = 0.0  # (k,) what the gains add to the slope

    @property
    def g(self) -> Array:
        """Slope of the log-likelihood, (k,)."""
        return np.asarray(-self.W.T @ self.eps + self.more)


def point(data: FitData, noise: NoiseStd, theta: Array, near: Point | None = None) -> Point:
    """One pass of the filter at theta; `near`: a point not far from it, which saves time."""
    batch = data.batch(theta)
    p = data.unknowns.unpack(theta)[0]
    steps = ModelSteps(data.system, p, batch, wide=True)
    about = None if near is None else near.filtered
    return Point(theta, batch, filter_batch(batch, data.measurement, noise, steps, about))


def linear(data: FitData, at: Point, blocks: int = 60) -> Linear:
    """Slopes at a point whose filter got through.

    Args:
        data: the records.
        at: where.
        blocks: into how many pieces of time to group the rows, for intervals.
    """
    f_theta = _change_of_the_next_state(data, at)
    W = sensitivity(at.filtered, f_theta)
    seen = at.batch.seen
    return Linear(W[seen], at.filtered.eps[seen], _blocks(at.batch, blocks)[seen])


def exact(data: FitData, at: Point) -> Linear:
    """Slopes with what a change of the parameters does to the filter's gains."""
    unknowns, filtered, batch, more = (
        data.unknowns,
        at.filtered,
        at.batch,
        np.zeros(data.unknowns.k),
    )
    p, back = unknowns.unpack(at.theta)[0], smoother(filtered.gains, filtered.eps, covariances=True)
    assert back.whole is not None
    q = back.r[1:, ..., None]
    said = (q * q.swapaxes(-1, -2) - back.whole[1:]) @ filtered.A @ filtered.gains.posterior[:-1]
    for h, mask in batch.steps_of:
        rows = batch.valid if mask is None else mask & batch.valid
        x, u = filtered.x[:-1][rows], batch.u[rows]
        A = data.system.linearise(x, u, p, h)[0]
        for i, column in enumerate(unknowns.columns):
            moved, size = p.copy(), 1e-5 * max(abs(p[column]), 1e-3)
            moved[column] += size
            change = (data.system.linearise(x, u, moved, h)[0] - A) / size
            more[i] += float(np.sum(said[rows] * change))
    return replace(linear(data, at), more=more)


def _change_of_the_next_state(data: FitData, at: Point) -> Array:
    """f_theta along the filtered track, (T, B, n, k)."""
    unknowns, batch, (T, B, n) = data.unknowns, at.batch, at.filtered.more.shape
    p = unknowns.unpack(at.theta)[0]
    out = np.zeros((T, B, n, unknowns.k))
    params = len(unknowns.columns)
    for h, mask in batch.steps_of:
        rows = batch.valid if mask is None else mask & batch.valid
        x, u = at.filtered.x[:-1][rows], batch.u[rows]
        _, f_u, f_p = data.system.sensitivities(x, u, p, h)
        found = np.empty((len(x), n, unknowns.k))
        found[..., :params] = f_p[..., list(unknowns.columns)]
        for i, inputs in enumerate(unknowns.delayed):
            moved = batch.u_latency[rows][:, None, list(inputs)]
            found[..., params + i] = np.sum(f_u[..., list(inputs)] * moved, axis=-1)
        out[rows] = found
    return out


def _blocks(batch: RecordBatch, blocks: int) -> NDArray[np.int64]:
    """A block number for each sample, (T + 1, B, ny): contiguous in time, within one record."""
    T1, B, ny = batch.seen.shape
    each = max(1, round(blocks / B))
    within = np.minimum(np.arange(T1)[:, None] * each // np.maximum(batch.lengths + 1, 1), each - 1)
    number = within + each * np.arange(B)
    return np.asarray(np.repeat(number[..., None], ny, axis=2))
