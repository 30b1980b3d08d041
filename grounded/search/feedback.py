"""What a candidate is worth in all models that explain the stored trials, not just in one.

A predicted run follows its own reference, so that its utility doesn't show what the gains are worth
once something disturbs it. New ones can be worse than those that have run: gains on states that no
sensor knows (an effect's memory, `corrected`) are dropped, and corrected slopes may have been
fitted to noise. So a policy is run in models that replay OTHER trials,

    x_{t+1} = f(x_t, u_t) + bias_t + y_jt,     y_j what the model mispredicts of trial j,

the same for all policies (Ng & Jordan, "PEGASUS", UAI 2000), with the corrected slopes and with the
model's own. Each counts the more, the less it misses of trials that were left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from grounded.compile import Problem
from grounded.frozen import Array
from grounded.policy import Policy
from grounded.search.planner import predicted

WORST = 1e12  # a run that diverges costs so much


@dataclass(frozen=True, eq=False)
class Alternative:
    """A model that replays the incumbent's trial, and what it is off by along others."""

    weight: float
    problem: Problem
    off: tuple[Array, ...]  # y_j (H, n)

    def cost(self, policy: Policy) -> float:
        """The mean cost of a policy, by weight."""
        if self.weight == 0:
            return 0.0
        return self.weight * float(np.mean([self._disturbed(y, policy) for y in self.off]))

    def _disturbed(self, y: Array, policy: Policy) -> float:
        bias = self.problem.bias.copy()
        bias[:, : y.shape[1]] += y
        cost = -predicted(replace(self.problem, bias=bias), policy).utility
        return cost if cost < WORST else WORST
