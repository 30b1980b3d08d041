"""The RC car of section 5.2 learns three manoeuvres; Figures 4 and 5.

    turn      open loop, improvement in the paper 97 %
    circle    closed loop, 88 %
    figure8   closed loop, 63 %

"We repeated the experiments 3-4 times for each maneuver, with similar results" (footnote 19). Each
repetition is the simulated real car with its scatter and its own random stream. In addition to the
utility measured in the trials, the study reports the TRUE utility, the mean of fresh runs, and the
optimum of a search that knows the real car. One repetition without scatter shows the method alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Unpack

import numpy as np

from grounded.experiments.car_tasks import NAMES, car_task
from grounded.experiments.jobs import Running, StudyTable, improvement, mean_text, run_study
from grounded.experiments.real_car import LATENCY, real_car, real_plant
from grounded.models.car import model as car
from grounded.plant import Noise, Plant
from grounded.policy import Policy
from grounded.search.ask_tell import learn
from grounded.search.candidate import Candidate
from grounded.search.step_size import SearchOptions
from grounded.task import Task
from grounded.trial import Trial

PAPER = {"turn": 0.97, "circle": 0.88, "figure8": 0.63}
ITERATIONS = 10  # "after 5-10 iterations"
BUDGET = 40
FRESH = 30


@dataclass(frozen=True)
class CarRun:
    """One repetition. `utilities` are measured in its trials, `true` are means of fresh runs."""

    manoeuvre: str
    seed: int
    noisy: bool
    utilities: tuple[float, ...]
    true: tuple[float, float]  # of the model's policy and of the final one
    optimum: float
    trials: int
    alphas: tuple[float, ...]

    @property
    def improvement(self) -> float:
        """Improvement of the true utility."""
        return improvement(*self.true)


@dataclass(frozen=True)
class CarResult:
    """All repetitions."""

    runs: tuple[CarRun, ...]

    def of(self, manoeuvre: str, noisy: bool) -> list[CarRun]:
        """Return the repetitions of one manoeuvre."""
        return [run for run in self.runs if (run.manoeuvre, run.noisy) == (manoeuvre, noisy)]

    def to_json(self) -> dict[str, Any]:
        """Return the document of `grounded experiment car --json`, a row per run."""
        runs = [vars(run) | {"improvement": run.improvement} for run in self.runs]
        return {"runs": runs, "paper": PAPER}

    def tables(self) -> list[StudyTable]:
        """Return improvement and trials beside the paper's, without and with scatter."""
        found = []
        for noisy, title in ((False, "RC car that repeats itself"), (True, "RC car with scatter")):
            some = [run for run in self.runs if run.noisy == noisy]
            names = dict.fromkeys(run.manoeuvre for run in some)
            rows = tuple((n, *_cells(self.of(n, noisy)), f"{PAPER[n]:.0%}") for n in names)
            trials = "trials an iteration" if noisy else "trials"
            head = ("manoeuvre", "improvement", "the optimum's", trials, "the paper's car")
            title = f"{title}, up to {ITERATIONS} iterations"
            found += [StudyTable(title, head, rows)] if rows else []
        return found


def _cells(runs: list[CarRun]) -> tuple[str, str, str]:
    best = np.mean([improvement(run.true[0], run.optimum) for run in runs])
    shown = mean_text([run.improvement for run in runs])
    if not runs[0].noisy:
        return shown, f"{best:.1%}", f"{runs[0].trials}"
    each = np.mean([run.trials / max(len(run.utilities), 1) for run in runs])
    return shown, f"{best:.1%}", f"{each:.1f}"


def run(
    seeds: Sequence[int] = range(4),
    *,
    manoeuvres: Sequence[str] = NAMES,
    **how: Unpack[Running],
) -> CarResult:
    """Run every manoeuvre once without scatter, and with scatter once for each seed."""
    cases = (
        {"manoeuvre": manoeuvre, "seed": seed, "noisy": noisy}
        for manoeuvre in manoeuvres
        for noisy, some in ((False, [0]), (True, seeds))
        for seed in some
    )
    return CarResult(run_study(CarRun, car_job, cases, **how))


@dataclass(frozen=True, eq=False)
class CarCase:
    """The task with the crude model, the same with the real car and its latency, and that car."""

    task: Task
    truth: Task
    plant: Plant
    seed: int

    def run(self, policy: Policy, *stream: int) -> Trial:
        """Run a policy on the real car, with the random numbers of a stream."""
        start = dict(zip(car.state_names, map(float, self.task.start), strict=True))
        return self.plant.run(policy, start, np.random.default_rng(list(stream)))

    def optimum(self) -> Policy:
        """Return the best policy of a search that plans with the real car, without scatter."""
        quiet = replace(self.plant, noise=Noise())
        options = SearchOptions(step="full", max_trials=30, max_halvings=6)
        best = learn(self.truth, replace(self, plant=quiet).first, options, check=False).best
        assert best is not None
        return best.candidate.policy

    def first(self, candidate: Candidate) -> Trial:
        """Run a candidate as the first one."""
        return self.run(candidate.policy, self.seed, 11, 0)

    def true_utility(self, policy: Policy, runs: int) -> float:
        """Return the mean utility of fresh runs; a crash counts as a car that never moved."""
        error = self.task.model.difference(
            np.tile(self.task.start, (self.task.horizon + 1, 1)), self.task.target
        )
        still = -float((np.nan_to_num(error) ** 2 @ self.task.reward.state).sum())
        fresh = [self.task.utility(self.run(policy, self.seed, 7, i)) for i in range(runs)]
        return float(np.mean(np.maximum(fresh, still)))


def car_case(manoeuvre: str, seed: int, noisy: bool) -> CarCase:
    """Return a case with the simulated real car as declared."""
    task = car_task(manoeuvre, car)
    latency = np.array([LATENCY[name] for name in car.input_names])
    truth = replace(task.with_model(real_car()), latency=latency)
    return CarCase(task, truth, real_plant(noisy), seed)


def car_job(manoeuvre: str, seed: int, noisy: bool) -> dict[str, Any]:
    """Run one job: one repetition of one manoeuvre."""
    case = car_case(manoeuvre, seed, noisy)
    options = SearchOptions(max_trials=BUDGET)
    trials: list[Trial] = []

    def real(candidate: Candidate) -> Trial:
        trials.append(case.run(candidate.policy, seed, 11, len(trials)))
        return trials[-1]

    found = learn(case.task, real, options, max_iterations=ITERATIONS, check=False)
    standing = found.standing
    kept = [tried for tried in standing.history if tried.accepted]
    fresh = FRESH if noisy else 1
    true = [
        case.true_utility(policy, fresh)
        for policy in (kept[0].candidate.policy, kept[-1].candidate.policy, case.optimum())
    ]
    utilities, alphas = tuple(standing.utilities), tuple(c.alpha for c in found.candidates)
    first, last, top = true
    run = (manoeuvre, seed, noisy, utilities, (first, last), top, len(trials), alphas)
    return vars(CarRun(*run))
