"""What a pass of the filter leaves behind; notation as in `grounded.estimate.filter`."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from grounded.estimate.lanes import Pass
from grounded.frozen import Array


@dataclass(frozen=True, eq=False)
class Filtered:
    """Arrays time first; `loglik` is minus infinity when the pass did not get through."""

    x: Array  # (T + 1, B, n) filtered
    std: Array  # (T + 1, B, n) of x
    x_prior: Array  # (T + 1, B, n) predicted
    P_prior: Array  # (T + 1, B, n, n)
    e: Array  # (T + 1, B, ny) innovations, zero where not seen
    H: Array  # (T + 1, B, ny, n), zero rows where not seen
    R: Array  # (T + 1, B, ny) variance of the measurements, 1 where not seen
    A: Array  # (T, B, n, n)
    f: Array  # (T, B, n) what the model predicted from x
    more: Array  # (T, B, n) variance added to the process noise, see `steps`
    loglik: float
    status: str = "filtered"
    done: Pass | None = field(default=None, repr=False)  # the same in lanes, if it was compiled

    @cached_property
    def C(self) -> Array:
        """Whitening, lower triangular (T + 1, B, ny, ny): C' C = S^-1, identity if not seen."""
        S = self.H @ self.P_prior @ self.H.swapaxes(-1, -2)
        S += self.R[..., None] * np.eye(self.R.shape[-1])
        return np.asarray(np.linalg.inv(np.linalg.cholesky(S)))

    @cached_property
    def K(self) -> Array:
        """Gains (T + 1, B, n, ny)."""
        weight = self.C.swapaxes(-1, -2) @ self.C
        return np.asarray(self.P_prior @ self.H.swapaxes(-1, -2) @ weight)

    @cached_property
    def kept(self) -> Array:
        """I - K H, what an update keeps of the prediction, (T + 1, B, n, n)."""
        return np.asarray(np.eye(self.x.shape[-1]) - self.K @ self.H)

    @cached_property
    def P(self) -> Array:
        """Covariance of the filtered state (T + 1, B, n, n)."""
        spread = (self.K * self.R[..., None, :]) @ self.K.swapaxes(-1, -2)
        return np.asarray(self.kept @ self.P_prior @ self.kept.swapaxes(-1, -2) + spread)

    @cached_property
    def eps(self) -> Array:
        """Whitened innovations (T + 1, B, ny), zero where not seen."""
        return np.asarray((self.C @ self.e[..., None])[..., 0])
