"""Evaluate a candidate in all models that explain the stored trials, not just in one.

A predicted run follows its own reference, so its utility does not show how good the gains are under
disturbances. New gains can be worse than those of the incumbent: gains on unmeasured states (an
effect's memory, `corrected`) are dropped, and corrected derivatives may have been fitted to noise.
So a policy is run in models that are disturbed by the mispredictions y_j of OTHER trials,

    x_{t+1} = f(x_t, u_t) + bias_t + y_jt,

with the same disturbances for all policies (Ng & Jordan, "PEGASUS", UAI 2000), once with the
corrected derivatives and once with the model's own. The smaller a model's error on held-out trials,
the larger its weight.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from grounded.compile import Problem
from grounded.frozen import Array
from grounded.policy import Policy
from grounded.search.planner import predicted

WORST = 1e12  # cost of a run that diverges


@dataclass(frozen=True, eq=False)
class Alternative:
    """A model that replays the incumbent's trial, and its mispredictions of other trials."""

    weight: float
    problem: Problem
    off: tuple[Array, ...]  # y_j (H, n)

    def cost(self, policy: Policy) -> float:
        """Return the mean cost of a policy over the disturbances, times the weight."""
        if self.weight == 0:
            return 0.0
        return self.weight * float(np.mean([self._disturbed(y, policy) for y in self.off]))

    def _disturbed(self, y: Array, policy: Policy) -> float:
        bias = self.problem.bias.copy()
        bias[:, : y.shape[1]] += y
        cost = -predicted(replace(self.problem, bias=bias), policy).utility
        return cost if cost < WORST else WORST
