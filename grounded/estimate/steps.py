"""The linearised model of a filter: next state and Jacobian, at a time or along a track."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from grounded.compile import System
from grounded.estimate.record import RecordBatch
from grounded.frozen import Array

# t, x (B, n) -> f (B, n), A (B, n, n)
Advance = Callable[[int, Array], tuple[Array, Array]]


@dataclass(frozen=True, eq=False)
class ModelSteps:
    """f and A = f_x of a system with the inputs of a batch; identity for steps not valid.

    Args:
        system: the dynamics.
        p: parameter values (k,).
        batch: has the inputs and step sizes.
    """

    system: System
    p: Array
    batch: RecordBatch

    def at(self, t: int, x: Array) -> tuple[Array, Array]:
        """Return f (B, n) and A (B, n, n) at step t from x (B, n)."""
        f, A = self._rows(x[None], slice(t, t + 1))
        return f[0], A[0]

    def along(self, x: Array) -> tuple[Array, Array]:
        """Return f (T, B, n) and A (T, B, n, n) along a track x (T, B, n)."""
        return self._rows(x, slice(None))

    def _rows(self, x: Array, times: slice) -> tuple[Array, Array]:
        batch, n = self.batch, x.shape[-1]
        valid, u = batch.valid[times], batch.u[times]
        if len(batch.steps_of) == 1 and valid.all():
            flat = (x.reshape(-1, n), u.reshape(-1, u.shape[-1]))
            f, A = self._call(*flat, batch.steps_of[0][0])
            return f.reshape(x.shape), A.reshape(*x.shape, n)
        f, A = x.copy(), np.tile(np.eye(n), (*x.shape[:-1], 1, 1))
        for h, mask in batch.steps_of:
            rows = valid if mask is None else valid & mask[times]
            if rows.any():
                f[rows], A[rows] = self._call(x[rows], u[rows], h)
        return f, A

    def _call(self, x: Array, u: Array, h: float) -> tuple[Array, Array]:
        f = self.system.step(x, u, self.p, h)
        return f, self.system.linearise(x, u, self.p, h)[0]
