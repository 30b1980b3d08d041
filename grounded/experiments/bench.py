"""Test cases of the studies: a manoeuvre, a crude model, a simulated real car, and the optimum.

    parametric   the real car is the model with every parameter times an independent U[0.8, 1.2]
    structural   the real car has effects that the model has no terms for (`real_car`), its latency,
                 and calibration errors of the size declared there, with random signs
    noise        structural, and every run scatters as the real car does

The optimum is what the search reaches when it plans with the TRUE model and latency, which no
method sees. It is a local optimum, like the paper's, so `share` of the gap may exceed one. Policies
are compared by their TRUE utility, the mean of fresh runs (`true_utility`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.experiments.car_tasks import LATENCY as MODELLED
from grounded.experiments.car_tasks import car_task
from grounded.experiments.real_car import CALIBRATION, SCATTER, real_car
from grounded.experiments.real_car import LATENCY as TRUE
from grounded.frozen import Array
from grounded.model import Model
from grounded.models.car import model as car
from grounded.plant import Noise, Plant
from grounded.policy import Policy, z_difference
from grounded.search.ask_tell import learn
from grounded.search.candidate import Candidate
from grounded.search.improve import propose
from grounded.search.step.step_size import SearchOptions
from grounded.task import Task
from grounded.trial import Trial

KINDS = ("parametric", "structural", "noise")
SPREAD = 0.2
Refit = Callable[[Task, Sequence[Trial]], Model]


@dataclass(frozen=True, eq=False)
class Bench:
    """One case: `task` has the crude model, `truth` is the task with the true model and latency."""

    task: Task
    truth: Task
    plant: Plant
    seed: int

    def real(self, policy: Policy, run: int) -> Trial:
        """Simulate the `run`-th real run of the study."""
        rng = np.random.default_rng([self.seed, 11, run])
        return self.plant.run(policy, start_of(self.task), rng)

    def share(self, utility: float | Array, base: float, optimum: float) -> Array:
        """Return the share of the gap between the model's policy and the optimum that is closed."""
        return (np.asarray(utility, dtype=float) - base) / (optimum - base)


def bench(manoeuvre: str, kind: str, seed: int) -> Bench:
    """Return a case for a manoeuvre ("turn", "circle", "figure8"), a kind of error, a seed."""
    rng = np.random.default_rng([seed, 3])
    if kind == "parametric":
        wrong = car.values * rng.uniform(1 - SPREAD, 1 + SPREAD, len(car.values))
        model = car.with_values(dict(zip(car.param_names, wrong, strict=True)))
        latency = dict.fromkeys(car.input_names, MODELLED)
    else:
        signs = rng.choice([-1.0, 1.0], len(CALIBRATION))
        factors = {
            name: 1 + sign * (value - 1)
            for sign, (name, value) in zip(signs, CALIBRATION.items(), strict=True)
        }
        model, latency = real_car(factors), TRUE
    noise = SCATTER if kind == "noise" else Noise()
    task = car_task(manoeuvre, car)
    known = np.array([latency[name] for name in car.input_names])
    truth = replace(task.with_model(model), latency=known)
    return Bench(task, truth, Plant(model=model, latency=latency, noise=noise), seed)


def optimum(case: Bench) -> tuple[Policy, float]:
    """Return the best policy found with the true model, and its utility without noise."""
    quiet = replace(case, plant=replace(case.plant, noise=Noise()))

    def run(candidate: Candidate) -> Trial:
        return quiet.real(candidate.policy, 0)

    options = SearchOptions(step="full", max_trials=30, max_halvings=6)
    best = learn(case.truth, run, options, check=False).best
    assert best is not None
    return best.candidate.policy, best.utility


@dataclass(frozen=True, eq=False)
class Kept:
    """The policy that a method would return after `trials` trials, and its measured utility."""

    trials: int
    policy: Policy
    utility: float


