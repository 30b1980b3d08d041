"""The paper's theoretical results: Theorem 1 and footnote 9.

Theorem 1: distance from a stationary point where the algorithm ends, for a model error epsilon.

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

Footnote 9: an arbitrarily wrong model whose policy one iteration makes optimal.

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
from scipy.optimize import minimize_scalar

from grounded.compile import Problem
from grounded.engine import Engine
from grounded.experiments.jobs import Progress, StudyTable, mean_se, mean_text, run_jobs
from grounded.frozen import Array
from grounded.model import Model, Param
from grounded.result import document
from grounded.search.ask_tell import learn
from grounded.search.candidate import Candidate
from grounded.search.step_size import SearchOptions
from grounded.solve.bias import ground
from grounded.solve.policy_gradient import gradient
from grounded.task import Task
from grounded.trial import Trial
from grounded.utility import Reward

EPSILONS = (0.003, 0.01, 0.03, 0.1, 0.3)
H, DT = 40, 0.1
ITERATIONS = 3000
CLOSE = 1e-8  # relative tolerance of a line search


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

    def slopes(self) -> dict[str, list[float]]:
        """Return slopes of log gradient error and log squared gradient over log epsilon.

        One slope per seed, because K depends on the shape of the model's error.
        """
        found: dict[str, list[float]] = {"gradient_error": [], "squared_gradient": []}
        for own in self._by("seed").values():
            x, error, squared = np.log([(row.epsilon, row.error, row.squared) for row in own]).T
            for each, y in zip(found.values(), (error, squared), strict=True):
                each.append(float(np.polyfit(x, y, 1)[0]))
        return found

    def _by(self, name: str) -> dict[float, list[Theorem1Row]]:
        found: dict[float, list[Theorem1Row]] = {}
        for row in self.rows:
            found.setdefault(getattr(row, name), []).append(row)
        return found

    def to_json(self) -> dict[str, Any]:
        """Return rows and slopes as plain values."""
        slopes = {name: mean_se(values) for name, values in self.slopes().items()}
        return document(
            rows=[vars(row) for row in self.rows],
            slopes={name: {"slope": mean, "se": se} for name, (mean, se) in slopes.items()},
            largest_ratio_to_bound=max(row.ratio for row in self.rows),
            paper={"gradient_error": 1, "squared_gradient": 2},
            K=max(row.K for row in self.rows),
        )

    def tables(self) -> list[StudyTable]:
        """Return medians by epsilon, and the slopes beside the theorem's."""
        rows = tuple(
            (
                f"{epsilon:g}",
                f"{np.median([row.error for row in own]):.3g}",
                f"{np.median([row.squared for row in own]):.3g}",
                f"{max(row.ratio for row in own):.3f}",
            )
            for epsilon, own in self._by("epsilon").items()
        )
        share = "share of 2 K^2 epsilon^2, at most"
        head = ("epsilon", "|grad U - grad U^|", "|grad U|^2 at the end", share)
        slopes = tuple(
            (f"{name.replace('_', ' ')} over epsilon", mean_text(values, ".3f"), bound)
            for (name, values), bound in zip(self.slopes().items(), "12", strict=True)
        )
        return [
            StudyTable("Theorem 1: medians of the seeds", head, rows),
            StudyTable("Slopes (± one standard error)", ("", "here", "of the bound"), slopes),
        ]


def theorem1(
    seeds: Sequence[int] = range(8),
    *,
    epsilons: Sequence[float] = EPSILONS,
    engine: Engine | None = None,
    progress: Progress | None = None,
) -> Theorem1Result:
    """Run a search for each epsilon and seed; the seed sets the shape of the model's error."""
    cases = [{"epsilon": float(epsilon), "seed": seed} for epsilon in epsilons for seed in seeds]
    return Theorem1Result(tuple(run_jobs(theorem1_job, cases, engine, progress)))


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


def theorem1_job(epsilon: float, seed: int) -> Theorem1Row:
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
            return Theorem1Row(epsilon, seed, first, squared, K, iterations)
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
    ends, near = (alphas[best] / 2, alphas[best] * 2), {"xatol": CLOSE * alphas[best]}
    inside = minimize_scalar(lambda a: costs(np.array([a]))[0], bounds=ends, options=near)
    alpha = inside.x if inside.fun < found[best] else alphas[best]
    return u + float(alpha) * direction


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


def footnote9(offsets: Sequence[float] = OFFSETS) -> Footnote9Result:
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
