"""Whether a loop holds where a robot acts on samples that are a part of a step old.

A controller of 20 Hz that takes the latest of 50 samples a second acts on one that is up to 20 ms
old. In a loop that holds, what such a lag costs grows with its square, for it shifts all that is
fed back by as much; in one that swings it grows far faster. A predicted run follows its own
reference and shows nothing of this.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from grounded.compile import Problem
from grounded.frozen import Array
from grounded.policy import Policy, z_difference

OLD = 0.4  # of a step: the age of the samples that a loop has to bear
LINEAR = 8.0  # times the cost at half that age: 4 where all is linear
CAUTIONS = (0.25, 0.5, 0.75, 1.0)  # of `Maker`: gains that are tried
NOTHING = 1e-3  # of what the run costs: a lag that costs no more shows nothing


def steadied(problem: Problem, policy: Policy, gently: Callable[[float], Policy]) -> Policy:
    """The policy, or the least gentle one that holds; as it is where none does.

    Gains on what a robot measures of a model that remembers more (a limit of an input's rate, a
    delay behind it) may be left without any margin.

    Args:
        problem: that predicts its run.
        policy: as a robot runs it.
        gently: the same run with gains for inputs that are dearer, by a caution.
    """
    if holds(problem, policy):
        return policy
    gentler = map(gently, CAUTIONS)
    return next((one for one in gentler if holds(problem, one)), policy)


def holds(problem: Problem, policy: Policy) -> bool:
    """Whether what old samples cost grows as in a loop that holds."""
    fresh, half, old = costs_of(problem, policy, np.array([0.0, OLD / 2, OLD])).tolist()
    if not np.isfinite([fresh, half, old]).all():
        return False
    return bool(old - fresh <= max(LINEAR * (half - fresh), NOTHING * fresh))


def costs_of(problem: Problem, policy: Policy, ages: Array) -> Array:
    """What runs cost in a model, fed back by samples of an age, (A,); infinite where they diverge.

    Args:
        problem: the model, with a bias or without.
        policy: over its z, or fewer states, as a robot runs it.
        ages: (A,) of the samples in steps, at most 1; between two of them on the line that joins
            them.
    """
    n, H, rows = problem.system.n, problem.horizon, len(ages)
    angles = tuple(map(bool, problem.angles))
    policy = policy.laid_out(problem.system.states, angles, problem.depths)
    z, total = np.repeat(problem.z_start()[None], rows, axis=0), np.zeros(rows)
    last, sent = z[:, :n], np.repeat(problem.past[None], rows, axis=0)
    with np.errstate(all="ignore"):
        for t in range(H):
            u, seen = np.repeat(policy.feedforward[t][None], rows, axis=0), z.copy()
            seen[:, :n] += ages[:, None] * z_difference(last, z[:, :n], angles)
            if policy.gain is not None and policy.reference is not None:
                u += z_difference(seen, policy.reference[t], angles) @ policy.gain[t].T
            u = np.clip(u, problem.low, problem.high)
            total += _off(problem, z, t)
            total += (u - problem.input_target[t]) ** 2 @ problem.input_weight
            total += (u - sent) ** 2 @ problem.change_weight
            received = np.ascontiguousarray(problem.received(z, u, t))
            x = np.ascontiguousarray(z[:, :n])
            moved = problem.system.moved(problem, x, received, t) + problem.bias[t]
            last, sent = z[:, :n], u
            z = np.concatenate([moved, problem.queue.after(z[:, n:], u)], axis=1)
        total += _off(problem, z, H)
    return np.where(np.isfinite(z).all(axis=1) & np.isfinite(total), total, np.inf)


def _off(problem: Problem, z: Array, t: int) -> Array:
    """What the states cost at step t, (A,)."""
    off = z_difference(z[:, : problem.system.n], problem.target[t], tuple(problem.angles))
    return np.asarray(np.nan_to_num(off) ** 2 @ problem.state_weight[t])
