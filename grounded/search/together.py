"""Simulates many policies in one model at once, for systems whose steps are not compiled.

Each step of such a system (`Corrected`) takes as long for twenty runs as for one. A check of gains
needs hundreds of runs, which took a minute of CPU one after the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from grounded.compile import Problem, deepest
from grounded.compile.run.interpreted import trajectory_cost
from grounded.frozen import Array, wrapped
from grounded.policy import Policy
from grounded.rollout import SETTLED, seen_late
from grounded.search.corrected import Corrected
from grounded.search.planner import predicted

MOST = 2**22  # gains held at once


def runs(problem: Problem, policies: Sequence[Policy]) -> tuple[Array, Array]:
    """Return the states (P, H + 1, n) and costs (P,) of predicted runs, see `predicted`.

    Args:
        problem: the problem that predicts the runs.
        policies: of one horizon, with feedback, over the problem's z or fewer states.
    """
    system = problem.system
    if not isinstance(system, Corrected):
        each = [predicted(problem, policy) for policy in policies]
        return np.array([one.states for one in each]), np.array([-one.utility for one in each])
    room = max(1, MOST // (problem.horizon * problem.nz * system.m))
    if len(policies) > room:  # long horizons
        parts = [runs(problem, policies[i : i + room]) for i in range(0, len(policies), room)]
        states, costs = zip(*parts, strict=True)
        return np.concatenate(states), np.concatenate(costs)
    for policy in policies:  # z holds all past inputs that any of them feeds back
        problem = replace(problem, fed_back=deepest(problem.depths, policy.depths))
    angles = tuple(map(bool, problem.angles))
    laid = [p.laid_out(system.states, angles, problem.depths) for p in policies]
    sent = np.array([p.feedforward for p in laid])
    K, aim = np.array([p.gain for p in laid]), np.array([p.reference for p in laid])
    z, found = _run(problem, system, sent, K, aim)
    left, n = np.arange(len(laid) if problem.age else 0), system.n
    for _ in range(problem.horizon):  # as in `simulate`, each until it agrees with what was seen
        if not len(left):
            break
        late = [seen_late(run[:-1, :n], problem.age / problem.dt, angles) for run in z[left]]
        seen = aim[left].copy()
        seen[:, :, :n] -= late
        again, found[left] = _run(problem, system, sent[left], K[left], seen)
        scale = 1.0 + np.abs(again).max(axis=1, keepdims=True)
        moved = (np.abs(again - z[left]) > SETTLED * scale).any(axis=(1, 2))
        z[left] = again
        left = left[moved]
    return z[:, :, :n], np.where(np.isfinite(found), found, np.inf)


def _run(
    problem: Problem, system: Corrected, sent: Array, K: Array, aim: Array
) -> tuple[Array, Array]:
    """Return z (P, H + 1, nz) and the costs (P,) of closed loops.

    Args:
        problem: the problem that predicts the runs.
        system: its system.
        sent: feedforward inputs (P, H, m).
        K: gains (P, H, m, nz).
        aim: reference of z (P, H, nz).
    """
    queue, n, H = problem.queue, system.n, problem.horizon
    z, u = np.empty((len(sent), H + 1, problem.nz)), np.empty((len(sent), H, system.m))
    z[:, 0] = problem.z_start()
    with np.errstate(all="ignore"):
        for t in range(H):
            off = wrapped(z[:, t] - aim[:, t], problem.angles)
            fed_back = (K[:, t] @ off[:, :, None])[:, :, 0]
            u[:, t] = np.clip(sent[:, t] + fed_back, problem.low, problem.high)
            received = problem.received(z[:, t], u[:, t], t)
            z[:, t + 1, :n] = system.stepped(problem, z[:, t, :n], received, t) + problem.bias[t]
            z[:, t + 1, n:] = queue.after(z[:, t, n:], u[:, t])
        return z, trajectory_cost(problem, z, u)
