"""The model as a filter sees it: the next state and its slopes, at one time or along a track."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from grounded.compile import System
from grounded.estimate.batch import Batch
from grounded.estimate.filtered import Filtered
from grounded.frozen import Array

Advance = Callable[[int, Array], tuple[Array, Array]]  # t, x (B, n) -> f (B, n), A (B, n, n)


@dataclass(frozen=True, eq=False)
class ModelSteps:
    """f and A = f_x of a system at the inputs of a batch; a step that is not valid changes nothing.

    Args:
        system: the dynamics.
        p: parameter values (k,).
        batch: gives inputs and step sizes.
        smoothing: width of the smoothed indicator terms; 0: exact.
    """

    system: System
    p: Array
    batch: Batch
    smoothing: float = 0.0

    def at(self, t: int, x: Array) -> tuple[Array, Array]:
        """From x (B, n) at time t: f (B, n), A (B, n, n)."""
        f, A = self._rows(x[None], slice(t, t + 1))
        return f[0], A[0]

    def along(self, x: Array) -> tuple[Array, Array]:
        """From a track x (T, B, n): f (T, B, n), A (T, B, n, n)."""
        return self._rows(x, slice(None))

    def _rows(self, x: Array, times: slice) -> tuple[Array, Array]:
        batch, n = self.batch, x.shape[-1]
        valid, u = batch.valid[times], batch.u[times]
        if len(batch.steps_of) == 1 and valid.all():
            f, A = self._call(x.reshape(-1, n), u.reshape(-1, u.shape[-1]), batch.steps_of[0][0])
            return f.reshape(x.shape), A.reshape(*x.shape, n)
        f, A = x.copy(), np.tile(np.eye(n), (*x.shape[:-1], 1, 1))
        for h, mask in batch.steps_of:
            rows = valid if mask is None else valid & mask[times]
            if rows.any():
                f[rows], A[rows] = self._call(x[rows], u[rows], h)
        return f, A

    def _call(self, x: Array, u: Array, h: float) -> tuple[Array, Array]:
        f = self.system.step(x, u, self.p, h, self.smoothing)
        return f, self.system.linearise(x, u, self.p, h, self.smoothing)[0]


def fixed_steps(filtered: Filtered) -> Advance:
    """The linearisation of an earlier pass, f_t + A_t (x - x_t)."""

    def advance(t: int, x: Array) -> tuple[Array, Array]:
        A = filtered.A[t]
        return filtered.f[t] + (A @ (x - filtered.x[t])[..., None])[..., 0], A

    return advance
