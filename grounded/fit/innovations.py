"""The least-squares problem behind a fit: whitened innovations eps(theta) and their slopes.

    eps(theta): the filter's, with f(.; theta);      W = d eps / d theta  (`estimate.sensitivity`)

Their sum of squares is what is left unexplained, measured in the noise; the log-likelihood adds the
log-determinants. Gauss and Newton's step is -(W'W)^-1 W' eps, and W'W is the information that the
data hold about theta. Because every step of a trial starts from what the filter knows, noise of the
measurements does not bias the fit, as it does in one-step least squares (errors in variables).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grounded.compile import System
from grounded.estimate import Measurement, Noise, Record
from grounded.estimate.batch import Batch, batch_of
from grounded.estimate.filter import run, sensitivity
from grounded.estimate.filtered import Filtered
from grounded.estimate.steps import ModelSteps
from grounded.fit.unknowns import Unknowns
from grounded.frozen import Array


@dataclass(frozen=True, eq=False)
class Data:
    """Records with what measures them: all that a likelihood needs beside theta and the noise."""

    system: System
    records: tuple[Record, ...]
    measurement: Measurement
    unknowns: Unknowns

    def batch(self, theta: Array) -> Batch:
        """The records side by side, inputs delayed as theta says."""
        latency = self.unknowns.unpack(theta)[1]
        return batch_of(self.records, self.measurement, self.system.n, latency)


@dataclass(frozen=True, eq=False)
class Point:
    """The likelihood at one theta."""

    theta: Array
    batch: Batch
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


def point(data: Data, noise: Noise, theta: Array, near: Point | None = None) -> Point:
    """One pass of the filter at theta; `near`: a point not far from it, which saves time."""
    batch = data.batch(theta)
    p = data.unknowns.unpack(theta)[0]
    steps = ModelSteps(data.system, p, batch, wide=True)
    about = None if near is None else near.filtered
    return Point(theta, batch, run(batch, data.measurement, noise, steps, about))


def linear(data: Data, at: Point, blocks: int = 60) -> Linear:
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


def _change_of_the_next_state(data: Data, at: Point) -> Array:
    """f_theta along the filtered track, (T, B, n, k)."""
    unknowns, batch, (T, B, n) = data.unknowns, at.batch, at.filtered.f.shape
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


def _blocks(batch: Batch, blocks: int) -> NDArray[np.int64]:
    """A block number for each sample, (T + 1, B, ny): contiguous in time, within one record."""
    T1, B, ny = batch.seen.shape
    each = max(1, round(blocks / B))
    within = np.minimum(np.arange(T1)[:, None] * each // np.maximum(batch.lengths + 1, 1), each - 1)
    number = within + each * np.arange(B)
    return np.asarray(np.repeat(number[..., None], ny, axis=2))
