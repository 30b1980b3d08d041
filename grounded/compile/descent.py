"""What the loop of `ddp.solve` and its compiled twin (`llvm_descent.py`) have in common."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from grounded.compile.problem import Array

Status = Literal["converged", "no improvement", "max iterations", "not finite"]
STATUSES: tuple[Status, ...] = ("converged", "no improvement", "max iterations", "not finite")

FLOOR = 1e-6  # first regularisation after a failed factorisation
SEARCH_FLOOR = 1e-3  # regularisation after a failed search
GROWTH = 10.0
CEILING = 1e10
LARGE_MU = 1.0
LEAST = 1e-14  # a predicted change that is none


@dataclass(frozen=True)
class Options:
    """Settings of `ddp.solve`."""

    max_iterations: int = 100
    tolerance: float = 1e-8  # stop when the predicted change is below this times the cost
    halvings: int = 11  # alpha = 1 ... 1/2^11
    accept: float = 0.1  # least part of the predicted change


@dataclass(frozen=True, eq=False)
class Descent:
    """Where the loop ended: the last trajectory, the gains of the last sweep, a line a search."""

    status: Status
    z: Array  # (H+1, nz)
    u: Array  # (H, m)
    k: Array  # (H, m)
    K: Array  # (H, m, nz)
    cost: float
    failed_at: int  # "not finite": the step at which the last sweep failed, -1 before the first
    lines: Array  # (i, 4): cost, predicted change, alpha (0: none was accepted), mu
