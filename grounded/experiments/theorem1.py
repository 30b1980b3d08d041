"""Theorem 1: distance from a stationary point where the algorithm ends, for a model error epsilon.

A deterministic pendulum with a torque, H = 40 steps. The model's dynamics are the true ones plus a
smooth error whose derivatives by states and inputs are at most epsilon (in the rates; in a step,
epsilon dt, a factor that is absorbed in K),

    f_hat = f + epsilon e(s, a),      |de/ds|, |de/da| <= 1.

Method A is policy gradient on the inputs, with an exact line search (eta = 0), until the real
utility can't be improved along the model's gradient. Then the theorem states

    |grad U - grad U^| <= K epsilon       (Eqn 7: slope 1 in a log-log plot)
    |grad U|^2         <= 2 K^2 epsilon^2 (Eqn 6: slope 2)

K is measured as the largest |grad U - grad U^| / epsilon along the way. (Two errata of the paper:
Eqn 1 omits the policy in h_t, and the improvement that Eqn 12 guarantees a successful search is
K^2 epsilon^2 / (2 M).)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Unpack

import numpy as np

from grounded.compile import Problem
from grounded.experiments.jobs import Running, StudyTable, every, loglog_slope, mean_se, run_study
from grounded.frozen import Array
from grounded.model import Model, Param
from grounded.result import plain
from grounded.solve.bias import ground
from grounded.solve.policy_gradient import gradient
from grounded.task import Task
from grounded.trial import Trial
from grounded.utility import Reward

EPSILONS = (0.003, 0.01, 0.03, 0.1, 0.3)
H, DT = 40, 0.1
ITERATIONS = 3000
GOLDEN = (math.sqrt(5) - 1) / 2


@dataclass(frozen=True)
class Theorem1Row:
    """One search: gradient error at its start, squared gradient at its end, largest K."""

    epsilon: float
    seed: int
    error: float  # |grad U - grad U^| at the first policy
    squared: float  # |grad U|^2 where the line search ended
    K: float
    iterations: int

    @property
    def ratio(self) -> float:
        """|grad U|^2 over the bound 2 K^2 epsilon^2."""
        return self.squared / (2 * (self.K * self.epsilon) ** 2)


@dataclass(frozen=True)
class Theorem1Result:
    """All searches."""

    rows: tuple[Theorem1Row, ...]

    def slopes(self) -> dict[str, tuple[float, float]]:
        """Return slopes of gradient error and squared gradient over epsilon: mean, std error.

        One slope per seed, because K depends on the shape of the model's error.
        """
        found: dict[str, list[float]] = {"gradient_error": [], "squared_gradient": []}
        for seed in dict.fromkeys(row.seed for row in self.rows):
            own = [row for row in self.rows if row.seed == seed]
            x = [row.epsilon for row in own]
            found["gradient_error"].append(loglog_slope(x, [row.error for row in own]))
            found["squared_gradient"].append(loglog_slope(x, [row.squared for row in own]))
        return {name: mean_se(values) for name, values in found.items()}

    def to_json(self) -> dict[str, Any]:
        """Return rows and slopes as plain values."""
        slopes = {k: {"slope": v[0], "se": v[1]} for k, v in self.slopes().items()}
        worst = max(row.ratio for row in self.rows)
        paper = {"gradient_error": 1, "squared_gradient": 2}
        found: dict[str, Any] = {"rows": [vars(r) for r in self.rows], "slopes": slopes}
        found |= {"largest_ratio_to_bound": worst, "paper": paper}
        found |= {"K": max(row.K for row in self.rows)}
        return dict(plain(found))

    def tables(self) -> list[StudyTable]:
        """Return medians by epsilon, and the slopes beside the theorem's."""
        rows = []
        for epsilon in dict.fromkeys(row.epsilon for row in self.rows):
            own = [row for row in self.rows if row.epsilon == epsilon]
            rows.append(
                (
                    f"{epsilon:g}",
                    f"{np.median([row.error for row in own]):.3g}",
                    f"{np.median([row.squared for row in own]):.3g}",
                    f"{max(row.ratio for row in own):.3f}",
                )
            )
        head = (
            "epsilon",
            "|grad U - grad U^|",
            "|grad U|^2 at the end",
            "share of 2 K^2 epsilon^2, at most",
        )
        found = self.slopes()
        slopes = tuple(
            (name, _with_error(*found[key]), paper)
            for name, key, paper in (
                ("gradient error over epsilon", "gradient_error", "1"),
                ("squared gradient over epsilon", "squared_gradient", "2"),
            )
        )
        seeds = len(self.rows) // max(len(rows), 1)
        title = f"Theorem 1: medians of {seeds} seeds" if seeds > 1 else "Theorem 1: one seed"
        return [
            StudyTable(title, head, tuple(rows)),
            StudyTable("Slopes (± one standard error)", ("", "here", "of the bound"), slopes),
        ]


