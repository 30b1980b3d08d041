"""What a peer's script gets: the arrays of a case, and a way to report."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from types import ModuleType, SimpleNamespace

import numpy as np
from models import rate_of

CLOSE = 1e-4  # a solver is done when its cost is this near to the best known, relatively


def load(xp: ModuleType) -> SimpleNamespace:
    """The case named on the command line: argv[1] the file, argv[2] the best cost.

    Args:
        xp: whose functions its model calls.
    """
    data = dict(np.load(sys.argv[1]))
    case = SimpleNamespace(**data, best=float(sys.argv[2]))
    case.name, case.dt = str(case.name), float(case.dt)
    case.rate = rate_of(case.name, xp)
    case.H, case.m = case.u.shape
    case.n = len(case.start)
    case.repeats = 1 if case.name == "aircraft" else 3  # of a slow peer's timing
    return case


def reached(case: SimpleNamespace, cost: float) -> bool:
    """Whether a cost counts as the best known."""
    return cost <= case.best * (1 + CLOSE)


def fastest(function: Callable[[], object], repeats: int) -> float:
    """Least CPU seconds of a few calls."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return min(times)


def report(**values: object) -> None:
    """One JSON line on stdout."""
    print(json.dumps(values))