def searched(
    case: Bench, options: SearchOptions, *, refit: Refit | None = None, again: bool = False
) -> tuple[list[Kept], float, int]:
    """Run this project's search on a case.

    Args:
        case: the case.
        options: options of the search.
        refit: fits the model to the trials so far; None: no refit.
        again: whether the incumbent is run again with every new candidate.

    Returns:
        The policies kept in turn, the measured utility of the last one, and the number of trials.
    """
    candidates: list[Candidate] = []
    trials: list[Trial] = []
    kept: list[Kept] = []

    def run(candidate: Candidate) -> None:
        trial = case.real(candidate.policy, len(trials))
        trials.append(replace(trial, candidate=candidate.id))

    while True:
        proposal = propose(case.task, candidates, trials, options, refit=refit)
        best = proposal.standing.incumbent
        if best is not None and (not kept or kept[-1].policy is not best.candidate.policy):
            kept.append(Kept(len(trials), best.candidate.policy, best.utility))
        if proposal.candidate is None:
            assert best is not None
            return kept, best.utility, len(trials)
        if proposal.is_new:
            candidates.append(proposal.candidate)
            if again and best is not None:
                run(best.candidate)
        run(proposal.candidate)


def scaled(plant: Plant, level: float) -> Plant:
    """Return the plant with all noise standard deviations times `level`."""
    noise = Noise(
        **{
            kind: {name: level * std for name, std in getattr(plant.noise, kind).items()}
            for kind in ("start", "process", "measurement")
        }
    )
    return replace(plant, noise=noise)


def start_of(task: Task) -> dict[str, float]:
    """Return the start state by name."""
    return dict(zip(task.model.state_names, map(float, task.start), strict=True))


def true_utility(task: Task, plant: Plant, policy: Policy, runs: int, seed: int = 1) -> float:
    """Return the mean utility of fresh runs of a policy, free of selection bias.

    A run that crashes counts with the utility of a car that stayed at the start.
    """
    streams = [np.random.default_rng([seed, 7, i]) for i in range(runs)]
    utilities = [task.utility(trial) for trial in many_runs(task, plant, policy, streams)]
    return float(np.mean(np.maximum(utilities, standing_still(task))))


def many_runs(
    task: Task, plant: Plant, policy: Policy, streams: Sequence[np.random.Generator]
) -> list[Trial]:
    """Simulate `plant.run` of one policy for many random streams at once, one run per stream.

    The plant's states and inputs must be the policy's, in the same order.
    """
    model, H, N = plant.model, policy.horizon, len(streams)
    assert model.state_names == policy.state_names and model.input_names == policy.input_names
    draws = np.stack([rng.standard_normal((2 + 2 * H, model.n)) for rng in streams])
    start, process, error = plant.stds
    x = task.start + start * draws[:, 0]
    measured = np.full((N, H + 1, model.n), np.nan)
    measured[:, 0] = x + error * draws[:, 1]
    sent = np.tile(policy.past, (N, H, 1))
    for t in range(H):
        sent[:, t] = _actions(policy, measured[:, t], sent, t)
        x = plant.advance(x, sent, t, policy, range(model.m)) + process * draws[:, 2 + 2 * t]
        x = np.where(np.abs(x).max(axis=1, keepdims=True) <= 1e9, x, np.nan)
        measured[:, t + 1] = x + error * draws[:, 3 + 2 * t]
    names = (policy.state_names, policy.input_names)
    trials = [
        Trial(m, u, policy.dt, *names, start_inputs=policy.past)
        for m, u in zip(measured, sent, strict=True)
    ]
    return [trial.until(trial.finite_steps) for trial in trials]


def _actions(policy: Policy, x: Array, sent: Array, t: int) -> Array:
    """Return the inputs of step t (N, m) for measured states x (N, n) and earlier inputs."""
    u: Array = np.tile(policy.feedforward[t], (len(x), 1))
    if policy.gain is not None and policy.reference is not None:
        past = [
            sent[:, t - 1 - i, j] if t - 1 - i >= 0 else np.full(len(x), policy.past[j])
            for j, depth in enumerate(policy.depths)
            for i in range(depth)
        ]
        dz = z_difference(np.column_stack([x, *past]), policy.reference[t], policy.angles)
        correction = dz @ policy.gain[t].T
        u += np.where(np.isfinite(correction).all(axis=1, keepdims=True), correction, 0.0)
    clipped: Array = np.clip(u, policy.low, policy.high)
    return clipped


def standing_still(task: Task) -> float:
    """Return the utility of never moving, a floor for runs that ended early."""
    error = task.model.difference(np.tile(task.start, (task.horizon + 1, 1)), task.target)
    return -float((np.nan_to_num(error) ** 2 @ task.reward.state).sum())
