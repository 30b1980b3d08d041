"""Quadratic reward: penalties on the distance to a target, on inputs and on input changes.

    U = - sum_{t=0}^{H} |s_t - target_t|^2_W  - |s_H - target_H|^2_{W_H}
        - sum_{t=0}^{H-1} |a_t - a_target_t|^2_R + |a_t - a_{t-1}|^2_S

Section 2 (utility) and section 5 (the rewards of the experiments: deviation from the desired
trajectory, non-zero inputs, changes of inputs). Weights multiply squared errors, without a half.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grounded.checks import numbers, wrong
from grounded.frozen import Array


@dataclass(frozen=True, eq=False)
class Reward:
    """Weights of the quadratic reward; each multiplies a squared error, without a factor 1/2.

    Args:
        state: (n,) weight of each state's distance to the target, at every step [1/unit^2].
        terminal: (n,) additional weight on the last state [1/unit^2].
        input: (m,) weight of each input's distance to the input target (zero by default).
        input_change: (m,) weight of the change of each input from one step to the next.

    Raises:
        GroundedError: if a weight is negative or not finite.
    """

    state: Array
    terminal: Array
    input: Array
    input_change: Array

    def __post_init__(self) -> None:
        for name in ("state", "terminal", "input", "input_change"):
            weights = numbers(getattr(self, name), f"[reward] {name}")
            if not np.isfinite(weights).all() or (weights < 0).any():
                raise wrong(f"[reward] {name}", weights.tolist(), must="weights")
            object.__setattr__(self, name, weights)


def step_rewards(
    reward: Reward,
    error: Array,
    inputs: Array,
    input_target: Array,
    past: Array,
) -> Array:
    """Return the reward of every step, (H + 1,): negative penalties that sum to the utility.

    `error` is s_t - target_t with angles wrapped, (H + 1, n), NaN where not tracked; `past` (m,)
    was held before the inputs (H, m), whose target the paper has at zero.
    """
    tracked = np.where(np.isnan(error) & (reward.state + reward.terminal == 0), 0.0, error)
    with np.errstate(over="ignore", invalid="ignore"):  # diverged runs: see `Task.utility`
        penalty = tracked**2 @ reward.state
        penalty[-1] += tracked[-1] ** 2 @ reward.terminal
        change = np.diff(np.vstack([past, inputs]), axis=0)
        off = inputs - input_target
        penalty[:-1] += off**2 @ reward.input + change**2 @ reward.input_change
    return np.asarray(-penalty)
