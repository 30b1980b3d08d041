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

from grounded.compile.problem import Problem
from grounded.compile.run.interpreted import linearised
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


def gradient(
    problem: Problem, z: Array, u: Array, policy: Policy | None = None, held: bool = True
) -> Gradient:
    """dJ/dtheta along z (H+1, nz), u (H, m), which `policy` (None: open loop) has produced.

    Args:
        problem: the biased model.
        z: the trajectory.
        u: its inputs.
        policy: theta; its gains are about the problem's z.
        held: whether limits hold the inputs that lie on them.
    """
    local = linearised(problem.system, problem, z, u)
    free = np.where(held & ((u <= problem.low) | (u >= problem.high)), 0.0, 1.0)  # C
    gain, zbar = (None, None) if policy is None else (policy.gain, policy.reference)
    g, slope = np.empty_like(u), local.l_z[-1]  # slope: lambda
    with np.errstate(all="ignore"):
        for t in range(len(u) - 1, -1, -1):
            g[t] = free[t] * (local.l_u[t] + local.B[t].T @ slope)
            slope = local.l_z[t] + local.A[t].T @ slope
            if gain is not None:
                slope = slope + gain[t].T @ g[t]
    if gain is None or zbar is None:
        return Gradient(g)
    return Gradient(g, g[:, :, None] * wrapped(z[:-1] - zbar, problem.angles)[:, None, :])


def ascent(task: Task, policy: Policy, grounding: Grounding) -> Policy:
    """Step 5 by Eq. (4): theta' = theta + s (dU/dtheta), s the best length in the biased model.

    The policy itself when no length gains anything: then it is stationary in the biased model. An
    input at its limit does not move the cost while the policy asks for more than the limit; but an
    open-loop sequence lies ON the limit, and may come back from it.

    Args:
        task: the manoeuvre, with the original model.
        policy: theta, that ran the trial.
        grounding: the trial as the biased model replays it.
    """
    problem, z, u = grounding.on(task.problem()), grounding.z, grounding.inputs
    found, scale = gradient(problem, z, u, policy), problem.input_scale
    full = gradient(problem, z, u, held=False).inputs
    inward = ((u <= problem.low) & (full < 0)) | ((u >= problem.high) & (full > 0))
    d = -np.where(inward, full, found.inputs) / scale
    D = 0.0 if found.gain is None else -found.gain / scale[:, None]
    limits = (policy.low, policy.high) if policy.gain is None else (-np.inf, np.inf)
    best, lowest = policy, -simulate(problem, policy).utility
    for length in LENGTHS.tolist():
        gain = None if policy.gain is None else policy.gain + length * D
        forward = np.clip(policy.feedforward + length * d, *limits)
        candidate = replace(policy, feedforward=forward, gain=gain)
        cost = -simulate(problem, candidate).utility
        if cost < lowest:
            best, lowest = candidate, cost
        elif best is not policy:
            break  # shorter ones gain less and less
    return best
