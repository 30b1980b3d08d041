"""Policy gradient for a policy class: u_t = pi(x_t, theta, t) with a few named parameters theta.

The user writes `policy(s, theta, t) -> inputs by name` in plain NumPy, t in seconds. It is traced
like a model, which gives pi_x and pi_theta exactly; one that can't be traced is called and
differenced, sample by sample. The rest is Eq. (4), see `policy_gradient.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from grounded.compile import Problem
from grounded.compile.run.differenced import RELATIVE_STEP, DifferencedSystem
from grounded.compile.run.interpreted import trajectory_cost
from grounded.compile.trace.tracing import Signature, Variant, trace
from grounded.frozen import Array
from grounded.rollout import Rollout
from grounded.solve.policy_gradient import adjoint, best_length, free_inputs, linearised

NO_STEP = 1.0  # dt, which a policy does not see


class ParametricPolicy:
    """m inputs as a function of n states, k parameters and time.

    Args:
        function: policy(s, theta, t) -> {input: value}.
        states: names in array order; likewise `inputs` and `parameters`.
        inputs: see `states`.
        parameters: see `states`.

    Raises:
        GroundedError: for wrong names, naming the function's file and line.
    """

    def __init__(
        self,
        function: Callable[..., Mapping[str, Any]],
        states: Sequence[str],
        inputs: Sequence[str],
        parameters: Sequence[str],
    ) -> None:
        def called(s: Any, a: Any, p: Any) -> Mapping[str, Any]:
            return function(s, p, a.t)

        called.__wrapped__ = function  # type: ignore[attr-defined]
        self.n, self.m, self.k = len(states), len(inputs), len(parameters)
        # "derivative": it is called without dt; of the System `evaluate` is all that is used.
        signature = Signature(
            called, "derivative", tuple(states), ("t",), tuple(parameters), tuple(inputs)
        )
        self._plain = DifferencedSystem(signature)
        found, self.note, self._variant = trace(signature, None, NO_STEP), "", None
        if isinstance(found, str):
            self.note = found
        elif not found.guards:
            self._variant = Variant(found, signature.sizes)

    def inputs(self, x: Array, t: Array, theta: Array) -> Array:
        """U (N, m) at x (N, n), times t (N,) [s], theta (k,)."""
        if self._variant is None:
            return self._plain.evaluate(x, t[:, None], theta, NO_STEP, 0.0)
        return self._variant.values(x, t[:, None], theta, NO_STEP, 0.0)

    def derivatives(self, x: Array, t: Array, theta: Array) -> tuple[Array, Array]:
        """pi_x (N, m, n) and pi_theta (N, m, k)."""
        if self._variant is None:
            return self._differenced(x, t, theta)
        width = self.n + 1 + self.k
        _, J = self._variant.linearised(x, t[:, None], theta, NO_STEP, 0.0, width)
        return J[:, :, : self.n], J[:, :, self.n + 1 :]

    def _differenced(self, x: Array, t: Array, theta: Array) -> tuple[Array, Array]:
        columns = []
        for i in range(self.n + self.k):
            ends = []
            for side in (1.0, -1.0):
                moved_x, moved_theta = x.copy(), theta.copy()
                if i < self.n:
                    moved_x[:, i] += side * RELATIVE_STEP
                else:
                    moved_theta[i - self.n] += side * RELATIVE_STEP
                ends.append(self.inputs(moved_x, t, moved_theta))
            columns.append((ends[0] - ends[1]) / (2 * RELATIVE_STEP))
        J = np.stack(columns, axis=2)
        return J[:, :, : self.n], J[:, :, self.n :]


def run_class(problem: Problem, policy: ParametricPolicy, theta: Array) -> Rollout:
    """Rolls pi(x, theta, t) out in the problem's model; inputs clipped to the limits."""
    n = problem.system.n
    z, u = np.empty((problem.horizon + 1, problem.nz)), np.empty((problem.horizon, policy.m))
    z[0] = problem.z_start()
    theta = np.asarray(theta, float)
    with np.errstate(all="ignore"):
        for t in range(problem.horizon):
            asked = policy.inputs(z[t : t + 1, :n], np.array([t * problem.dt]), theta)[0]
            u[t] = np.clip(asked, problem.low, problem.high)
            sent = problem.received(z[t], u[t], t)
            x = problem.system.step(
                z[t : t + 1, :n], sent[None], problem.p, problem.dt, problem.smoothing
            )
            z[t + 1, :n], z[t + 1, n:] = x[0] + problem.bias[t], problem.queue.after(z[t, n:], u[t])
    return Rollout(z, u, -float(trajectory_cost(problem, z, u)), n)


def class_gradient(
    problem: Problem, policy: ParametricPolicy, theta: Array, z: Array, u: Array
) -> Array:
    """dJ/dtheta (k,) along z (H+1, nz), u (H, m), which the policy has produced with theta."""
    n, H = problem.system.n, problem.horizon
    t = np.arange(H, dtype=np.float64) * problem.dt
    x = np.ascontiguousarray(z[:-1, :n])
    with np.errstate(all="ignore"):
        pi_x, pi_theta = policy.derivatives(x, t, np.asarray(theta, float))
    answer = np.zeros((H, policy.m, problem.nz))
    answer[:, :, :n] = pi_x
    free = free_inputs(problem, u)
    g, _ = adjoint(linearised(problem, z, u), answer, free)
    return np.asarray(np.einsum("tj,tjk->k", g * free, pi_theta))


def class_ascent(
    problem: Problem, policy: ParametricPolicy, theta: Array, z: Array, u: Array
) -> Array:
    """Theta (k,) moved up the utility's gradient by the length that gains most in the model.

    Parameters are measured by their own size (1 for those near zero).
    """
    theta = np.asarray(theta, float)
    unit = np.maximum(np.abs(theta), 0.1)
    slope = class_gradient(problem, policy, theta, z, u) * unit
    size = float(np.linalg.norm(slope))
    if not (np.isfinite(size) and size > 0):
        return theta
    return best_length(
        theta,
        lambda length: theta - length * unit * slope / size,
        lambda theta: -run_class(problem, policy, theta).utility,
    )
