"""Policy gradient: the second method A of the paper, Eq. (4).

The derivative of the utility with respect to the policy's parameters theta, taken in the biased
model and therefore along the REAL trajectory: the states are the trial's own, only the derivatives
come from the model. Backwards in time, with g_t the sensitivity of the remaining cost to u_t,

    g_t      = l_u + B_t' lambda_{t+1}                    lambda_H = l_z(z_H)
    lambda_t = l_z + A_t' lambda_{t+1} + pi_z' C_t g_t    (pi_z: how the policy answers the state)
    dJ/dtheta = sum_t pi_theta' C_t g_t

C_t drops the inputs that a limit holds: there the policy has no say. J is the cost, minus the
utility. theta is one of

    open loop    the inputs ubar (H, m) themselves
    feedback     ubar (H, m) and the gains K (H, m, nz) of u = ubar + K (z - zbar)

A gradient has a direction and no length. `ascent` measures inputs by the curvature 2 (R + S) of
their own cost, and takes the length that gains most in the biased model.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from grounded.checks import of_shape
from grounded.compile import Problem
from grounded.compile.run.interpreted import Quadratic
from grounded.compile.run.interpreted import linearised as quadratic_model
from grounded.frozen import Array, wrapped
from grounded.rollout import simulate

if TYPE_CHECKING:
    from grounded.policy import Policy
    from grounded.solve.bias import Grounding
    from grounded.task import Task

LENGTHS = 2.0 ** np.arange(3, -25, -1)  # of a step, in units of the scaled gradient


@dataclass(frozen=True, eq=False)
class Gradient:
    """Derivatives of the cost J: by the inputs (H, m), and by the gains (H, m, nz) if there are."""

    inputs: Array
    gain: Array | None = None


def gradient(problem: Problem, z: Array, u: Array, policy: Policy | None = None) -> Gradient:
    """dJ/dtheta along z (H+1, nz), u (H, m), which `policy` (None: open loop) has produced.

    Raises:
        GroundedError: for arrays that do not fit, or a policy about another z.
    """
    local = linearised(problem, z, u)
    free = free_inputs(problem, u)
    if policy is None or policy.gain is None or policy.reference is None:
        g, _ = adjoint(local, np.zeros((*u.shape, z.shape[1])), free)
        return Gradient(g * free)
    of_shape("gain", policy.gain, (*u.shape, z.shape[1]))
    g, _ = adjoint(local, policy.gain, free)
    dz = wrapped(z[:-1] - policy.reference, problem.angles)
    return Gradient(g * free, (g * free)[:, :, None] * dz[:, None, :])


def linearised(problem: Problem, z: Array, u: Array) -> Quadratic:
    """The problem's dynamics and cost about z (H+1, nz), u (H, m)."""
    H, nz = problem.horizon, problem.nz
    of_shape("states of a trajectory", z, (H + 1, nz))
    of_shape("inputs of a trajectory", u, (H, problem.system.m))
    return quadratic_model(problem.system, problem, z, u)


def adjoint(local: Quadratic, answer: Array, free: Array) -> tuple[Array, Array]:
    """The backward pass: g (H, m) and lambda (H+1, nz).

    Args:
        local: dynamics and cost along the trajectory.
        answer: pi_z (H, m, nz), how inputs answer the state.
        free: (H, m) 1 where an input is not held by a limit, else 0.
    """
    H = len(answer)
    g, slope = np.empty(answer.shape[:2]), np.empty_like(local.l_z)
    slope[H] = local.l_z[H]
    with np.errstate(all="ignore"):
        for t in range(H - 1, -1, -1):
            g[t] = local.l_u[t] + local.B[t].T @ slope[t + 1]
            slope[t] = local.l_z[t] + local.A[t].T @ slope[t + 1] + answer[t].T @ (free[t] * g[t])
    return g, slope


def free_inputs(problem: Problem, u: Array) -> Array:
    """1 where an input is strictly inside its limits."""
    return ((u > problem.low) & (u < problem.high)).astype(float)


def ascent(task: Task, policy: Policy, grounding: Grounding) -> Policy:
    """Step 5 by Eq. (4): theta' = theta + s (dU/dtheta), s the best length in the biased model.

    The policy itself when no length gains anything: then it is stationary in the biased model.

    Args:
        task: the manoeuvre, with the original model.
        policy: theta, that ran the trial.
        grounding: the trial as the biased model replays it.
    """
    problem = grounding.on(task.problem())
    found = gradient(problem, grounding.z, grounding.inputs, policy)
    scale = problem.input_scale
    d = -_descended(problem, grounding, found.inputs) / scale
    D = None if found.gain is None else -found.gain / scale[:, None]

    def moved(length: float) -> Policy:
        gain = policy.gain
        if gain is not None and D is not None:
            gain = gain + length * D
        forward = policy.feedforward + length * d
        return replace(policy, feedforward=np.clip(forward, *_room(policy, forward)), gain=gain)

    best, lowest = policy, -simulate(problem, policy).utility
    for length in LENGTHS.tolist():
        candidate = moved(length)
        cost = -simulate(problem, candidate).utility
        if cost < lowest:
            best, lowest = candidate, cost
        elif best is not policy:
            break  # shorter ones gain less and less
    return best


def _descended(problem: Problem, grounding: Grounding, g: Array) -> Array:
    """The gradient without what pushes inputs that sit at a limit further out.

    An input at its limit does not move the cost while the policy asks for more than the limit; but
    an open-loop sequence lies ON the limit, and may come back from it.
    """
    local = linearised(problem, grounding.z, grounding.inputs)
    full, _ = adjoint(local, np.zeros((*g.shape, problem.nz)), np.zeros_like(g))
    u = grounding.inputs
    inward = ((u <= problem.low) & (full < 0)) | ((u >= problem.high) & (full > 0))
    return np.where(inward, full, g)


def _room(policy: Policy, forward: Array) -> tuple[Array, Array]:
    """Limits of a feed-forward: the inputs' own without feedback, none with it."""
    if policy.gain is None:
        return policy.low, policy.high
    return np.full_like(forward, -np.inf), np.full_like(forward, np.inf)
