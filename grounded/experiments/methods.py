"""Ways to learn a manoeuvre, each as a list of the policies that it would keep, by real trials.

    paper        this algorithm as the paper has it: the bias alone, DDP to convergence
    grounded     this algorithm as the tool recommends it: matched inputs, damped steps
    refit+bias   the same, the model's parameters refitted to all trials before the bias is added
    gradient     this algorithm with policy gradient
    refit        parameters fitted to all trials, the policy solved again, no bias
    ilc          norm-optimal iterative learning control (`ilc`)
    differences  model-free: finite differences of the real utility (footnote 5), with BFGS

A method sees the task with the crude model and a function that runs a policy on the real system;
`differences` is told the true gradient, and charged the trials that differencing would have cost.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.experiments.bench import Bench
from grounded.experiments.ilc import gradient_of, lifted, update
from grounded.frozen import Array
from grounded.model import Model
from grounded.policy import Policy
from grounded.search.first_policy import first_policy
from grounded.search.improve import propose
from grounded.search.standing import Candidate, Options
from grounded.task import Task
from grounded.trial import Trial, mean_trial

Refit = Callable[[Task, Sequence[Trial]], Model]


@dataclass(frozen=True, eq=False)
class Kept:
    """A policy that a method would return after so many trials, and the utility it measured."""

    trials: int
    policy: Policy
    utility: float


def search(case: Bench, options: Options, refit: Refit | None = None) -> list[Kept]:
    """This algorithm, through the function behind `grounded propose`."""
    candidates: list[Candidate] = []
    trials: list[Trial] = []
    kept: list[Kept] = []
    while True:
        proposal = propose(case.task, candidates, trials, options, refit=refit)
        best = proposal.standing.incumbent
        if best is not None and (not kept or kept[-1].policy is not best.candidate.policy):
            kept.append(Kept(len(trials), best.candidate.policy, best.utility))
        if proposal.candidate is None:
            return kept
        if proposal.is_new:
            candidates.append(proposal.candidate)
        trial = case.real(proposal.candidate.policy, len(trials))
        trials.append(replace(trial, candidate=proposal.candidate.id))


def fitted(task: Task, trials: Sequence[Trial]) -> Model:
    """The model with all its parameters fitted to whole trials."""
    from grounded.fit import fit

    whole = [trial for trial in trials if trial.finite_steps >= 3]
    return fit(task, whole, hold_out=0.0).model if whole else task.model


def refit_alone(case: Bench, options: Options, rounds: int = 6) -> list[Kept]:
    """Fit to all trials so far, solve, run, again; the policy of the latest model is kept."""
    task, trials, kept = case.task, list[Trial](), list[Kept]()
    for _ in range(rounds):
        policy, _ = first_policy(task)
        repeats = [case.real(policy, len(trials) + i) for i in range(options.repeats)]
        trials += repeats
        utility = float(np.mean([case.task.utility(trial) for trial in repeats]))
        kept.append(Kept(len(trials), policy, utility))
        task = case.task.with_model(fitted(case.task, trials))
    return kept


def learning_control(case: Bench, options: Options, rounds: int = 12) -> list[Kept]:
    """Norm-optimal ILC: every update is taken; after a failed run the step is not repeated."""
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


def differences(case: Bench, options: Options, budget: int = 5000) -> list[Kept]:
    """BFGS on the real utility by the feed-forward; a gradient costs H m trials.

    The gradient is the true system's own derivative, so no noise spoils it and no step size has to
    be chosen: a bound from below on what differencing needs.
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


def run_method(name: str, case: Bench, options: Options) -> list[Kept]:
    """The policies that a method keeps, in the order of real trials."""
    if name == "grounded":
        return search(case, options)
    if name == "paper":
        return search(case, replace(options, step="full", match_inputs=False))
    if name == "refit+bias":
        return search(case, replace(options, refit=True), fitted)
    if name == "gradient":
        return search(case, replace(options, method="policy-gradient"))
    if name == "refit":
        return refit_alone(case, options)
    if name == "ilc":
        return learning_control(case, options)
    assert name == "differences", name
    return differences(case, options)


METHODS = ("paper", "grounded", "refit+bias", "gradient", "refit", "ilc", "differences")
