"""The linearised model for a filter: the next state and its Jacobian, at a time or along a track.

There are two ways to linearise about a state with standard deviation sigma:

    narrow   f(x), f_x(x): the extended Kalman filter
    wide     differences over h sigma_i on either side of each state, c_i = f_i+ + f_i- - 2 f:
             f(x) + sum_i c_i / (2 h^2),         A_i = (f_i+ - f_i-) / (2 h sigma_i);
             the linearisation error is process noise: sum_i c_i^2 (h^2 - 1) / (4 h^4)

The wide one takes the uncertainty into account. At a kink of the model (friction at rest, brakes
that are faster than the motor), the mean of f differs from f of the mean, and a filter that
neglects this biases the parameters. With h = sqrt(pi/2) the mean is right both for a kink and for a
parabola, and the variance for a kink.
Source: Noergaard, Poulsen & Ravn, Automatica 36 (2000), with another h.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from grounded.compile import System
from grounded.estimate.record import RecordBatch
from grounded.frozen import Array

# t, x (B, n) and its standard deviation (B, n) -> f (B, n), A (B, n, n), added variance (B, n)
Advance = Callable[[int, Array, Array], tuple[Array, Array, Array]]
REACH = float(np.sqrt(np.pi / 2))  # h
MISSED = (REACH**2 - 1) / (4 * REACH**4)
TOGETHER = 1000  # most samples whose differences are evaluated in one call
LEAST = 1e-6  # smallest difference, relative to max(1, |x|)


@dataclass(frozen=True, eq=False)
class ModelSteps:
    """f and A = f_x of a system with the inputs of a batch; identity for steps not valid.

    Args:
        system: the dynamics.
        p: parameter values (k,).
        batch: has the inputs and step sizes.
        wide: use differences over the uncertainty instead of derivatives.
    """

    system: System
    p: Array
    batch: RecordBatch
    wide: bool = False

    def at(self, t: int, x: Array, std: Array) -> tuple[Array, Array, Array]:
        """Return f, A and added variance (B, n) at step t from x (B, n) with its std (B, n)."""
        f, A, more = self._rows(x[None], std[None], slice(t, t + 1))
        return f[0], A[0], more[0]

    def along(self, x: Array, std: Array) -> tuple[Array, Array, Array]:
        """Return f, A (T, B, n, n), added variance (T, B, n) along a track x (T, B, n), std."""
        return self._rows(x, std, slice(None))

    def _rows(self, x: Array, std: Array, times: slice) -> tuple[Array, Array, Array]:
        batch, n = self.batch, x.shape[-1]
        valid, u = batch.valid[times], batch.u[times]
        if len(batch.steps_of) == 1 and valid.all():
            flat = (x.reshape(-1, n), std.reshape(-1, n), u.reshape(-1, u.shape[-1]))
            f, A, more = self._call(*flat, batch.steps_of[0][0])
            return f.reshape(x.shape), A.reshape(*x.shape, n), more.reshape(x.shape)
        f, A, more = x.copy(), np.tile(np.eye(n), (*x.shape[:-1], 1, 1)), np.zeros_like(x)
        for h, mask in batch.steps_of:
            rows = valid if mask is None else valid & mask[times]
            if rows.any():
                f[rows], A[rows], more[rows] = self._call(x[rows], std[rows], u[rows], h)
        return f, A, more

    def _call(self, x: Array, std: Array, u: Array, h: float) -> tuple[Array, Array, Array]:
        f = self.system.step(x, u, self.p, h)
        if not self.wide:
            return f, self.system.linearise(x, u, self.p, h)[0], np.zeros_like(x)
        mean, A, more = f.copy(), np.empty((*x.shape, x.shape[1])), np.zeros_like(x)
        for i, (up, down, reach) in enumerate(self._pairs(x, std, u, h)):
            A[..., i] = (up - down) / (2 * reach[:, None])
            curve = up + down - 2 * f
            mean += curve / (2 * REACH**2)
            more += MISSED * curve**2
        return mean, A, more

    def _pairs(
        self, x: Array, std: Array, u: Array, h: float
    ) -> Iterator[tuple[Array, Array, Array]]:
        """Yield for each state f with the state moved up and down, and by how much (N,)."""
        reach = np.maximum(REACH * std, LEAST * np.maximum(1.0, np.abs(x)))
        n = x.shape[1]
        if len(x) <= TOGETHER:
            shift = reach[None] * np.eye(n)[:, None, :]  # (n, N, n)
            many = np.concatenate([x + shift, x - shift]).reshape(-1, n)
            f = self.system.step(many, np.tile(u, (2 * n, 1)), self.p, h).reshape(2, n, *x.shape)
            for i in range(n):
                yield f[0, i], f[1, i], reach[:, i]
            return
        for i in range(n):
            up, down = x.copy(), x.copy()
            up[:, i] += reach[:, i]
            down[:, i] -= reach[:, i]
            yield (
                self.system.step(up, u, self.p, h),
                self.system.step(down, u, self.p, h),
                reach[:, i],
            )
