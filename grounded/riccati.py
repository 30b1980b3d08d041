"""Riccati: the best small change of every input, and the feedback that goes with it.

About a trajectory (zbar, ubar) the problem is replaced by its quadratic model (Gauss-Newton: the
curvature of the dynamics is left out), and the value of being at z_t is swept back in time,

    V_t(dz) = min over du of  1/2 [dz du]' Q_t [dz du] + [Q_z Q_u] [dz du],

whose minimiser is du = k_t + K_t dz. Three things are this project's own:

- the state is z = [x, inputs already sent], so input changes and transport delays are exact;
- limits of the inputs are part of each step's quadratic programme (Tassa, Mansard, Todorov,
  "Control-limited differential dynamic programming", ICRA 2014): clamped inputs get no feedback;
- diag(damping) is added to Q_uu when the step is chosen, and left out of V (Tassa, Erez, Todorov,
  IROS 2012, eq. 11), so that d1 and d2 predict the true quadratic change.

The sweep itself belongs to a system (`compile/sweep.py`, or a compiled kernel): here it is made to
succeed, by raising the damping until every Q_uu is positive definite.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grounded.compile import Backward, Problem
from grounded.compile.descent import CEILING, FLOOR, GROWTH
from grounded.frozen import Array


@dataclass(frozen=True, eq=False)
class Sweep:
    """Gains of one sweep, and the regularisation `mu` at which it went through."""

    gains: Backward
    mu: float

    @property
    def ok(self) -> bool:
        """Whether the sweep went through at all."""
        return self.gains.failed_at < 0


def sweep(
    problem: Problem,
    z: Array,
    u: Array,
    damping: Array | None = None,
    mu: float = 0.0,
    into: Backward | None = None,
) -> Sweep:
    """Sweeps back along z (H+1, nz), u (H, m) with damping (m,) + mu * problem.input_scale.

    mu grows tenfold after each failure; when it passes 1e10 the failed sweep is returned, with
    `ok` False: the trajectory or the model holds no finite numbers. `into`: see `System.backward`.
    """
    base = np.zeros(problem.system.m) if damping is None else np.asarray(damping, float)
    scale = problem.input_scale
    gains = into
    while True:
        gains = problem.system.backward(problem, z, u, base + mu * scale, gains)
        if gains.failed_at < 0 or mu >= CEILING:
            return Sweep(gains, mu)
        mu = max(FLOOR, GROWTH * mu)
