"""Starts: what the start states of real runs cost, by the planning model.

A run that began off s_0 has another utility than its policy has from s_0. The model runs the policy
from both; the difference is what the start cost. Two candidates whose runs began alike are compared
as they are, whatever their common start costs.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from grounded.places import true_values
from grounded.search.planner import Planner, predicted
from grounded.search.scatter import beyond_noise

if TYPE_CHECKING:
    from grounded.frozen import Array
    from grounded.policy import Policy
    from grounded.search.candidate import Tried


class Starts:
    """What the starts of runs cost, each run predicted only once.

    Args:
        planner: has the model that predicts the runs.
    """

    def __init__(self, planner: Planner) -> None:
        self.planner, self._known = planner, dict[tuple[str, int], float]()

    def owed(self, one: Tried, other: Tried) -> float:
        """Return the part of the difference of two mean utilities that is due to the starts.

        It is 0 if all runs began alike, and NaN if the model can't tell it. Where repeats bear out
        that their starts are most of what runs scatter by, no two runs began alike.
        """
        if one.placed or other.placed:
            return self.cost(other) - self.cost(one)
        starts = np.array([t.began for tried in (one, other) for t in tried.trials])
        middle, model = starts.mean(axis=0), self.planner.task.model
        with np.errstate(all="ignore"):  # of diverged runs
            apart = any(
                beyond_noise(
                    (trial,),
                    model.difference(trial.began, middle)[None],
                    tried.candidate.predicted_states[0],
                    tried.candidate.predicted_states,
                ).any()
                for tried in (one, other)
                for trial in tried.trials
            )
        return self.cost(other) - self.cost(one) if apart else 0.0

    def cost(self, tried: Tried) -> float:
        """Return what the starts of a candidate's runs cost on average; < 0 for lucky ones.

        It is NaN if a run fails in the model, or if a start would cost more than the whole run did.
        """
        return float(np.mean(self.costs(tried)))

    def costs(self, tried: Tried) -> Array:
        """Return what the start of each of a candidate's runs cost, (runs,), see `cost`."""
        return np.array([self._of(tried, k) for k in range(len(tried.trials))])

    def _of(self, tried: Tried, k: int) -> float:
        key = (tried.candidate.id, k)
        if key not in self._known:
            task, began = self.planner.task, tried.trials[k].began
            off = task.model.difference(began, task.start)
            self._known[key] = -worth_of_start(self.planner, tried.candidate.policy, off)
        cost = self._known[key]
        return cost if math.isfinite(cost) and cost <= -tried.utilities[k] else math.nan


def worth_of_start(planner: Planner, policy: Policy, off: Array) -> float:
    """Return by how much a start that is off s_0 by `off` (n,) changes the utility in the model.

    True values behind late or filtered logs are off by as much: else the log would soon show the
    robot at s_0. NaN if the model fails from s_0, -inf if it fails from there only.
    """
    problem = planner.feeding_back((policy,)).plan.problem(exact=True)
    moved, names, n = problem.start.copy(), planner.plan.model.state_names, len(off)
    moved[:n] += off
    for memory, logged in true_values(names, names[n:]).items():
        moved[memory] += off[logged]
    with np.errstate(all="ignore"):
        from_there, from_s_0 = (
            predicted(replace(problem, start=start), policy).utility
            for start in (moved, problem.start)
        )
    return float(from_there - from_s_0)
