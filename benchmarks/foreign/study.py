"""Run the search on a set-up, alone or with what a diagnosis claims.

The gap is counted from the first trial, the model's own policy, or from a run with the inputs held
if that failed. A utility within half a per cent of the optimum counts as all of the gap, because
with nothing withheld there is no gap.
"""

from __future__ import annotations

import re
import time
from dataclasses import asdict, dataclass, replace

import numpy as np

from benchmarks.foreign.optimum import known
from benchmarks.foreign.setups import Setup
from benchmarks.helpers import table
from grounded.diagnosis.diagnose import diagnose
from grounded.diagnosis.parts import Diagnosis
from grounded.search.candidate import Candidate
from grounded.search.improve import propose
from grounded.search.planner import Planner
from grounded.search.step_size import SearchOptions
from grounded.trial import Trial
from grounded_trials.workspace.adopted import planner_of

SHARES = (0.9, 0.97, 0.99)
CLOSE = 0.005


@dataclass(frozen=True)
class Row:
    """One set-up: what was claimed, utilities, trials to SHARES, CPU time, the ending."""

    name: str
    withheld: str
    claimed: str
    place: str  # of what is withheld, see `place_of`
    first: float
    final: float
    trials: int
    reached: tuple[int | None, ...]
    optimum: float | None
    seconds: float
    ended: str

    def to_json(self) -> dict[str, object]:
        """Return the row's values by name."""
        return asdict(self)


def measured(setup: Setup, after: int = 0) -> Row:
    """Run the search on one set-up, and adopt what a diagnosis claims.

    Args:
        setup: the system.
        after: trials after which it is diagnosed, or fewer where the search ends before; 0: never.
    """
    task, options, start = setup.task, SearchOptions(), time.process_time()
    candidates: list[Candidate] = []
    trials: list[Trial] = []
    planner, claimed, place = Planner(task, task), "", "-"
    try:
        while True:
            proposal = propose(task, candidates, trials, options, planner=planner)
            made, ended = proposal.candidate, proposal.standing.phase
            if after and not claimed and trials and (made is None or len(trials) == after):
                found = diagnose(task, trials)
                values, params = found.known_parameters, task.model.params
                own = {name: one.value for name, one in values.items() if name in params}
                named = [n for n in found.effects if not n.startswith("parameter:")]
                fitted = task.with_model(task.model.with_values(own))
                planner = planner_of(fitted, {name: found.values(name) for name in named})
                planner, place = replace(planner, task=task), place_of(setup.cause, found)
                claimed = " + ".join([*named, *own]) or "nothing"
                continue
            if made is None:
                break
            candidates += [made] * proposal.is_new
            trials.append(replace(setup.run(made.policy), candidate=made.id, id=f"t{len(trials)}"))
    except Exception as error:
        ended = f"{type(error).__name__}: {error}"
    utilities = [task.utility(trial) for trial in trials]
    best = known().get(setup.name, {}).get("utility")
    return Row(
        name=setup.name,
        withheld=setup.withheld,
        claimed=claimed,
        place=place,
        first=utilities[0] if utilities else -np.inf,
        final=max(utilities, default=-np.inf),
        trials=len(utilities),
        reached=trials_to(setup, utilities, best),
        optimum=best,
        seconds=time.process_time() - start,
        ended=ended,
    )


def place_of(cause: str, found: Diagnosis) -> str:
    """Return where what is withheld stands in a diagnosis: claimed, tied, its rank, or "-"."""
    if not cause:
        return "-"
    true, off = re.compile(cause), (f"parameter:{name}" for name in found.verdict.parameters)
    if any(true.match(name) for name in (*found.effects, *off)):
        return "claimed"
    groups = (*found.indistinguishable, *found.equivalent)
    tied = [name for group in groups if {*group} & {*found.effects} for name in group]
    if any(true.match(name) for name in tied):
        return "tied"
    ranks = (k for k, row in enumerate(found.ranking, 1) if true.match(row.effect))
    return str(next(ranks, "-"))


def trials_to(setup: Setup, utilities: list[float], best: float | None) -> tuple[int | None, ...]:
    """Return the trial at which each share of the gap was first closed, or None."""
    if best is None or not utilities:
        return (None,) * len(SHARES)
    base = utilities[0]
    if not np.isfinite(base):  # the inputs from before the start, held
        task = setup.task
        held = task.policy(np.tile(task.past, (task.horizon, 1)), None, None)
        base = setup.task.utility(setup.run(held))
    so_far = np.maximum.accumulate(utilities)
    levels = [min(best - (1 - share) * (best - base), best - CLOSE * abs(best)) for share in SHARES]
    return tuple(
        int(np.argmax(so_far >= level)) + 1 if (so_far >= level).any() else None for level in levels
    )


def results(rows: list[Row]) -> str:
    """Return the rows as a Markdown table."""

    def number(value: float | None) -> str:
        return "-" if value is None else f"{value:.4g}"

    head = ("set-up", "withheld", "claimed", "place", "first", "final", "optimum", "trials")
    head += ("to 90/97/99 %", "CPU s", "ended")
    cells = []
    for r in rows:
        values = map(number, (r.first, r.final, r.optimum))
        reached = "/".join("-" if t is None else str(t) for t in r.reached)
        about = (r.name, r.withheld, r.claimed, r.place, *values, r.trials, reached)
        cells.append((*about, f"{r.seconds:.1f}", r.ended))
    return table(head, cells)
