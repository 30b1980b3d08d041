"""Comparison of seven methods by the number of real trials they need, and by their final policies.

    paper        this algorithm as in the paper: the bias alone, DDP to convergence
    grounded     this algorithm as the tool recommends it: matched inputs, damped steps
    refit+bias   the same, the model's parameters refitted to all trials before the bias is added
    gradient     this algorithm with policy gradient
    refit        parameters fitted to all trials, the policy solved again, no bias
    ilc          norm-optimal iterative learning control (`ilc`)
    differences  model-free: finite differences of the real utility (footnote 5), with BFGS

A method gets the task with the crude model and a function that runs a policy on the real system.
`differences` gets the true gradient, and is charged the trials that finite differences would cost.

They are compared on three manoeuvres of the car, with three kinds of error (`bench`) and several
seeds. Each policy that a method keeps counts with its TRUE utility: without noise that of its
trial, with noise the mean of fresh runs, because the measured utility of a selected policy is
biased. Zero is the model's own policy (model-based control alone), one is the optimum of a search
that knows the real car.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Unpack

import numpy as np

from grounded.experiments.bench import (
    KINDS,
    Bench,
    Kept,
    bench,
    optimum,
    searched,
    standing_still,
    true_utility,
)
from grounded.experiments.car_tasks import NAMES
from grounded.experiments.ilc import gradient_of, lifted, update
from grounded.experiments.jobs import Running, StudyTable, every, run_study
from grounded.frozen import Array
from grounded.model import Model
from grounded.search.first_policy import first_policy
from grounded.search.step.step_size import SearchOptions
from grounded.task import Task
from grounded.trial import Trial, mean_trial


def fitted_model(task: Task, trials: Sequence[Trial]) -> Model:
    """Return the model with all its parameters fitted to whole trials."""
    from grounded.fit import fit

    whole = [trial for trial in trials if trial.finite_steps >= 3]
    return fit(task, whole).model if whole else task.model


def refit_alone(case: Bench, options: SearchOptions, rounds: int = 6) -> list[Kept]:
    """Repeat: solve, run, fit to all trials so far. The policy of the latest model is kept."""
    task, trials, kept = case.task, list[Trial](), list[Kept]()
    for _ in range(rounds):
        policy, _ = first_policy(task)
        repeats = [case.real(policy, len(trials) + i) for i in range(options.repeats)]
        trials += repeats
        utility = float(np.mean([case.task.utility(trial) for trial in repeats]))
        kept.append(Kept(len(trials), policy, utility))
        task = case.task.with_model(fitted_model(case.task, trials))
    return kept


def learning_control(case: Bench, options: SearchOptions, rounds: int = 12) -> list[Kept]:
    """Run norm-optimal ILC; every update is accepted, and a failed run ends it."""
    policy, _ = first_policy(case.task)
    model = lifted(case.task, policy)
    kept: list[Kept] = []
    done = 0
    for _ in range(rounds):
        repeats = [case.real(policy, done + i) for i in range(options.repeats)]
        done += options.repeats
        utility = float(np.mean([case.task.utility(trial) for trial in repeats]))
        kept.append(Kept(done, policy, utility))
        if not np.isfinite(utility):
            break
        policy = update(case.task, model, policy, mean_trial(repeats, case.task.model.angle_mask))
    return kept


def differences(case: Bench, options: SearchOptions, budget: int = 5000) -> list[Kept]:
    """Run BFGS on the real utility over the feed-forward; a gradient costs H m trials.

    The gradient is the true system's derivative, without noise or step size, so the result is a
    lower bound on the trials that finite differences need.
    """
    from scipy.optimize import minimize

    policy, _ = first_policy(case.task)
    size = policy.feedforward.size
    kept = [Kept(1, policy, gradient_of(case.truth, policy)[0])]
    count = {"evaluations": 0, "gradients": 0}

    def cost(v: Array) -> tuple[float, Array]:
        count["evaluations"] += 1
        moved = replace(policy, feedforward=v.reshape(policy.feedforward.shape))
        utility, gradient = gradient_of(case.truth, moved)
        return (-utility, -gradient.ravel()) if np.isfinite(utility) else (1e12, 0 * v)

    def note(v: Array) -> None:
        count["gradients"] += 1
        moved = replace(policy, feedforward=v.reshape(policy.feedforward.shape))
        spent = 1 + count["evaluations"] + count["gradients"] * size
        kept.append(Kept(spent, moved, gradient_of(case.truth, moved)[0]))
        if spent > budget:
            raise StopIteration

    bounds = np.column_stack(
        [np.tile(b, case.task.horizon) for b in (case.task.low, case.task.high)]
    )
    minimize(
        cost,
        np.clip(policy.feedforward.ravel(), *bounds.T),
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        callback=note,
        options={"maxiter": 200},
    )
    return [k for k in kept if k.trials <= budget]


def run_method(name: str, case: Bench, options: SearchOptions) -> list[Kept]:
    """Return the policies that a method keeps, in the order of real trials."""
    ours: dict[str, dict[str, Any]] = {
        "paper": {"step": "full", "match_inputs": False},
        "grounded": {},
        "refit+bias": {"refit": True},
        "gradient": {"method": "policy-gradient"},
    }
    if name in ours:
        refit = fitted_model if name == "refit+bias" else None
        return searched(case, replace(options, **ours[name]), refit=refit)[0]
    others = {"refit": refit_alone, "ilc": learning_control, "differences": differences}
    return others[name](case, options)


METHODS = ("paper", "grounded", "refit+bias", "gradient", "refit", "ilc", "differences")


SHARES = (0.5, 0.9, 0.97, 0.99)
BUDGET = 40  # trials of every method but finite differences
FRESH = 20  # fresh runs per policy if there is noise


@dataclass(frozen=True)
class Line:
    """One method on one case: trials to each of SHARES (None: not reached), and its final share."""

    method: str
    manoeuvre: str
    kind: str
    seed: int
    trials: tuple[int | None, ...]
    final: float  # share of the gap that the last kept policy closes
    used: int  # trials until then


@dataclass(frozen=True)
class BaselinesResult:
    """All lines, in the order of manoeuvre, kind, method, seed."""

    lines: tuple[Line, ...]

    def to_json(self) -> dict[str, Any]:
        """Return the lines as plain values."""
        return {"shares": list(SHARES), "lines": [vars(line) for line in self.lines]}

    def tables(self) -> list[StudyTable]:
        """Return median trials to 50/90/97/99 %, median and worst share reached, by method."""
        cases = dict.fromkeys((line.manoeuvre, line.kind) for line in self.lines)
        return [self._table(manoeuvre, kind) for manoeuvre, kind in cases]

    def _table(self, manoeuvre: str, kind: str) -> StudyTable:
        rows = []
        chosen = [li for li in self.lines if (li.manoeuvre, li.kind) == (manoeuvre, kind)]
        for method in dict.fromkeys(line.method for line in chosen):
            own = [line for line in chosen if line.method == method]
            counts = "/".join(median_trials([line.trials[i] for line in own]) for i in range(4))
            finals = [line.final for line in own]
            rows.append((method, counts, f"{np.median(finals):.1%}", f"{min(finals):.1%}"))
        title = f"{manoeuvre}, {kind} error: median of {len(chosen) // max(len(rows), 1)} seeds"
        head = ("method", "trials to 50/90/97/99 %", "gap closed", "worst")
        return StudyTable(title, head, tuple(rows))


def median_trials(trials: Sequence[int | None]) -> str:
    """Return the median count, or "-" if it was not reached by half of the seeds or more."""
    reached = np.median([np.inf if count is None else count for count in trials])
    return f"{reached:g}" if np.isfinite(reached) else "-"


def run(
    seeds: Sequence[int] = range(8),
    *,
    manoeuvres: Sequence[str] = NAMES,
    kinds: Sequence[str] = KINDS,
    methods: Sequence[str] = METHODS,
    **how: Unpack[Running],
) -> BaselinesResult:
    """Run every method on every case, one job each."""
    cases = (
        case
        for case in every(manoeuvre=manoeuvres, kind=kinds, method=methods, seed=seeds)
        if (case["method"], case["kind"]) != ("differences", "noise")  # it gets the true gradient
    )
    return BaselinesResult(run_study(Line, baselines_job, cases, **how))


def baselines_job(method: str, manoeuvre: str, kind: str, seed: int) -> dict[str, Any]:
    """Run one job: one method on one case."""
    case = bench(manoeuvre, kind, seed)
    noisy = kind == "noise"
    options = SearchOptions(max_trials=BUDGET)
    best_policy, best = optimum(case)
    if noisy:
        best = true_utility(case.task, case.plant, best_policy, FRESH, seed)
    own, _ = first_policy(case.task)
    base = true_utility(case.task, case.plant, own, FRESH if noisy else 1, seed)
    floor = standing_still(case.task)
    reached: list[int | None] = [None] * len(SHARES)
    share, used = 0.0, 1
    for kept in run_method(method, case, options):
        utility = (
            true_utility(case.task, case.plant, kept.policy, FRESH, seed)
            if noisy
            else max(kept.utility, floor)
        )
        share, used = float(case.share(utility, base, best)), kept.trials
        for i, level in enumerate(SHARES):
            if reached[i] is None and share >= level:
                reached[i] = used
    return vars(Line(method, manoeuvre, kind, seed, tuple(reached), share, used))
