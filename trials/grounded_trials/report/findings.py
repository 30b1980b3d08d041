"""Findings: all contents of a report, read once.

Text, page, pictures and recording show the same findings and read no files themselves.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from grounded.diagnosis.parts import Diagnosis
from grounded.diagnosis.telling import Told, sentence, told
from grounded.errors import NextCommand
from grounded.findings import found
from grounded.frozen import Array
from grounded.result import begun
from grounded.search.candidate import Candidate, Tried
from grounded.search.pictures import few
from grounded.search.standing import Standing
from grounded.task import Task
from grounded.trial import Trial
from grounded_trials.store.store import Lost
from grounded_trials.wording import rendered
from grounded_trials.workspace.last_diagnosis import Since
from grounded_trials.workspace.next_step import BEFORE_TRIALS
from grounded_trials.workspace.off_target import tracking_error

if TYPE_CHECKING:
    from grounded_trials.workspace.adoption import Better

ESTIMATED = "not measured: an estimate"  # note at a panel


@dataclass(frozen=True, eq=False)
class Run:
    """A trial of a candidate, with the crude model's residual along it."""

    trial: Trial  # .id is its short name
    candidate: Candidate
    accepted: bool | None
    utility: float
    residual: Array  # (T, n): s_{t+1} - f(s_t, a_t) of the crude model; NaN where not finite
    explained: Array | None = None  # (T, n): the residual of the better model

    @property
    def label(self) -> str:
        """The name in legends: t0007 (c0005)."""
        return f"{self.trial.id} ({self.candidate.id})"


@dataclass(frozen=True, eq=False)
class Log:
    """A log that ran no candidate: for fitting and diagnosis."""

    trial: Trial
    residual: Array  # (T, n), as a run's


@dataclass(frozen=True, eq=False)
class Findings:
    """The contents of a workspace's report; `lost` lists what could not be read."""

    name: str
    task: Task  # with the crude model, whose errors are shown; `effects` are not part of it
    nominal: Mapping[str, float]  # parameters as model.py has them, before [model] params
    effects: tuple[str, ...]  # adopted effects
    method: str  # summary of the [search] table
    standing: Standing
    runs: tuple[Run, ...]  # trials of this task's candidates, in order of arrival
    logs: tuple[Log, ...]  # logs of this robot that ran no candidate
    lost: tuple[Lost, ...]
    diagnosis: Diagnosis | None
    then: NextCommand
    better: Better | None = None  # the model as diagnosed, or with adopted effects
    since: Since = field(default_factory=Since)  # changes since the diagnosis
    adopted: tuple[tuple[str, str], ...] = ()  # name and values of what was adopted
    estimated: tuple[str, ...] = ()  # states that no sensor gives in some of these trials
    folder: str | None = None  # as the user named it, None for the current folder

    @property
    def next_command(self) -> str:
        """The next command, with the workspace as the user named it."""
        return rendered(self.then, self.folder)

    @property
    def told(self) -> Told | None:
        """What is told of the last diagnosis now: what was adopted since is not missing."""
        if self.diagnosis is None:
            return None
        said = told(self.diagnosis)
        return replace(said, next="") if self.since.sentence else said

    @property
    def lines(self) -> list[str]:
        """The same as sentences: what was adopted, why the rest is outdated, and the rest."""
        if self.told is None:
            return []
        first = list[str]()
        if self.adopted:
            first = [sentence(found("model.adopted", *(name for name, _ in self.adopted)))]
        if text := self.since.sentence:
            first.append(f"{begun(text)}.")
        return [*first, *self.told.texts()]

    @property
    def next_trial(self) -> str:
        """The trial that the last diagnosis asks for; "" if it is outdated, or not next."""
        if self.told is None or self.then.verb in BEFORE_TRIALS:
            return ""
        return self.told.next

    @property
    def history(self) -> tuple[Tried, ...]:
        """Every candidate with its trials, in order of proposal."""
        return self.standing.history

    def runs_of(self, candidate: str) -> tuple[Run, ...]:
        """Return the runs of a candidate."""
        return tuple(r for r in self.runs if r.candidate.id == candidate)

    @cached_property
    def first(self) -> Run | None:
        """The latest run of the model's own policy, if that is the first candidate with a trial."""
        tried = next((t for t in self.history if t.trials), None)
        return None if tried is None or tried.candidate.base else self._latest(tried)

    @cached_property
    def best(self) -> Run | None:
        """The latest run of the best candidate so far."""
        return self._latest(self.standing.incumbent)

    def improvements(self, most: int) -> list[Run]:
        """Return a run of at most `most` accepted candidates, the model's policy first."""
        kept, _ = few([tried for tried in self.history if tried.accepted], most)
        return [run for run in map(self._latest, kept) if run is not None]

    def tried_of(self, run: Run) -> Tried:
        """Return a run's candidate with all its trials."""
        return next(t for t in self.history if t.candidate.id == run.candidate.id)

    def _latest(self, tried: Tried | None) -> Run | None:
        runs = () if tried is None else self.runs_of(tried.candidate.id)
        return runs[-1] if runs else None


def compared(findings: Findings) -> list[tuple[str, Run]]:
    """Return the runs that all views compare, by role: the model's policy and the best so far."""
    first, best = findings.first, findings.best
    if first is not None and best is not None and first.candidate is best.candidate:
        return [("model", first)]
    return [(role, run) for role, run in (("model", first), ("best", best)) if run is not None]


def prediction_error(task: Task, run: Run) -> Array:
    """Return real minus predicted states of the same candidate, (T + 1, n), angles wrapped."""
    T = run.trial.steps
    return task.model.difference(run.trial.states, run.candidate.predicted_states[: T + 1])


def measures(findings: Findings, run: Run) -> dict[str, Array]:
    """Return rms errors (n,) of all trials of a run's candidate, and the run's rms bias a second.

    tracking_error, prediction_error: from the target, and from the candidate's own prediction;
    bias_rate: of the crude model along the run.
    """
    task, trials = findings.task, findings.runs_of(run.candidate.id)
    return {
        "tracking_error": rms([tracking_error(task, one.trial) for one in trials]),
        "prediction_error": rms([prediction_error(task, one) for one in trials]),
        "bias_rate": rms([run.residual]) / task.dt,
    }


def rms(parts: Sequence[Array]) -> Array:
    """Return the root mean square of each column over its finite values; NaN if it has none."""
    values = np.vstack(parts)
    finite = np.isfinite(values)
    count = finite.sum(axis=0)
    total = (np.where(finite, values, 0.0) ** 2).sum(axis=0)
    return np.asarray(np.sqrt(np.where(count > 0, total / np.maximum(count, 1), np.nan)))
