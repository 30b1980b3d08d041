"""What any engine answers (`System`), in NumPy: integration, rollouts, differences, the sweep.

A subclass evaluates the user's function on N samples at once (`differenced.py`), or replaces what
is here by machine code in the same order of steps (`compiled.py`).

The sweep (theory: `ddp.py`). The problem about a trajectory is linear dynamics of z and a quadratic
cost (`Quadratic`): with q the past inputs (`Queue`),

    A = [[f_x, f_u past], [0, S]],    B = [[f_u now], [E]],
    l_t(z, u) = W_t |x - target_t|^2 + R |u - u_target_t|^2 + S |u - u_{t-1}|^2,

without halves, so that l_x = 2 W e and l_xx = 2 W; errors of angles wrap. With V the value's
Hessian, backwards in time,

    Q_z = l_z + A'V_z    Q_zz = l_zz + A'V A    Q_uz = l_uz + B'V A
    Q_u = l_u + B'V_z    Q_uu = l_uu + B'V B
    k, K: minimise the step's quadratic with Q_uu + diag(damping) inside the input limits
    V_z  = Q_z  + K'(Q_uu k + Q_u) + Q_uz'k
    V_zz = Q_zz + K'Q_uu K + K'Q_uz + Q_uz'K.

Inside the limits: min 1/2 k'Hk + g'k subject to low <= k <= high (`box_qp`; Tassa et al. 2014). The
free set are the inputs that no bound holds back.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grounded.compile.names import Integrator, Signature, integrated, raised_at, where
from grounded.compile.problem import (
    STOP,
    Backward,
    Controls,
    Descent,
    DescentOptions,
    Limits,
    Problem,
    Queue,
    Samples,
    Swarm,
)
from grounded.frozen import Array, wrapped

RELATIVE_STEP = float(np.cbrt(np.finfo(float).eps))  # of differences in double precision
CHUNK = 4096  # samples in one call, so that long horizons don't fill the memory
FLAT = 1e-9  # slope of a differenced function that is rounding


def stencil(at: Array, h: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Return the points h below and above `at`, neither of them beyond a limit.

    A point that lies beyond a limit itself is kept, and stepped from inwards.
    """
    down = np.maximum(at - h, np.minimum(at, low))
    return down, np.minimum(at + h, np.maximum(at, high))


