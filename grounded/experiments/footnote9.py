"""Footnote 9: an arbitrarily wrong model whose policy one iteration makes optimal.

    H = 1,  f(s, a) = a,  R(s) = C exp(-s^2),        model f_hat(s, a) = a + b

The model's optimal action is -b, with a real reward of C exp(-b^2): for large b and C, arbitrarily
worse than the optimum C. Its derivatives are exact, epsilon = 0, so by Theorem 1 the algorithm
reaches the optimum; the paper adds "in a single iteration". That holds for a method A that runs to
convergence in the biased model: the project's own search does this on -s^2 = log(R / C), which
ranks the policies as R does. (The gradient of R itself, 2 C b exp(-b^2), vanishes with b.)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from grounded.experiments.jobs import StudyTable
from grounded.model import Model, Param
from grounded.search.ask_tell import learn
from grounded.search.candidate import Candidate
from grounded.search.step_size import SearchOptions
from grounded.task import Task
from grounded.trial import Trial
from grounded.utility import Reward

OFFSETS = (1.0, 2.0, 3.0, 5.0, 10.0, 30.0)


@dataclass(frozen=True)
class Footnote9Row:
    """Results for one b; utilities as a share of the optimum C."""

    b: float
    model_based: float
    solved: float  # after one iteration
    solved_trials: int


@dataclass(frozen=True)
class Footnote9Result:
    """Results for all b."""

    rows: tuple[Footnote9Row, ...]

    def to_json(self) -> dict[str, Any]:
        """Return the rows as plain values."""
        return {"rows": [vars(row) for row in self.rows], "paper": {"iterations": 1}}

    def tables(self) -> list[StudyTable]:
        """Return the shares of the optimum by b."""
        head = ("b", "model-based", "one iteration (trials)")
        rows = tuple(
            (f"{r.b:g}", f"{r.model_based:.3g}", f"{r.solved:.6f} ({r.solved_trials})")
            for r in self.rows
        )
        return [StudyTable("Footnote 9: utility as a share of the optimum", head, rows)]


def run(offsets: Sequence[float] = OFFSETS) -> Footnote9Result:
    """Compare the model's policy and one iteration of the algorithm for each b in `offsets`."""
    return Footnote9Result(tuple(map(_row, offsets)))


def _row(b: float) -> Footnote9Row:
    zero, one = np.zeros(1), np.ones(1)
    model = Model(
        name="footnote 9",
        states={"s": "1"},
        inputs={"a": "1"},
        params={"b": Param(b)},
        step=lambda s, a, p, dt: {"s": a.a + p.b},
    )
    task = Task(
        model=model,
        dt=1.0,
        target=np.zeros((2, 1)),
        reward=Reward(zero, one, zero, zero),  # -s^2 after the step
        start=zero,
        past=zero,
        low=np.full(1, -1e3),
        high=np.full(1, 1e3),
        feedback=False,
    )

    def real(candidate: Candidate) -> Trial:
        a = candidate.policy.feedforward
        return Trial(np.vstack([np.zeros((1, 1)), a]), a, 1.0, ("s",), ("a",))

    found = learn(task, real, SearchOptions(step="full"), max_iterations=1, check=False)
    share = math.exp(found.standing.utilities[-1])
    return Footnote9Row(b, math.exp(-(b**2)), share, len(found.trials))