def _with_error(value: float, error: float) -> str:
    return f"{value:.3f} (±{error:.3f})" if math.isfinite(error) else f"{value:.3f}"


def run(
    seeds: Sequence[int] = range(8),
    *,
    epsilons: Sequence[float] = EPSILONS,
    **how: Unpack[Running],
) -> Theorem1Result:
    """Run a search for each epsilon and seed; the seed sets the shape of the model's error."""
    cases = every(epsilon=map(float, epsilons), seed=seeds)
    return Theorem1Result(run_study(Theorem1Row, theorem1_job, cases, **how))


def _dynamics(s: Any, a: Any, p: Any) -> dict[str, Any]:
    # its derivatives are epsilon |cos| times weights of unit norm, so at most epsilon
    wrong = p.eps * np.sin(p.w1 * s.angle + p.w2 * s.rate + p.w3 * a.torque + p.phase)
    return {"angle": s.rate, "rate": a.torque - np.sin(s.angle) - 0.2 * s.rate + wrong}


def theorem1_task(epsilon: float, seed: int) -> Task:
    """Return the task to swing a pendulum to one radian and hold it, with a model error epsilon."""
    rng = np.random.default_rng([seed, 5])
    weights = rng.normal(size=3)
    weights /= np.linalg.norm(weights)
    names = dict(zip(("w1", "w2", "w3"), map(float, weights), strict=True))
    phase = float(rng.uniform(-np.pi, np.pi))
    params = {name: Param(value) for name, value in (names | {"phase": phase}).items()}
    model = Model(
        name="theorem 1",
        states={"angle": "rad", "rate": "rad/s"},
        inputs={"torque": "1/s^2"},
        params={"eps": Param(epsilon), **params},
        derivative=_dynamics,
    )
    zero, one_ = np.zeros(1), np.ones(1)
    return Task(
        model=model,
        dt=DT,
        target=np.tile([1.0, 0.0], (H + 1, 1)),
        reward=Reward(np.array([1.0, 0.1]), np.zeros(2), 0.1 * one_, zero),
        start=np.zeros(2),
        past=zero,
        low=np.full(1, -1e6),
        high=np.full(1, 1e6),
        feedback=False,
        smoothing=0.0,
    )


def theorem1_job(epsilon: float, seed: int) -> dict[str, Any]:
    """Run one job: one search to its end."""
    task = theorem1_task(epsilon, seed)
    truth = task.with_model(task.model.with_values({"eps": 0.0}))
    real = truth.problem(exact=True)
    u, first, K, iterations = np.zeros((H, 1)), 0.0, 0.0, 0
    while True:
        swarm = real.system.rollout(real, u)
        z = swarm.z[0]
        own = gradient(real, z, u).inputs
        trial = Trial(z[:, :2], u, DT, task.model.state_names, task.model.input_names)
        guess = gradient(task.problem(ground(task, trial).bias), z, u).inputs
        error = float(np.linalg.norm(own - guess))
        first, K = first or error, max(K, error / epsilon)
        better = _line_search(real, u, -guess, float(swarm.cost[0]))
        if better is None or iterations >= ITERATIONS:
            squared = float((own**2).sum())
            return vars(Theorem1Row(epsilon, seed, first, squared, K, iterations))
        u, iterations = better, iterations + 1


def _line_search(real: Problem, u: Array, direction: Array, cost: float) -> Array | None:
    """Return the best point along a direction in the real system, None if none is better."""

    def costs(at: Array) -> Array:
        return real.system.rollout(real, u, k=direction, alphas=at).cost

    alphas = np.array([2.0**-i for i in range(-3, 40)])
    found = costs(alphas)
    best = int(np.argmin(found))
    if not found[best] < cost:
        return None
    low, high = alphas[best] / 2, alphas[best] * 2
    for _ in range(40):
        a, b = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
        ca, cb = costs(np.array([a, b]))
        low, high = (low, b) if ca < cb else (a, high)
    last = np.array([alphas[best], 0.5 * (low + high)])
    return u + float(last[np.argmin(costs(last))]) * direction