class System(ABC):
    """Discrete dynamics x_{t+1} = f(x_t, u_t; p) over a step dt, and the kernels built on them.

    Args:
        signature: the user's function and its names.
        integrator: for a derivative.
        note: why it is not compiled, naming the line; empty when it is.
    """

    how: str  # "compiled", "compiled steps" or "differenced"
    _latest: tuple[Samples, tuple[Array, Array]] | None = None  # differentiated, their slopes

    def __init__(
        self, signature: Signature, integrator: Integrator = "rk4", note: str = ""
    ) -> None:
        self.signature, self.integrator, self.note = signature, integrator, note
        self.kind, self.states, self.inputs = signature.kind, signature.states, signature.inputs
        self.source = where(signature.function)
        self.n, self.m, self.k = self.sizes = signature.sizes

    @property
    def simulated(self) -> bool:
        """Whether each step is a call of the user's function: a simulator's takes milliseconds."""
        return self.how == "differenced"

    @abstractmethod
    def evaluate(self, x: Array, u: Array, p: Array, dt: float, smoothing: float) -> Array:
        """The user's function: x (N, n), u (N, m), p (k,) -> ds/dt or next state (N, n)."""

    @abstractmethod
    def check(self, x: Array, u: Array, p: Array, dt: float) -> None:
        """Compares a trace with the user's own function at points x (N, n), u (N, m).

        Raises:
            GroundedError: where they differ, with both values.
        """

    def reads(self, p: Array, dt: float) -> NDArray[np.bool_]:
        """Which states and inputs each output of the user's function depends on, (n, n + m).

        Of a black box, its next states, by slopes at a few points.
        """
        both = np.random.default_rng(0).uniform(0.2, 1.0, (8, self.n + self.m))
        slopes = self.linearise(both[:, : self.n], both[:, self.n :], p, dt)
        return np.asarray(np.abs(np.concatenate(slopes, axis=2)).max(axis=0) > FLAT)

    def fault(self, x: Array, u: Array, p: Array, dt: float) -> str:
        """Where a step from x (n,), u (m,) makes a number that is not finite; or "".

        The user's function is asked first: a rate that is NaN makes other states NaN, too.
        """
        at, sent, known = ([np.float64(value) for value in some] for some in (x, u, p))
        for function in (self.signature, self.signature.whole(self.integrator)):
            try:
                with np.errstate(all="raise", under="ignore"):
                    after = function.call(at, sent, known, np.float64(dt))
            except (ArithmeticError, ValueError) as error:
                kind = "" if isinstance(error, FloatingPointError) else f"{type(error).__name__}: "
                return f"{raised_at(error, self.signature.function)}: {kind}{error}"
            for name in self.states:
                if not np.isfinite(float(after[name])):
                    return f"{self.source}: {float(after[name]):g} for '{name}'"
        return ""

    def inverse(self, x: Array, after: Array, p: Array, dt: float) -> Array | None:
        """Inputs (N, m) that lead from x (N, n) to about `after` (N, n); None where unknown."""
        return None

    def step(self, x: Array, u: Array, p: Array, dt: float, smoothing: float = 0.0) -> Array:
        """From x (N, n), u (N, m) to the next x (N, n)."""
        with np.errstate(all="ignore"):
            if self.kind == "step":
                return self.evaluate(x, u, p, dt, smoothing)

            def rate(at: list[Array]) -> list[Array]:
                return [self.evaluate(at[0], u, p, dt, smoothing)]

            return np.asarray(integrated(rate, [x], dt, self.integrator)[0])

    def linearise(
        self,
        x: Array,
        u: Array,
        p: Array,
        dt: float,
        smoothing: float = 0.0,
        limits: Limits | None = None,
    ) -> tuple[Array, Array]:
        """f_x (N, n, n) and f_u (N, n, m), read-only; the latest are kept.

        A sweep is repeated with more damping, a search goes on where it stopped, and gains are
        designed along its plan: all of these differentiate the same samples.

        `limits` of the inputs, low and high (m,): derivatives that are differenced are taken
        inwards there, as a simulator may clamp what lies beyond.
        """
        at = Samples(x, u, p, dt, 0.0 if self.simulated else smoothing, limits)
        if self._latest is not None and _same(self._latest[0], at):
            return self._latest[1]
        f_x, f_u = np.split(self.jacobian(at, self.n + self.m), [self.n], axis=2)
        found = np.ascontiguousarray(f_x), np.ascontiguousarray(f_u)
        self._latest = copy.deepcopy(at), found
        for slopes in found:
            slopes.setflags(write=False)
        return found

    def sensitivities(
        self, x: Array, u: Array, p: Array, dt: float, smoothing: float = 0.0
    ) -> tuple[Array, Array, Array]:
        """f_x (N, n, n), f_u (N, n, m) and f_p (N, n, k)."""
        J = self.jacobian(Samples(x, u, p, dt, smoothing), self.n + self.m + self.k)
        f_x, f_u, f_p = np.split(J, [self.n, self.n + self.m], axis=2)
        return np.ascontiguousarray(f_x), np.ascontiguousarray(f_u), np.ascontiguousarray(f_p)

    def jacobian(self, at: Samples, width: int) -> Array:
        """Derivatives of `step` by the first `width` of x, u and p, (N, n, width)."""
        return self.differences(at, width)

    def differences(self, at: Samples, width: int, relative: float = RELATIVE_STEP) -> Array:
        """Central differences of `step`, like `jacobian`; steps `relative` to a value or 1."""
        x, u, p, dt, eps, limits = at
        d = self.n + self.m
        both, high = np.concatenate([x, u], axis=1), np.full(d, np.inf)
        low = -high
        if limits is not None:
            low[self.n :], high[self.n :] = limits
        J, size = np.empty((len(x), self.n, width)), max(1, CHUNK // (2 * d))
        for first in range(0, len(x), size):
            some = slice(first, first + size)
            J[some, :, :d] = self._slopes_at(both[some], (p, dt, eps), relative, low, high)
        for i in range(width - d):
            up, down, h = np.array(p, float), np.array(p, float), relative * (abs(p[i]) or 1.0)
            up[i], down[i] = p[i] + h, p[i] - h
            change = self.step(x, u, up, dt, eps) - self.step(x, u, down, dt, eps)
            J[:, :, d + i] = change / (up[i] - down[i])
        return J

    def _slopes_at(
        self, both: Array, how: tuple[Array, float, float], relative: float, low: Array, high: Array
    ) -> Array:
        """(N, n + m) points -> (N, n, n + m) inside low and high, in one call of the step."""
        N, d = both.shape
        down, up = stencil(both, relative * np.maximum(1.0, np.abs(both)), low, high)
        points = np.broadcast_to(both, (2, d, N, d)).copy()
        i = np.arange(d)
        points[0, i, :, i], points[1, i, :, i] = up.T, down.T
        width = (points[0, i, :, i] - points[1, i, :, i]).T  # what was really stepped (N, d)
        flat = points.reshape(-1, d)
        y = self.step(flat[:, : self.n], flat[:, self.n :], *how).reshape(2, d, N, self.n)
        with np.errstate(all="ignore"):
            return np.asarray((y[0] - y[1]).transpose(1, 2, 0) / width[:, None, :])

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
        steps = np.ones(1) if alphas is None else np.asarray(alphas, float)
        return self.runs(problem, Controls(ubar, K, zbar, k), steps)

    def runs(self, problem: Problem, by: Controls, alphas: Array) -> Swarm:
        """What `rollout` returns, a run for each of alphas (A,).

        Each run may have a policy and a bias of its own, (A, ...), or all the same ones.
        """
        ubar, K, zbar, k = by
        queue, n, runs = problem.queue, self.n, len(alphas)
        z = np.empty((runs, problem.horizon + 1, problem.nz))
        u = np.empty((runs, problem.horizon, self.m))
        z[:, 0], u[:] = problem.z_start(), ubar if k is None else ubar + alphas[:, None, None] * k
        with np.errstate(all="ignore"):
            for t in range(problem.horizon):
                if K is not None and zbar is not None:
                    off = wrapped(z[:, t] - zbar[..., t, :], problem.angles)
                    u[:, t] += (K[..., t, :, :] @ off[:, :, None])[:, :, 0]
                u[:, t] = np.clip(u[:, t], problem.low, problem.high)
                sent = problem.received(z[:, t], u[:, t], t)
                moved = self.stepped(problem, z[:, t, :n], sent, t)
                z[:, t + 1, :n] = moved + problem.bias[..., t, :]
                z[:, t + 1, n:] = queue.after(z[:, t, n:], u[:, t])
        return Swarm(z, u, trajectory_cost(problem, z, u))

    def stepped(self, problem: Problem, x: Array, sent: Array, t: int) -> Array:
        """The states (N, n) after step t with received inputs (N, m), without the bias."""
        return self.step(x, sent, problem.p, problem.dt, problem.smoothing)

    def backward(self, problem: Problem, z: Array, u: Array, damping: Array) -> Backward:
        """Linearise along z (H+1, nz), u (H, m) and sweep back, Q_uu + diag(damping), damping (m,).

        Input limits are part of each step's quadratic programme (box-DDP, Tassa et al. 2014): the
        rows of K of a clamped input are zero.
        """
        with np.errstate(all="ignore"):
            return sweep(problem, u, linearised(self, problem, z, u), damping)

    def descend(self, problem: Problem, first: Controls, options: DescentOptions) -> Descent | None:
        """The loop of `ddp.solve` from a first rollout; None where it is left to `ddp`."""
        return None


def _same(one: Samples, other: Samples) -> bool:
    """Return whether two are equal."""
    limits = [() if at.limits is None else at.limits for at in (one, other)]
    limited = len(limits[0]) == len(limits[1]) and all(map(np.array_equal, *limits))
    numbers = (one.dt, one.smoothing) == (other.dt, other.smoothing)
    return limited and numbers and all(map(np.array_equal, one[:3], other[:3]))


@dataclass(frozen=True, eq=False)
class Quadratic:
    """The problem about a trajectory: linear dynamics of z, quadratic cost."""

    A: Array  # (H, nz, nz)
    B: Array  # (H, nz, m)
    l_z: Array  # (H+1, nz)
    l_u: Array  # (H, m)
    l_zz: Array  # (H+1, nz), a diagonal
    l_uu: Array  # (m,), a diagonal
    l_uz: Array  # (m, nz), the same at every step


def linearised(system: System, problem: Problem, z: Array, u: Array) -> Quadratic:
    """The problem about z (H+1, nz), u (H, m), with the system's derivatives."""
    queue, H, n = problem.queue, problem.horizon, system.n
    x = np.ascontiguousarray(z[:-1, :n])
    received = problem.received(z[:-1], u)
    settings = (problem.p, problem.dt, problem.smoothing, problem.limits)
    A, B = _augmented(queue, *system.linearise(x, received, *settings))
    R, S = problem.input_weight, problem.change_weight
    change = input_change(problem, u)
    l_z = np.zeros((H + 1, queue.nz))
    l_zz = np.zeros((H + 1, queue.nz))
    l_z[:, :n] = 2 * problem.state_weight * tracking_error(problem, z)
    l_zz[:, :n] = 2 * problem.state_weight
    l_uz = np.zeros((len(R), queue.nz))
    newest = list(queue.first)
    l_z[:-1, newest] = -2 * S * change
    l_zz[:-1, newest] = 2 * S
    l_uz[np.arange(len(R)), newest] = -2 * S
    l_u = 2 * R * (u - problem.input_target) + 2 * S * change
    return Quadratic(A, B, l_z, l_u, l_zz, 2 * (R + S), l_uz)


def _augmented(queue: Queue, f_x: Array, f_u: Array) -> tuple[Array, Array]:
    H, n, nz, m = len(f_x), queue.n, queue.nz, f_u.shape[2]
    S, E = queue.shift()
    A, B = np.zeros((H, nz, nz)), np.zeros((H, nz, m))
    A[:, :n, :n], A[:, :n, n:], A[:, n:, n:] = f_x, f_u @ queue.past, S
    B[:, :n], B[:, n:] = f_u * queue.now, E
    return A, B


def sweep(problem: Problem, u: Array, q: Quadratic, damping: Array) -> Backward:
    """Gains along u (H, m), with the problem about it; damping (m,)."""
    H, m, nz = q.B.shape[0], q.B.shape[2], q.B.shape[1]
    k, K, d1, d2 = np.zeros((H, m)), np.zeros((H, m, nz)), 0.0, 0.0
    low, high = problem.low - u, problem.high - u
    weights, l_uu, extra = diagonals(q.l_zz), np.diag(q.l_uu), np.diag(damping)
    V_z, V = q.l_z[H], weights[H]
    for t in range(H - 1, -1, -1):
        A, B = q.A[t], q.B[t]
        VA, VB = V @ A, V @ B
        Q_z, Q_u = q.l_z[t] + A.T @ V_z, q.l_u[t] + B.T @ V_z
        Q_zz = weights[t] + A.T @ VA
        Q_uu = l_uu + B.T @ VB
        Q_uz = q.l_uz + B.T @ VA
        damped = Q_uu + extra
        if not (_positive_definite(damped) and np.isfinite(Q_u).all()):
            return Backward(k, K, d1, d2, t)
        k[t], K[t] = _gains(damped, Q_u, Q_uz, low[t], high[t])
        d1 += float(k[t] @ Q_u)
        d2 += 0.5 * float(k[t] @ Q_uu @ k[t])
        V_z = Q_z + K[t].T @ (Q_uu @ k[t] + Q_u) + Q_uz.T @ k[t]
        V = Q_zz + K[t].T @ (Q_uu @ K[t] + Q_uz) + Q_uz.T @ K[t]
        V = 0.5 * (V + V.T)
    return Backward(k, K, d1, d2, -1 if np.isfinite(K[0]).all() else 0)


def diagonals(rows: Array) -> Array:
    """Diagonal matrices (N, k, k) of rows (N, k)."""
    found = np.zeros((*rows.shape, rows.shape[1]))
    each = np.arange(rows.shape[1])
    found[:, each, each] = rows
    return found


def _positive_definite(Q: Array) -> bool:
    if not np.isfinite(Q).all():
        return False
    try:
        np.linalg.cholesky(Q)
    except np.linalg.LinAlgError:
        return False
    return True


def _gains(Q_uu: Array, Q_u: Array, Q_uz: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Returns k (m,) inside [low, high] and K (m, nz), whose rows of clamped inputs are zero."""
    both = -solve(Q_uu, np.column_stack([Q_u, Q_uz]))
    k = both[:, 0]
    if np.all((low <= k) & (k <= high)):
        return k, both[:, 1:]
    k, free = box_qp(Q_uu, Q_u, low, high)
    K = -solve(masked(Q_uu, free), np.where(free[:, None], Q_uz, 0.0))
    return k, K


def solve(H: Array, b: Array) -> Array:
    """H^-1 b in float64."""
    return np.asarray(np.linalg.solve(H, b), np.float64)


def masked(H: Array, free: NDArray[np.bool_]) -> Array:
    """H with rows and columns of clamped inputs replaced by the identity's."""
    return np.asarray(np.where(free[:, None] & free, H, 0.0) + np.diag(np.where(free, 0.0, 1.0)))


def box_qp(H: Array, g: Array, low: Array, high: Array) -> tuple[Array, NDArray[np.bool_]]:
    """The minimiser k (m,) of 1/2 k'Hk + g'k in its limits, and its free set (m,).

    With H = L L', it is the least squares of L'k + L^-1 g, by active sets (Stark & Parker 1995).
    """
    from scipy.optimize import lsq_linear  # only a plan at its limits needs it

    L, held = np.asarray(np.linalg.cholesky(H), float), low >= high
    high = np.where(held, np.nextafter(low, np.inf), high)
    found = lsq_linear(L.T, -solve(L, g), (low, high), method="bvls", tol=STOP)
    at = found.active_mask
    k = np.where(held | (at < 0), low, np.where(at > 0, high, found.x))
    return k, (at == 0) & ~held


def tracking_error(problem: Problem, z: Array) -> Array:
    """x_t - target_t, angles wrapped: z (..., H+1, nz) -> (..., H+1, n)."""
    return wrapped(z[..., : problem.system.n] - problem.target, problem.angles)


def input_change(problem: Problem, u: Array) -> Array:
    """u_t - u_{t-1} with u_{-1} = past: u (..., H, m) -> (..., H, m)."""
    before = np.broadcast_to(problem.past, (*u.shape[:-2], 1, u.shape[-1]))
    return np.diff(u, axis=-2, prepend=before)


def trajectory_cost(problem: Problem, z: Array, u: Array) -> Array:
    """J of each run: z (..., H+1, nz), u (..., H, m) -> (...,)."""
    with np.errstate(all="ignore"):
        e = tracking_error(problem, z)
        J = np.einsum("...ti,ti->...", e * e, problem.state_weight)
        a, change = u - problem.input_target, input_change(problem, u)
        J = J + (a * a).sum(axis=-2) @ problem.input_weight
        return np.asarray(J + (change * change).sum(axis=-2) @ problem.change_weight)
