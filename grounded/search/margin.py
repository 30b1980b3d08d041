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
    fresh, half, old = (cost_of(problem, policy, age) for age in (0.0, OLD / 2, OLD))
    if not np.isfinite([fresh, half, old]).all():
        return False
    return old - fresh <= max(LINEAR * (half - fresh), NOTHING * fresh)


def cost_of(problem: Problem, policy: Policy, age: float) -> float:
    """What a run costs in a model, fed back by samples of an age (infinite where it diverges).

    Args:
        problem: the model, with a bias or without.
        policy: over its z, or fewer states, as a robot runs it.
        age: of the samples in steps, at most 1; between two of them on the line that joins them.
    """
    n = problem.system.n
    angles = tuple(map(bool, problem.angles))
    policy = policy.laid_out(problem.system.states, angles, problem.depths)
    z, last, total, sent = problem.z_start(), problem.start, 0.0, problem.past
    with np.errstate(all="ignore"):
        for t in range(problem.horizon):
            u, seen = policy.feedforward[t], z.copy()
            seen[:n] += age * z_difference(last, z[:n], angles)
            if policy.gain is not None and policy.reference is not None:
                u = u + policy.gain[t] @ z_difference(seen, policy.reference[t], angles)
            u = np.clip(u, problem.low, problem.high)
            off = z_difference(z[:n], problem.target[t], angles)
            total += float(problem.state_weight[t] @ np.nan_to_num(off) ** 2)
            total += float(problem.input_weight @ (u - problem.input_target[t]) ** 2)
            total += float(problem.change_weight @ (u - sent) ** 2)
            received = problem.received(z[None], u[None], t).reshape(1, -1)
            x = problem.system.step(z[None, :n], received, problem.p, problem.dt)[0]
            last, sent = z[:n], u
            z = np.concatenate([x + problem.bias[t], problem.queue.after(z[n:], u)])
        off = z_difference(z[:n], problem.target[problem.horizon], angles)
        total += float(problem.state_weight[problem.horizon] @ np.nan_to_num(off) ** 2)
    return total if np.isfinite(total) and np.isfinite(z).all() else np.inf
