"""What the two NumPy paths share: integration, rollouts and the sweep, without a compiler.

A subclass evaluates the user's function on N samples at once and gives its derivatives; how it
does so (`differenced.py` calls the function, `traced.py` runs its graph) is all that differs.
"""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from grounded.compile.names import where
from grounded.compile.problem import Backward, Integrator, Problem, Swarm, System
from grounded.compile.run.sweep import linearised, sweep, trajectory_cost
from grounded.compile.trace.tracing import Signature
from grounded.frozen import Array, wrapped


class Interpreted(System):
    """A System whose kernels are NumPy.

    Args:
        signature: the user's function and its names.
        integrator: for a derivative.
        note: why it is not compiled.
    """

    def __init__(
        self, signature: Signature, integrator: Integrator = "rk4", note: str = ""
    ) -> None:
        self.signature, self.integrator, self.note = signature, integrator, note
        self.kind, self.states = signature.kind, signature.states
        self.source = where(signature.function)
        self.n, self.m, self.k = self.sizes = signature.sizes

    @abstractmethod
    def evaluate(self, x: Array, u: Array, p: Array, dt: float, smoothing: float) -> Array:
        """The user's function: x (N, n), u (N, m), p (k,) -> ds/dt or next state (N, n)."""

    @abstractmethod
    def jacobian(
        self, x: Array, u: Array, p: Array, dt: float, smoothing: float, width: int
    ) -> Array:
        """Derivatives of `step` by the first `width` of x, u and p, (N, n, width)."""

    def linearise(
        self, x: Array, u: Array, p: Array, dt: float, smoothing: float = 0.0
    ) -> tuple[Array, Array]:
        """See `System.linearise`."""
        J = self.jacobian(x, u, p, dt, smoothing, self.n + self.m)
        f_x, f_u = np.split(J, [self.n], axis=2)
        return np.ascontiguousarray(f_x), np.ascontiguousarray(f_u)

    def sensitivities(
        self, x: Array, u: Array, p: Array, dt: float, smoothing: float = 0.0
    ) -> tuple[Array, Array, Array]:
        """See `System.sensitivities`."""
        J = self.jacobian(x, u, p, dt, smoothing, sum(self.sizes))
        f_x, f_u, f_p = np.split(J, [self.n, self.n + self.m], axis=2)
        return np.ascontiguousarray(f_x), np.ascontiguousarray(f_u), np.ascontiguousarray(f_p)

    def step(self, x: Array, u: Array, p: Array, dt: float, smoothing: float = 0.0) -> Array:
        """See `System.step`."""
        with np.errstate(all="ignore"):
            if self.kind == "step":
                return self.evaluate(x, u, p, dt, smoothing)
            k1 = self.evaluate(x, u, p, dt, smoothing)
            if self.integrator == "euler":
                return np.asarray(x + dt * k1)
            k2 = self.evaluate(x + 0.5 * dt * k1, u, p, dt, smoothing)
            k3 = self.evaluate(x + 0.5 * dt * k2, u, p, dt, smoothing)
            k4 = self.evaluate(x + dt * k3, u, p, dt, smoothing)
            return np.asarray(x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4))

    def rollout(
        self,
        problem: Problem,
        ubar: Array,
        K: Array | None = None,
        zbar: Array | None = None,
        k: Array | None = None,
        alphas: Array | None = None,
    ) -> Swarm:
        """See `System.rollout`."""
        alphas = np.ones(1) if alphas is None else np.asarray(alphas, float)
        queue, n, runs = problem.queue, self.n, len(alphas)
        z = np.empty((runs, problem.horizon + 1, problem.nz))
        u = np.empty((runs, problem.horizon, self.m))
        z[:, 0] = problem.z_start()
        with np.errstate(all="ignore"):
            for t in range(problem.horizon):
                u[:, t] = ubar[t] if k is None else ubar[t] + alphas[:, None] * k[t]
                if K is not None and zbar is not None:
                    u[:, t] += wrapped(z[:, t] - zbar[t], problem.angles) @ K[t].T
                u[:, t] = np.clip(u[:, t], problem.low, problem.high)
                sent = problem.received(z[:, t], u[:, t], t)
                x = self.step(z[:, t, :n], sent, problem.p, problem.dt, problem.smoothing)
                z[:, t + 1, :n] = x + problem.bias[t]
                z[:, t + 1, n:] = queue.after(z[:, t, n:], u[:, t])
        return Swarm(z, u, trajectory_cost(problem, z, u))

    def backward(
        self, problem: Problem, z: Array, u: Array, damping: Array, into: Backward | None = None
    ) -> Backward:
        """See `System.backward`."""
        with np.errstate(all="ignore"):
            return sweep(problem, u, linearised(self, problem, z, u), damping)
