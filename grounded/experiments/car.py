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
from typing import Any

import numpy as np

from grounded.engine import Engine
from grounded.experiments.car_tasks import NAMES, car_task
from grounded.experiments.jobs import Progress, StudyTable, improvement, mean_text, run_jobs
from grounded.experiments.real_car import LATENCY, real_car, real_plant
from grounded.models.car import model as car
from grounded.plant import Plant
from grounded.policy import Policy
from grounded.search.ask_tell import learn
from grounded.search.candidate import Candidate
from grounded.search.step_size import SearchOptions
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
    engine: Engine | None = None,
    progress: Progress | None = None,
) -> CarResult:
    """Run every manoeuvre once without scatter, and with scatter once for each seed."""
    cases = (
        {"manoeuvre": manoeuvre, "seed": seed, "noisy": noisy}
        for manoeuvre in manoeuvres
        for noisy, some in ((False, [0]), (True, seeds))
        for seed in some
    )
    return CarResult(tuple(run_jobs(car_job, cases, engine, progress)))


def car_job(manoeuvre: str, seed: int, noisy: bool) -> CarRun:
    """Run one job: one repetition of one manoeuvre."""
    task, plant, trials = car_task(manoeuvre, car), real_plant(noisy), list[Trial]()
    start = dict(zip(car.state_names, map(float, task.start), strict=True))

    def driven(plant: Plant, policy: Policy, *stream: int) -> Trial:
        return plant.run(policy, start, np.random.default_rng([seed, *stream]))

    def real(candidate: Candidate) -> Trial:
        trials.append(driven(plant, candidate.policy, 11, len(trials)))
        return trials[-1]

    options = SearchOptions(max_trials=BUDGET)
    found = learn(task, real, options, max_iterations=ITERATIONS, check=False)
    # The optimum: a search that plans with the real car and its latency, without scatter.
    latency = np.array([LATENCY[name] for name in car.input_names])
    truth, quiet = replace(task.with_model(real_car()), latency=latency), real_plant()
    options = SearchOptions(step="full", max_trials=30, max_halvings=6)
    best = learn(truth, lambda one: driven(quiet, one.policy, 11, 0), options, check=False).best
    assert best is not None
    # The true utility: the mean of fresh runs. A crash counts as a car that never moved.
    error = car.difference(np.tile(task.start, (task.horizon + 1, 1)), task.target)
    still = -float((np.nan_to_num(error) ** 2 @ task.reward.state).sum())
    kept = [tried.candidate for tried in found.standing.history if tried.accepted]
    true = []
    for candidate in (kept[0], kept[-1], best.candidate):
        runs = range(FRESH if noisy else 1)
        fresh = [task.utility(driven(plant, candidate.policy, 7, i)) for i in runs]
        true.append(float(np.mean(np.maximum(fresh, still))))
    utilities, alphas = tuple(found.standing.utilities), tuple(c.alpha for c in found.candidates)
    run = (manoeuvre, seed, noisy, utilities, (true[0], true[1]), true[2], len(trials), alphas)
    return CarRun(*run)
