"""ingest: check, resample and store logs of the real system.

A trial written by grounded is stored byte for byte. A foreign log is mapped to the states and
inputs of the model ([log]), sampled on the control grid, and stored as a trial that names its
source by hash; the log itself stays where it is. The same input gives the same bytes, so that a
second ingest finds the first.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from operator import attrgetter
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from grounded.accounts.sent import as_sent
from grounded.checks import refused
from grounded.errors import NextCommand
from grounded.findings import Finding, Quantity, Weight, found, settle
from grounded.result import NULL, UNSAID, Document, with_unit
from grounded.search.candidate import Candidate
from grounded.task import Task
from grounded.trial import HUGE, Trial
from grounded_trials.logs.log_paths import log_files, on_disk
from grounded_trials.store.own_files import CANDIDATE, TRIAL, format_of
from grounded_trials.store.store import DIGITS, Added
from grounded_trials.workspace.candidates.search_state import (
    candidate_named,
    overtaken,
    standing_in,
    standing_of,
)
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.identity import sha256
from grounded_trials.workspace.intake import COLUMNS
from grounded_trials.workspace.intake.gone_wrong import Run
from grounded_trials.workspace.intake.opening.reading import Read, read_own_trial
from grounded_trials.workspace.new_target import PROPOSE
from grounded_trials.workspace.next_step import ASIDE, after_log
from grounded_trials.workspace.off_target import OffTarget, off_target_of

if TYPE_CHECKING:
    from grounded_trials.logs.signal_report import SignalReport

FAULTS = (*COLUMNS, "run.exchanged")  # the next plan would be based on wrong columns
ROUNDED = 0.01  # of an input's largest command: a smaller excess over its limits is rounding


@dataclass(frozen=True, eq=False, repr=False)
class Ingested(Document):
    """One ingested log; a failed run has no utility in JSON."""

    ALSO = ("failed", "faults", "warnings", "notes")

    trial: str  # its short name, t0007
    sha256: str
    known: bool  # it had been stored before
    candidate: str = field(metadata=NULL)  # "" for data
    utility: float | None  # None for data; -inf for a run that failed
    accepted: bool | None  # None for data, or if not decided yet
    findings: tuple[Finding, ...]  # on the log and the run, the heaviest first
    signals: tuple[SignalReport, ...]  # for a foreign log
    # a word of `wording.verdict`, run again, probe; "" for data
    verdict: str = field(metadata=NULL, default="")
    crashed: tuple[str, ...] = ()  # the candidate's trials that ended early, if it crashed
    # utility of the candidate's runs, by which it is judged, and how many these are
    mean: float = field(metadata=UNSAID, default=math.nan)
    runs: int = field(metadata=UNSAID, default=0)
    off_target: tuple[OffTarget, ...] = ()  # errors of the run, in units
    then: NextCommand = field(metadata=UNSAID, default=PROPOSE)

    @property
    def failed(self) -> bool:
        """Whether the run ended early."""
        return self.utility == -math.inf

    @property
    def warnings(self) -> tuple[str, ...]:
        """The sentences of the findings that may change what a person does."""
        return self._sentences(lambda one: one.weight is not Weight.NOTE)

    @property
    def notes(self) -> tuple[str, ...]:
        """The sentences of the others."""
        return self._sentences(lambda one: one.weight is Weight.NOTE)

    @property
    def faults(self) -> tuple[str, ...]:
        """The sentences of those that say that columns of the log are wrong."""
        return self._sentences(lambda one: one.code in FAULTS)

    def _sentences(self, which: Callable[[Finding], bool]) -> tuple[str, ...]:
        return tuple(one.sentence for one in self.findings if which(one)) if self.findings else ()

    def summary(self) -> str:
        """Return the trial, what it ran and the verdict."""
        return f"{self.trial}: {f'{self.candidate}, {self.verdict}' if self.candidate else 'data'}"


def ingest_log(
    workspace: Folder,
    path: Path,
    candidate: str | None = None,
    *,
    data: bool = False,
    group: str = "",
    sent_before: Mapping[str, float] = MappingProxyType({}),
) -> Ingested:
    """Check a log and store it as a trial, see `Workspace.ingest`; store nothing on an error."""
    candidate = candidate and candidate_named(workspace, candidate)
    kind = format_of(path)
    if kind == CANDIDATE:
        raise refused("file.no_log", path, head=f"candidate {path.stem}")
    if candidate is not None and data:
        raise refused("given.either", "--data", "--candidate", how="one")
    if kind == TRIAL:
        read = read_own_trial(workspace, path, candidate, data)
    else:
        from grounded_trials.workspace.intake.opening.foreign import read_log_file

        read = read_log_file(workspace, path, candidate, data, sent_before)
    # data, or commands that are the candidate's to the last digits: no other story is asked for;
    # of a foreign log it must be found where the run begins
    ran = read.trial.candidate
    if ran and not (read.own and as_sent(workspace.candidate(ran)[0].policy, read.trial)):
        from grounded_trials.workspace.intake.recognise import recognised

        read = recognised(workspace, path, read, candidate)
    if read.log and read.log.stored:
        from grounded_trials.workspace.intake.opening.stored_before import as_stored

        read = replace(read, data=as_stored(workspace, read.log, read.trial, read.data))
    before = _repeated(workspace, path, read.trial, read.data)
    with ExitStack() as new:  # nothing is stored if judging the trial fails
        added = new.enter_context(workspace.store.adding(read.data, again=before != ""))
        if group:
            note = {"note": "group", "trial": added.sha256[:DIGITS], "group": group}
            new.enter_context(workspace.notes.adding(note, again=True))
        workspace.forget_trials()
        return _judged(workspace, read, added, before)


def _repeated(workspace: Folder, path: Path, trial: Trial, data: bytes) -> str:
    """Return the stored trial that a new run repeats to the last bit, or "".

    The same bytes count as a new run, not as the old one ingested twice, if that candidate is
    outstanding and the file was written after the stored one.
    """
    digest = sha256(data)
    known = None
    for one in workspace.store.list():
        known = one if digest.startswith(one.digest) else known
    if known is None or not trial.candidate:
        return ""
    waiting = standing_in(workspace).outstanding
    written = 0
    for file in log_files(path):
        for part in on_disk(file):
            written = max(written, part.stat().st_mtime_ns)
    fresh = written > known.path.stat().st_mtime_ns
    return known.id if fresh and waiting and waiting.id == trial.candidate else ""


def _judged(workspace: Folder, read: Read, added: Added, before: str) -> Ingested:
    """Return the result for a trial that was just stored: findings, verdict, next command."""
    run = Run(workspace, replace(read.trial, id=added.id))
    aside, ran = added.id in workspace.discarded(), bool(run.trial.candidate)
    told = [*read.findings, *_circumstances(run, read, before, aside=aside)]
    told += _checked(run)
    told += filter(None, run.shown(own=read.own, doubted=read.doubted))
    findings = settle(told)
    why = next((one for one in findings if one.weight is Weight.ASIDE), None) if findings else None
    if why := None if aside else why:  # `status` asks again
        said = json.dumps(why.to_json())
        workspace.note(note="asked", trial=added.sha256[:DIGITS], finding=said)
    verdict, tried = ASIDE if aside else _verdict(run), run.tried
    found = dict[str, Any](verdict=verdict, accepted=None)
    if tried:
        found |= {"accepted": tried.accepted, "mean": tried.utility, "runs": len(tried.trials)}
        found |= {"crashed": tried.failed} if verdict == "crashed" else {}
    return Ingested(
        trial=added.id,
        sha256=added.sha256,
        known=added.known,
        candidate=run.trial.candidate,
        utility=workspace.task.utility(run.whole) if ran else None,
        findings=findings,
        signals=read.signals,
        off_target=off_target_of(workspace.task, [run.whole] if ran else []),
        then=NextCommand("discard", (added.id,)) if why else after_log(workspace, verdict, run.now),
        **found,
    )


def _circumstances(run: Run, read: Read, before: str, *, aside: bool) -> Iterator[Finding]:
    """Yield what is to be known of a log beside the store and the search."""
    workspace, now = run.workspace, run.now
    if before:
        yield found("log.repeats", before)
    if aside:
        waits = now.outstanding.id if now and now.outstanding else ""
        yield found("log.aside", run.trial.id, waits=waits)
    if now and (changed := overtaken(workspace, ran=True)):
        yield changed.weighing(Weight.WARN)


def _verdict(run: Run) -> str:
    """Return the verdict on a run; "run again" for another one of what was the best before it."""
    tried, workspace, own = run.tried, run.workspace, run.trial.id
    if tried is None:
        return "probe" if run.trial.candidate else ""
    first = map(attrgetter("id"), tried.trials[: workspace.config.search.repeats])
    if own in first or tried.accepted is None or tried.crashed:
        return tried.verdict()
    before, ran = standing_of(workspace, workspace.read(), {own}), tried.candidate.id
    if tried.accepted:
        was = any(t.accepted for t in before.history if t.candidate.id == ran)
    else:
        was = before.incumbent is not None and before.incumbent.candidate.id == ran
    return "run again" if was else tried.verdict()


# --- what a trial lacks or exceeds ---------------------------------------------------------------


def _checked(run: Run) -> Iterator[Finding]:
    """Yield what a trial lacks or exceeds."""
    task, whole, filled = run.workspace.task, run.whole, run.bridged
    if filled.samples:
        longest, at = Quantity(filled.longest_s, "s"), Quantity(filled.at_s, "s")
        yield found("log.gaps", filled.state, samples=filled.samples, longest=longest, at=at)
    if whole.finite_steps < whole.steps:
        name, step = _first_bad(whole)
        ends = Quantity(step * whole.dt, "s") if step else "its start"
        yield found("file.vanished", name, ends=ends)
    if not whole.candidate:
        yield from _still(whole)
        yield from _beyond(run.workspace, whole)
        return
    yield from _beyond(run.workspace, run.run)
    if np.ptp(run.own.predicted_states, axis=0).any():
        yield from _still(run.run)
    yield from _unsafe(task, run.run, run.own)


def _first_bad(trial: Trial) -> tuple[str, int]:
    """Return the first state or input that is not a finite number, and its step."""
    places = [
        (int(step), name)
        for values, names in ((trial.states, trial.state_names), (trial.inputs, trial.input_names))
        for column, name in zip(values.T, names, strict=True)
        for step in np.flatnonzero(~(np.abs(column) < HUGE))[:1]
    ]
    step, name = min(places, key=lambda place: place[0])
    return name, step


def _unsafe(task: Task, trial: Trial, ran: Candidate) -> Iterator[Finding]:
    """Yield the states that left [safety], with the predicted value."""
    states = trial.states[: trial.finite_steps + 1]
    inside = task.inside_safety(states)
    excess = np.abs(states - inside)
    for i in np.flatnonzero(excess.any(axis=0)):
        name, unit = list(task.model.states.items())[i]
        t, first = int(np.argmax(excess[:, i])), float(np.argmax(excess[:, i] > 0))
        yield found(
            "run.safety",
            name,
            bound=Quantity(float(inside[t, i]), unit),
            at=Quantity(first * trial.dt, "s"),
            most=Quantity(float(states[t, i]), unit),
            predicted=Quantity(float(ran.predicted_states[t, i]), unit),
        )


def _still(trial: Trial) -> Iterator[Finding]:
    """Yield that no known state changes during a trial."""
    known = trial.states[:, np.isfinite(trial.states).any(axis=0)]
    if len(known) > 1 and not np.any(np.nanmax(known, axis=0) > np.nanmin(known, axis=0)):
        yield found("log.still", trial=trial.id)


def _beyond(workspace: Folder, trial: Trial) -> Iterator[Finding]:
    """Yield inputs that exceed [limits]: of data these were taken from another log."""
    task, sent = workspace.task, np.nan_to_num(trial.inputs)
    slack = ROUNDED * np.abs(sent).max(axis=0, initial=0.0)
    past = np.maximum(task.low - sent, sent - task.high).max(axis=0, initial=0.0)
    for i in np.flatnonzero(past > slack):
        name, ends = trial.input_names[i], (float(task.low[i]), float(task.high[i]))
        unit = task.model.inputs[name]
        how = "clip" if trial.candidate else "widen"
        limits = f"{ends[0]:.4g} to {with_unit(f'{ends[1]:.4g}', unit)}"
        yield found("log.limits", name, most=Quantity(float(past[i]), unit), limits=limits, how=how)
