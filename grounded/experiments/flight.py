"""Table 1: a fixed-wing aircraft learns a figure-8 from a wrong model (section 5.1).

    real system      the aircraft with its 43 true parameters, closed loop, no noise
    crude model      every parameter times an independent U[0.8, 1.2], one model a run
    start            trimmed straight flight of the real aircraft, measured before the manoeuvre
    discarded        models whose first controller is unstable in the real system: the flight
                     diverges, or leaves the target by more than the radius of the turns

The search is that of the command line with its default options. The optimum is DDP with the true
parameters, which the search never sees.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from grounded.checks import wrong
from grounded.engine import Engine
from grounded.experiments.figure8 import RADIUS, flight_task, perturbed
from grounded.experiments.jobs import (
    Progress,
    StudyTable,
    improvement,
    mean_se,
    mean_text,
    run_jobs,
)
from grounded.frozen import Array
from grounded.models.aircraft import model as aircraft
from grounded.result import document, plain
from grounded.rollout import simulate
from grounded.search.ask_tell import learn
from grounded.search.candidate import Candidate
from grounded.search.first_policy import first_policy
from grounded.search.improve import propose
from grounded.search.step_size import SearchOptions
from grounded.task import Task
from grounded.trial import Trial

ITERATIONS = 5  # Table 1
PAPER = {
    "model_based": [-13028.0, 330.0],
    "learned": [-3000.0, 100.0],
    "improvement": [0.76, 0.02],
    "trials": 5,
    "discarded": 0.2,
}


@dataclass(frozen=True)
class FlightRun:
    """One approximate model. Utilities: of the model's policy, then after each improvement."""

    seed: int
    discarded: bool
    utilities: tuple[float, ...]
    trials: int
    alphas: tuple[float, ...]  # of every trial; the first is the model's own policy

    @property
    def improvement(self) -> float:
        """Share of the model-based cost that is gone."""
        return improvement(self.utilities[0], self.utilities[-1])


@dataclass(frozen=True)
class FlightResult:
    """Table 1."""

    runs: tuple[FlightRun, ...]
    optimum: float

    @property
    def flown(self) -> tuple[FlightRun, ...]:
        """The runs that were not discarded."""
        return tuple(run for run in self.runs if not run.discarded)

    def to_json(self) -> dict[str, Any]:
        """Return the document of `grounded experiment flight --json`: a row per run, and means."""
        flown = self.flown
        first, last = ([run.utilities[k] for run in flown] for k in (0, -1))
        mean, se = mean_se([run.improvement for run in flown])
        ratio = improvement(float(np.mean(first)), float(np.mean(last)))
        each = [(run.trials - 1) / max(len(run.utilities) - 1, 1) for run in flown]
        return document(
            runs=[vars(run) | {"optimum": self.optimum} for run in self.runs],
            model_based=mean_se(first),
            learned=mean_se(last),
            optimum=self.optimum,
            worst_gap_to_optimum=max((self.optimum - u) / -self.optimum for u in last),
            improvement={"mean": mean, "se": se, "ratio_of_means": ratio},
            trials=float(np.mean([run.trials for run in flown])),
            trials_an_iteration=float(np.mean(each)),
            discarded=len(self.runs) - len(flown),
            paper=PAPER,
        )

    def tables(self) -> list[StudyTable]:
        """Return Table 1 beside the paper's."""
        found = self.to_json()
        first, last = (mean_text([run.utilities[k] for run in self.flown], ",.0f") for k in (0, -1))
        gain = mean_text([run.improvement for run in self.flown])
        rows = (
            ("utility, model-based", first, "-13,028 (±330)"),
            (f"utility, up to {ITERATIONS} iterations", last, "-3,000 (±100)"),
            ("improvement, mean of ratios", gain, "76 % (±2 %)"),
            ("improvement, ratio of means", f"{found['improvement']['ratio_of_means']:.1%}", ""),
            ("optimum with the true parameters", f"{self.optimum:,.0f}", "not given"),
            ("largest distance to it", f"{found['worst_gap_to_optimum']:.2%}", "not given"),
            ("trials an iteration", f"{found['trials_an_iteration']:.2f}", "typically 1"),
            ("discarded", f"{found['discarded']} of {len(self.runs)}", "about 20 %"),
        )
        many = f"{len(self.flown)} runs, mean (± one standard error)"
        runs = many if len(self.flown) > 1 else "one run"
        title = f"Table 1: flight simulator, {runs}"
        return [StudyTable(title, ("", "here", "paper"), rows)]


def run(
    count: int = 10,
    *,
    first_seed: int = 0,
    engine: Engine | None = None,
    progress: Progress | None = None,
) -> FlightResult:
    """Make Table 1 from `count` runs that are not discarded, seeds first_seed, first_seed + 1 ...

    Args:
        count: number of runs, without discarded ones.
        first_seed: first seed of the approximate models.
        engine: where the jobs run, see `run_jobs`.
        progress: see `run_jobs`.

    Raises:
        GroundedError: if more than four of five models are discarded.
    """
    found: list[FlightRun] = []
    while missing := count - sum(not r.discarded for r in found):
        if len(found) >= 5 * count:
            raise wrong("flyable models", len(found), low=count)
        seed = first_seed + len(found)
        cases = ({"seed": s} for s in range(seed, seed + missing))
        found += run_jobs(flight_job, cases, engine, progress)
    _, optimum = first_policy(flight_task(aircraft))
    return FlightResult(tuple(found), -optimum.cost)


def flight_job(seed: int) -> FlightRun:
    """Run one job: one approximate model, five iterations."""
    truth = flight_task(aircraft)
    crude = perturbed(aircraft, np.random.default_rng(seed))
    task = flight_task(crude, started_by=aircraft)
    options = SearchOptions()
    first = propose(task, [], [], options).candidate
    flown = None if first is None else real_flight(truth, first)
    if flown is None or unstable(truth, flown):
        claimed = plain([truth.utility(flown)] if flown else [])  # JSON has no infinity
        return FlightRun(seed, True, tuple(claimed), 1, (1.0,))
    fly = partial(real_flight, truth)
    found = learn(task, fly, options, max_iterations=ITERATIONS, check=False)
    alphas = tuple(c.alpha for c in found.candidates)
    utilities = tuple(found.standing.utilities)
    return FlightRun(seed, False, utilities, len(found.trials), alphas)


def real_flight(truth: Task, candidate: Candidate) -> Trial:
    """Simulate the real aircraft under a candidate; the trial ends early if it diverges."""
    flown = simulate(truth.problem(exact=True), candidate.policy)
    good = np.isfinite(flown.states).all(axis=1) & (np.abs(flown.states) < 1e6).all(axis=1)
    T = truth.horizon if good.all() else max(int(np.argmin(good)) - 1, 0)
    names = truth.model.state_names, truth.model.input_names
    states, inputs = flown.states[: T + 1], flown.inputs[:T]
    return Trial(states, inputs, truth.dt, *names, start_inputs=truth.past)


def unstable(truth: Task, flight: Trial) -> bool:
    """Check whether a flight ended early, or was ever more than a turn's radius off target."""
    if flight.steps < truth.horizon:
        return True
    error: Array = flight.states[:, :3] - truth.target[:, :3]
    return bool(np.linalg.norm(error, axis=1).max() > RADIUS)
