"""A finite-horizon tracking problem in plain arrays: all that a kernel knows of a task.

The state a kernel works on is augmented with the inputs already sent,

    z_t = [x_t, u_0[t-1] .. u_0[t-D_0], u_1[t-1] .. u_1[t-D_1], ...],

because two things need them: the cost of input CHANGES (u_t - u_{t-1}) and the transport DELAY of
an input. D_j = max(1, ceil(delay_j)); with delay_j = d + phi (0 <= phi < 1, in steps) the actuator
receives, under a zero-order hold, the mean over the step (1 - phi) u_j[t-d] + phi u_j[t-d-1].

    x_{t+1} = f(x_t, u_eff_t - input_shift_t) + bias_t
    J = sum_t  W_t |x_t - target_t|^2 + R |u_t - u_target_t|^2 + S |u_t - u_{t-1}|^2
        + W_H |x_H - target_H|^2,                         low <= u_t <= high

J is a COST: minus the paper's utility. Errors of states marked as angles wrap to [-pi, pi].
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from grounded.compile.system import System

Array = NDArray[np.float64]


def history_depths(delay: Array) -> tuple[int, ...]:
    """Past inputs kept for each input, D_j = max(1, ceil(delay_j)); delay (m,) in steps."""
    return tuple(max(1, int(np.ceil(d - 1e-9))) for d in delay)


@dataclass(frozen=True, eq=False)
class Problem:
    """Sizes: n states, m inputs, k parameters, H steps, D = sum of the history depths."""

    system: System
    p: Array  # (k,) parameter values
    dt: float  # [s]
    start: Array  # (n,) s_0
    past: Array  # (m,) the input that was held before t = 0
    delay: Array  # (m,) transport delay in steps, any fraction
    bias: Array  # (H, n) added to every step (step 4); zeros for the model as it is
    target: Array  # (H + 1, n); entries that are not tracked have weight 0
    state_weight: Array  # (H + 1, n); row H already includes the terminal weight
    input_target: Array  # (H, m)
    input_weight: Array  # (m,) R
    change_weight: Array  # (m,) S
    low: Array  # (m,) hard limits, may be -inf
    high: Array  # (m,) may be +inf
    angles: NDArray[np.bool_]  # (n,)
    input_shift: Array | None = None  # (H, m) off what the actuators receive, see `matching`
    smoothing: float = 0.0  # width of the smoothed indicator terms; 0: exact

    @property
    def horizon(self) -> int:
        """H, the number of control steps."""
        return int(self.bias.shape[0])

    @cached_property
    def depths(self) -> tuple[int, ...]:
        """Past inputs in z for each input."""
        return history_depths(self.delay)

    @cached_property
    def input_scale(self) -> Array:
        """The natural unit of damping for each input (m,): the curvature 2 (R + S) of its own cost.

        An input without a cost of its own takes the mean of the others, or 1.
        """
        scale = 2.0 * (self.input_weight + self.change_weight)
        positive = scale[scale > 0]
        return np.where(scale > 0, scale, positive.mean() if positive.size else 1.0)

    @property
    def nz(self) -> int:
        """Size of the augmented state z."""
        return self.system.n + sum(self.depths)

    def z_start(self) -> Array:
        """z_0: the start state and the input held before it, (nz,)."""
        held = [np.full(d, self.past[j]) for j, d in enumerate(self.depths)]
        return np.concatenate([self.start, *held])
