"""Baselines: how many real trials each method needs, and where it ends.

Three manoeuvres of the car, three kinds of error (`bench`), a number of seeds. Of each policy that
a method keeps, the TRUE utility counts: in a quiet world that of its trial, with noise the mean of
fresh runs, because a winner's own trials flatter it. Zero is the model's own policy (the eighth
method: model-based alone), one the optimum that knows the real car.
"""

from __future__ import annotations

from collections.abc import MutableMapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from grounded.experiments.bench import KINDS, bench, optimum, standing_still, true_utility
from grounded.experiments.car_tasks import NAMES
from grounded.experiments.jobs import Engine, Job, Progress, Table, run_jobs
from grounded.experiments.methods import METHODS, run_method
from grounded.search.first_policy import first_policy
from grounded.search.standing import Options

SHARES = (0.5, 0.9, 0.97, 0.99)
BUDGET = 40  # trials of every method but finite differences
FRESH = 20  # runs that judge a policy when there is noise


@dataclass(frozen=True)
class Line:
    """One method on one case: trials to each of SHARES (None: not reached), and where it ended."""

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
        """Lines by name."""
        return {"shares": list(SHARES), "lines": [vars(line) for line in self.lines]}

    def tables(self) -> list[Table]:
        """Median trials to 50/90/97/99 % and the median and worst share reached, by method."""
        cases = dict.fromkeys((line.manoeuvre, line.kind) for line in self.lines)
        return [self._table(manoeuvre, kind) for manoeuvre, kind in cases]

    def _table(self, manoeuvre: str, kind: str) -> Table:
        rows = []
        chosen = [li for li in self.lines if (li.manoeuvre, li.kind) == (manoeuvre, kind)]
        for method in dict.fromkeys(line.method for line in chosen):
            own = [line for line in chosen if line.method == method]
            counts = "/".join(median_trials([line.trials[i] for line in own]) for i in range(4))
            finals = [line.final for line in own]
            rows.append((method, counts, f"{np.median(finals):.1%}", f"{min(finals):.1%}"))
        title = f"{manoeuvre}, {kind} error: median of {len(chosen) // max(len(rows), 1)} seeds"
        head = ("method", "trials to 50/90/97/99 %", "gap closed", "worst")
        return Table(title, head, tuple(rows))


def median_trials(trials: Sequence[int | None]) -> str:
    """The median count; "-" when half of the seeds or more never got there."""
    reached = np.median([np.inf if count is None else count for count in trials])
    return f"{reached:g}" if np.isfinite(reached) else "-"


def run(
    seeds: Sequence[int] = range(8),
    *,
    manoeuvres: Sequence[str] = NAMES,
    kinds: Sequence[str] = KINDS,
    methods: Sequence[str] = METHODS,
    engine: Engine | None = None,
    finished: MutableMapping[str, dict[str, Any]] | None = None,
    progress: Progress | None = None,
) -> BaselinesResult:
    """Every method on every case; a job is one of them."""
    jobs = [
        Job(one, {"method": method, "manoeuvre": manoeuvre, "kind": kind, "seed": seed})
        for manoeuvre in manoeuvres
        for kind in kinds
        for method in methods
        for seed in seeds
        if not (method == "differences" and kind == "noise")  # it was given the true gradient
    ]
    found = run_jobs(jobs, engine, finished=finished, progress=progress)
    return BaselinesResult(
        tuple(Line(**(result | {"trials": tuple(result["trials"])})) for result in found)
    )


def one(method: str, manoeuvre: str, kind: str, seed: int) -> dict[str, Any]:
    """A job: one method, one case."""
    case = bench(manoeuvre, kind, seed)
    noisy = kind == "noise"
    options = Options(max_trials=BUDGET)
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
    return {
        "method": method,
        "manoeuvre": manoeuvre,
        "kind": kind,
        "seed": seed,
        "trials": reached,
        "final": share,
        "used": used,
    }
