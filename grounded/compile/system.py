"""What every path from a user's function to numbers offers: compiled, traced, or differenced.

`ddp`, `fit`, `estimate` and the diagnosis talk to this interface alone, so that a black-box
simulator and a model compiled to machine code are the same thing to them. All arrays are float64
and C-contiguous; a state that leaves the finite numbers is returned as it is (NaN, inf), never
raised: the caller turns it into a status.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from grounded.compile.descent import Descent, Options
from grounded.compile.problem import Array, Problem


@dataclass(frozen=True, eq=False)
class Swarm:
    """The runs of one rollout call, one for each alpha: z (A, H+1, nz), u (A, H, m), cost (A,)."""

    z: Array
    u: Array
    cost: Array


@dataclass(frozen=True, eq=False)
class Backward:
    """One Riccati sweep: u_t = ubar_t + alpha k_t + K_t (z_t - zbar_t).

    The cost is expected to change by alpha d1 + alpha^2 d2 (d1 <= 0 <= d2). `failed_at` is the
    step whose Q_uu was not positive definite or not finite, -1 when the sweep went through.
    """

    k: Array  # (H, m)
    K: Array  # (H, m, nz)
    d1: float
    d2: float
    failed_at: int


class System(Protocol):
    """Discrete dynamics x_{t+1} = f(x_t, u_t; p) over a step dt, and the kernels built on them."""

    n: int
    m: int
    k: int  # number of parameters
    how: str  # "compiled", "traced" or "differenced"
    note: str  # why it is not compiled, naming the line; empty when it is
    source: str  # file:line of the user's function
    states: tuple[str, ...]  # names, for messages

    def step(self, x: Array, u: Array, p: Array, dt: float, smoothing: float = 0.0) -> Array:
        """From x (N, n), u (N, m) to the next x (N, n)."""
        ...

    def check(self, x: Array, u: Array, p: Array, dt: float) -> None:
        """Compares a trace with the user's own function at points x (N, n), u (N, m).

        Raises:
            GroundedError: where they differ, with both values.
        """
        ...

    def linearise(
        self, x: Array, u: Array, p: Array, dt: float, smoothing: float = 0.0
    ) -> tuple[Array, Array]:
        """f_x (N, n, n) and f_u (N, n, m)."""
        ...

    def sensitivities(
        self, x: Array, u: Array, p: Array, dt: float, smoothing: float = 0.0
    ) -> tuple[Array, Array, Array]:
        """f_x (N, n, n), f_u (N, n, m) and f_p (N, n, k)."""
        ...

    def rollout(
        self,
        problem: Problem,
        ubar: Array,
        K: Array | None = None,
        zbar: Array | None = None,
        k: Array | None = None,
        alphas: Array | None = None,
    ) -> Swarm:
        """u_t = clip(ubar_t + alpha k_t + K_t (z_t - zbar_t)), from the problem's start.

        ubar (H, m), K (H, m, nz), zbar (H, nz) or (H+1, nz), k (H, m), alphas (A,) or one of 1.
        Differences of angles wrap.
        """
        ...

    def backward(
        self,
        problem: Problem,
        z: Array,
        u: Array,
        damping: Array,
        into: Backward | None = None,
    ) -> Backward:
        """Linearise along z (H+1, nz), u (H, m) and sweep back, Q_uu + diag(damping), damping (m,).

        Input limits are part of each step's quadratic programme (box-DDP, Tassa et al. 2014): the
        rows of K of a clamped input are zero. `into` is an earlier result that nobody needs any
        more: its arrays may be used again.
        """
        ...

    def descend(
        self,
        problem: Problem,
        ubar: Array,
        K: Array | None,
        zbar: Array | None,
        options: Options,
    ) -> Descent | None:
        """The loop of `ddp.solve` in one piece; None where it is left to `ddp`.

        From the rollout of ubar (H, m) or of ubar + K (z - zbar).
        """
        ...
