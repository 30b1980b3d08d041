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
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from grounded.compile.problem import Problem
from grounded.engine import Engine
from grounded.experiments.jobs import Progress, Study, StudyTable, mean_se, mean_text, run_jobs
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


def theorem1(
    seeds: Sequence[int] = range(8),
    *,
    epsilons: Sequence[float] = EPSILONS,
    engine: Engine | None = None,
    progress: Progress | None = None,
) -> Study:
    """Run a search for each epsilon and seed; the seed sets the shape of the model's error."""
    cases = [{"epsilon": float(epsilon), "seed": seed} for epsilon in epsilons for seed in seeds]
    rows = run_jobs(theorem1_job, cases, engine, progress)
    # one slope per seed of the logarithms over log epsilon: K depends on the shape of the error
    slopes: dict[str, list[float]] = {"gradient_error": [], "squared_gradient": []}
    for seed in seeds:
        own = [
            (row["epsilon"], row["error"], row["squared"]) for row in rows if row["seed"] == seed
        ]
        x, *each = np.log(own).T
        for found, y in zip(slopes.values(), each, strict=True):
            found.append(float(np.polyfit(x, y, 1)[0]))
    # |grad U|^2 over the bound 2 K^2 epsilon^2
    ratio = [row["squared"] / (2 * (row["K"] * row["epsilon"]) ** 2) for row in rows]
    lines = []
    for epsilon in epsilons:
        some = [i for i, row in enumerate(rows) if row["epsilon"] == epsilon]
        medians = (np.median([rows[i][name] for i in some]) for name in ("error", "squared"))
        largest = f"{max(ratio[i] for i in some):.3f}"
        lines.append((f"{epsilon:g}", *(f"{value:.3g}" for value in medians), largest))
    share = "share of 2 K^2 epsilon^2, at most"
    head = ("epsilon", "|grad U - grad U^|", "|grad U|^2 at the end", share)
    bounds = tuple(
        (f"{name.replace('_', ' ')} over epsilon", mean_text(values, ".3f"), bound)
        for (name, values), bound in zip(slopes.items(), "12", strict=True)
    )
    means = {name: mean_se(values) for name, values in slopes.items()}
    return Study(
        document(
            rows=rows,
            slopes={name: {"slope": mean, "se": se} for name, (mean, se) in means.items()},
            largest_ratio_to_bound=max(ratio),
            paper={"gradient_error": 1, "squared_gradient": 2},
            K=max(row["K"] for row in rows),
        ),
        (
            StudyTable("Theorem 1: medians of the seeds", head, tuple(lines)),
            StudyTable("Slopes (± one standard error)", ("", "here", "of the bound"), bounds),
        ),
    )


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
    """Run one job: one search to its end.

    `error`: |grad U - grad U^| at the first policy. `squared`: |grad U|^2 at the end. `K`: largest.
    """
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
            row = {"epsilon": epsilon, "seed": seed, "error": first}
            return row | {"squared": float((own**2).sum()), "K": K, "iterations": iterations}
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


def footnote9(offsets: Sequence[float] = OFFSETS) -> Study:
    """Compare the model's policy and one iteration of the algorithm for each b in `offsets`.

    Utilities are shares of the optimum C.
    """
    rows = [_row(b) for b in offsets]
    head = ("b", "model-based", "one iteration (trials)")
    lines = tuple(
        (f"{r['b']:g}", f"{r['model_based']:.3g}", f"{r['solved']:.6f} ({r['solved_trials']})")
        for r in rows
    )
    table = StudyTable("Footnote 9: utility as a share of the optimum", head, lines)
    return Study({"rows": rows, "paper": {"iterations": 1}}, (table,))


def _row(b: float) -> dict[str, Any]:
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
    row = {"b": b, "model_based": math.exp(-(b**2)), "solved": share}
    return row | {"solved_trials": len(found.trials)}
