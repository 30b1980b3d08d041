"""What the two NumPy paths share: integration, rollouts and the sweep, without a compiler.

A subclass evaluates the user's function on N samples at once and gives its derivatives; how it
does so (`python.py` calls the function, `traced.py` runs its graph) is all that differs.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from grounded.compile.problem import (
    Array,
    Backward,
    Descent,
    Integrator,
    Kind,
    Options,
    Problem,
    Swarm,
    queue_of,
)
from grounded.compile.run.sweep import sweep, trajectory_cost, wrapped


class Interpreted(ABC):
    """A System whose kernels are NumPy."""

    how: str
    note: str
    source: str
    states: tuple[str, ...]

    def __init__(
        self, kind: Kind, integrator: Integrator, sizes: tuple[int, int, int], note: str = ""
    ) -> None:
        self.kind, self.integrator, self.note = kind, integrator, note
        self.n, self.m, self.k = sizes

    @abstractmethod
    def evaluate(self, x: Array, u: Array, p: Array, dt: float, smoothing: float) -> Array:
        """The user's function: x (N, n), u (N, m), p (k,) -> ds/dt or next state (N, n)."""

    @abstractmethod
    def linearise(
        self, x: Array, u: Array, p: Array, dt: float, smoothing: float = 0.0
    ) -> tuple[Array, Array]:
        """f_x (N, n, n), f_u (N, n, m)."""

    @abstractmethod
    def sensitivities(
        self, x: Array, u: Array, p: Array, dt: float, smoothing: float = 0.0
    ) -> tuple[Array, Array, Array]:
        """f_x (N, n, n), f_u (N, n, m), f_p (N, n, k)."""

    @abstractmethod
    def check(self, x: Array, u: Array, p: Array, dt: float) -> None:
        """Compares with the user's own function."""

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
        queue, n, runs = queue_of(problem), self.n, len(alphas)
        z = np.empty((runs, problem.horizon + 1, queue.nz))
        u = np.empty((runs, problem.horizon, self.m))
        z[:, 0] = problem.z_start()
        with np.errstate(all="ignore"):
            for t in range(problem.horizon):
                u[:, t] = ubar[t] if k is None else ubar[t] + alphas[:, None] * k[t]
                if K is not None and zbar is not None:
                    u[:, t] += wrapped(z[:, t] - zbar[t], problem.angles) @ K[t].T
                u[:, t] = np.clip(u[:, t], problem.low, problem.high)
                sent = queue.effective(z[:, t], u[:, t])
                if problem.input_shift is not None:
                    sent = sent - problem.input_shift[t]
                x = self.step(z[:, t, :n], sent, problem.p, problem.dt, problem.smoothing)
                z[:, t + 1, :n] = x + problem.bias[t]
                z[:, t + 1, n:] = queue.after(z[:, t, n:], u[:, t])
        return Swarm(z, u, trajectory_cost(problem, z, u))

    def backward(
        self,
        problem: Problem,
        z: Array,
        u: Array,
        damping: Array,
        into: Backward | None = None,
    ) -> Backward:
        """See `System.backward`."""
        sent = queue_of(problem).effective(z[:-1], u)
        sent = sent if problem.input_shift is None else sent - problem.input_shift
        x = np.ascontiguousarray(z[:-1, : self.n])
        with np.errstate(all="ignore"):
            f_x, f_u = self.linearise(x, sent, problem.p, problem.dt, problem.smoothing)
            return sweep(problem, z, u, f_x, f_u, damping)

    def descend(
        self,
        problem: Problem,
        ubar: Array,
        K: Array | None,
        zbar: Array | None,
        options: Options,
    ) -> Descent | None:
        """See `System.descend`."""
        return None
