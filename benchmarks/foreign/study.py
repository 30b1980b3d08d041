"""Run the search on a set-up, alone or with what a diagnosis claims.

The gap is counted from the first trial, the model's own policy, or from a run with the inputs held
if that failed. A utility within half a per cent of the optimum counts as all of the gap, because
with nothing withheld there is no gap.
"""

from __future__ import annotations

import re
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace

import numpy as np

from benchmarks.foreign.optimum import known
from benchmarks.foreign.setups import Setup
from benchmarks.helpers import table
from grounded.diagnosis.diagnose import diagnose
from grounded.diagnosis.parts import Diagnosis
from grounded.policy import Policy
from grounded.search.ask_tell import learn
from grounded.search.candidate import Candidate
from grounded.search.improve import propose
from grounded.search.planner import Planner
from grounded.search.step.step_size import SearchOptions
from grounded.trial import Trial
from grounded_trials.workspace.adopted import planner_of

SHARES = (0.9, 0.97, 0.99)
CLOSE = 0.005
PATIENCE = 30.0  # [s] of CPU time


@dataclass(frozen=True)
class Row:
    """One set-up: utilities, trials to SHARES, CPU time, the ending."""

    name: str
    withheld: str
    first: float
    final: float
    trials: int
    reached: tuple[int | None, ...]
    optimum: float | None
    seconds: float
    phase: str
    sentence: str

    def to_json(self) -> dict[str, object]:
        """Return the row's values by name."""
        return asdict(self)


class OutOfTime(BaseException):
    """A method took longer than PATIENCE; not an Exception, so that no handler catches it."""


@contextmanager
def patience(seconds: float) -> Iterator[None]:
    """Raise OutOfTime inside the block after so many seconds of CPU time."""

    def late(*_: object) -> None:
        raise OutOfTime

    before = signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def measured(setup: Setup) -> Row:
    """Run the search on one set-up."""
    utilities: list[float] = []

    def run(candidate: Candidate) -> Trial:
        trial = setup.run(candidate)
        utilities.append(setup.task.utility(trial))
        return trial

    start = time.process_time()
    try:
        with patience(PATIENCE):
            standing = learn(setup.task, run, SearchOptions()).standing
        phase, sentence = standing.phase, standing.sentence
    except OutOfTime:
        phase, sentence = "out of time", f"not done after {PATIENCE:g} s of CPU time"
    except Exception as error:
        phase, sentence = "error", f"{type(error).__name__}: {error}"
    seconds = time.process_time() - start
    best = known().get(setup.name, {}).get("utility")
    final = max(utilities, default=-np.inf)
    return Row(
        name=setup.name,
        withheld=setup.withheld,
        first=utilities[0] if utilities else -np.inf,
        final=final,
        trials=len(utilities),
        reached=trials_to(setup, utilities, best),
        optimum=best,
        seconds=seconds,
        phase=phase,
        sentence=sentence,
    )


def adopting(setup: Setup, after: int) -> str:
    """Run the search, adopting what a diagnosis claims; return a table line.

    The diagnosis is one of `after` trials, or of fewer where the search ends before.
    """
    task, options = setup.task, SearchOptions()
    candidates: list[Candidate] = []
    trials: list[Trial] = []
    seconds = 0.0
    planner, claimed, place = Planner(task, task), "", "-"
    while True:
        proposal = propose(task, candidates, trials, options, planner=planner)
        made = proposal.candidate
        if not claimed and trials and (made is None or len(trials) == after):
            began = time.process_time()
            found = diagnose(task, trials)
            seconds, place = time.process_time() - began, place_of(setup.cause, found)
            own = {k: e.value for k, e in found.known_parameters.items() if k in task.model.params}
            named = [n for n in found.effects if not n.startswith("parameter:")]
            fitted = task.with_model(task.model.with_values(own))
            planner = planner_of(fitted, [{"name": n, **found.values(n)} for n in named])
            planner, claimed = replace(planner, task=task), " + ".join([*named, *own]) or "nothing"
            continue
        if made is None:
            break
        candidates += [made] * proposal.is_new
        trials.append(replace(setup.run(made), candidate=made.id, id=f"t{len(trials)}"))
    utilities = [task.utility(trial) for trial in trials]
    best, final = known().get(setup.name, {}).get("utility"), max(utilities)
    reached = reached_in(trials_to(setup, utilities, best))
    off = "-" if best is None else f"{100 * (best - final) / abs(best):.1f} %"
    cells = (
        setup.name, claimed, place, f"{utilities[0]:.4g}", f"{final:.4g}", off, str(len(trials)),
        reached, f"{seconds:.0f}",
    )  # fmt: skip
    return f"| {' | '.join(cells)} |"


def place_of(cause: str, found: Diagnosis) -> str:
    """Return where what is withheld stands in a diagnosis: claimed, tied, its rank, or "-"."""
    if not cause:
        return "-"
    true, off = re.compile(cause), (f"parameter:{name}" for name in found.verdict.parameters)
    if any(true.match(name) for name in (*found.effects, *off)):
        return "claimed"
    groups = (*found.indistinguishable, *found.equivalent)
    tied = [name for group in groups if {*group} & {*found.effects} for name in group]
    tied += [one.like for one in found.lookalikes]
    if any(true.match(name) for name in tied):
        return "tied"
    ranks = (k for k, row in enumerate(found.ranking, 1) if true.match(row.effect))
    return str(next(ranks, "-"))


def trials_to(setup: Setup, utilities: list[float], best: float | None) -> tuple[int | None, ...]:
    """Return the trial at which each share of the gap was first closed, or None."""
    if best is None or not utilities:
        return (None,) * len(SHARES)
    base = utilities[0]
    if not np.isfinite(base):
        base = setup.task.utility(setup.real(held(setup), 0))
    so_far = np.maximum.accumulate(utilities)
    levels = [min(best - (1 - share) * (best - base), best - CLOSE * abs(best)) for share in SHARES]
    return tuple(
        int(np.argmax(so_far >= level)) + 1 if (so_far >= level).any() else None for level in levels
    )


def reached_in(trials: tuple[int | None, ...]) -> str:
    """Return the trials of `trials_to` as text."""
    return "/".join("-" if t is None else str(t) for t in trials)


def held(setup: Setup) -> Policy:
    """Return a policy that holds the inputs from before the start."""
    return setup.task.policy(np.tile(setup.task.past, (setup.task.horizon, 1)), None, None)


def results(rows: list[Row]) -> str:
    """Return the rows as a Markdown table."""

    def number(value: float | None) -> str:
        return "-" if value is None else f"{value:.4g}"

    head = (
        "set-up", "withheld", "first", "final", "optimum", "trials", "to 90/97/99 %",
        "CPU s", "ended",
    )  # fmt: skip
    cells = [
        (
            r.name, r.withheld, number(r.first), number(r.final), number(r.optimum), r.trials,
            reached_in(r.reached), f"{r.seconds:.1f}", f"{r.phase}: {r.sentence}",
        )
        for r in rows
    ]  # fmt: skip
    return table(head, cells)
