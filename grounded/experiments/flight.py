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

from functools import partial
from typing import Any

import numpy as np

from grounded.checks import wrong
from grounded.engine import Engine
from grounded.experiments.figure8 import RADIUS, flight_task, perturbed
from grounded.experiments.jobs import (
    Progress,
    Study,
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


Row = dict[str, Any]  # of one approximate model


def run(
    count: int = 10,
    *,
    first_seed: int = 0,
    engine: Engine | None = None,
    progress: Progress | None = None,
) -> Study:
    """Make Table 1 from `count` runs that are not discarded, seeds first_seed, first_seed + 1 ...

    Args:
        count: number of runs, without discarded ones.
        first_seed: first seed of the approximate models.
        engine: where the jobs run, see `run_jobs`.
        progress: see `run_jobs`.
    """
    found: list[Row] = []
    while missing := count - sum(not row["discarded"] for row in found):
        if len(found) >= 5 * count:
            raise wrong("flyable models", len(found), low=count)
        seed = first_seed + len(found)
        cases = ({"seed": s} for s in range(seed, seed + missing))
        found += run_jobs(flight_job, cases, engine, progress)
    _, optimum = first_policy(flight_task(aircraft))
    return _table_1(found, -optimum.cost)


def flight_job(seed: int) -> Row:
    """Run one job: one approximate model, five iterations.

    `utilities`: of the model's policy, then after each improvement. `alphas` of every trial; the
    first is the model's own policy.
    """
    truth = flight_task(aircraft)
    crude = perturbed(aircraft, np.random.default_rng(seed))
    task = flight_task(crude, started_by=aircraft)
    options = SearchOptions()
    first = propose(task, [], [], options).candidate
    flown = None if first is None else real_flight(truth, first)
    row: Row = {"seed": seed, "discarded": flown is None or unstable(truth, flown)}
    if row["discarded"]:
        claimed = plain([truth.utility(flown)] if flown else [])  # JSON has no infinity
        return row | {"utilities": claimed, "trials": 1, "alphas": [1.0]}
    fly = partial(real_flight, truth)
    found = learn(task, fly, options, max_iterations=ITERATIONS, check=False)
    row |= {"utilities": list(found.standing.utilities), "trials": len(found.trials)}
    return row | {"alphas": [one.alpha for one in found.candidates]}


def _table_1(rows: list[Row], optimum: float) -> Study:
    """Return the document, a row per run and means, and the table beside the paper's."""
    flown = [row for row in rows if not row["discarded"]]
    first, last = ([row["utilities"][k] for row in flown] for k in (0, -1))
    gains = [improvement(*ends) for ends in zip(first, last, strict=True)]
    ratio = improvement(float(np.mean(first)), float(np.mean(last)))
    each = float(np.mean([(r["trials"] - 1) / max(len(r["utilities"]) - 1, 1) for r in flown]))
    gap = max((optimum - u) / -optimum for u in last)
    mean, se = mean_se(gains)
    found = document(
        runs=[row | {"optimum": optimum} for row in rows],
        model_based=mean_se(first),
        learned=mean_se(last),
        optimum=optimum,
        worst_gap_to_optimum=gap,
        improvement={"mean": mean, "se": se, "ratio_of_means": ratio},
        trials=float(np.mean([row["trials"] for row in flown])),
        trials_an_iteration=each,
        discarded=len(rows) - len(flown),
        paper=PAPER,
    )
    lines = (
        ("utility, model-based", mean_text(first, ",.0f"), "-13,028 (±330)"),
        (f"utility, up to {ITERATIONS} iterations", mean_text(last, ",.0f"), "-3,000 (±100)"),
        ("improvement, mean of ratios", mean_text(gains), "76 % (±2 %)"),
        ("improvement, ratio of means", f"{ratio:.1%}", ""),
        ("optimum with the true parameters", f"{optimum:,.0f}", "not given"),
        ("largest distance to it", f"{gap:.2%}", "not given"),
        ("trials an iteration", f"{each:.2f}", "typically 1"),
        ("discarded", f"{len(rows) - len(flown)} of {len(rows)}", "about 20 %"),
    )
    runs = f"{len(flown)} runs, mean (± one standard error)" if len(flown) > 1 else "one run"
    title = f"Table 1: flight simulator, {runs}"
    return Study(found, (StudyTable(title, ("", "here", "paper"), lines),))


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
