"""Read a trial written by grounded, before it is checked what it ran; `foreign` reads logs.

A trial written by grounded must have this workspace's model, time grid and task. If it contains the
policy that it ran, that must equal this workspace's candidate to the last bit.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from grounded.checks import refused, same_dt, same_names
from grounded.errors import GroundedError
from grounded.findings import Finding
from grounded.trial import Trial
from grounded_trials.plain_file import read_file
from grounded_trials.store.own_files import FILE_LIMIT
from grounded_trials.store.trial_file import read_trial, trial_bytes
from grounded_trials.workspace.candidates.search_state import none_waits, standing_in
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.identity import (
    ESTIMATED_WITH,
    READ_BY,
    other_task,
)

if TYPE_CHECKING:
    from grounded_trials.logs.resample import Gridded
    from grounded_trials.logs.signal_report import SignalReport
    from grounded_trials.workspace.intake.opening.foreign import ForeignLog


@dataclass(frozen=True, eq=False)
class Read:
    """A trial that may be stored, with its warnings and notes."""

    trial: Trial
    data: bytes
    findings: tuple[Finding, ...] = ()
    doubted: bool = False  # ingested as a candidate's run although its commands differ
    log: ForeignLog | None = None
    cut: Gridded | None = None  # how a foreign log was sampled

    def telling(self, *findings: Finding) -> Read:
        """Return it with further findings."""
        return replace(self, findings=(*self.findings, *findings))

    @property
    def own(self) -> bool:
        """Whether it was written by grounded, in the model's units, and not read through [log]."""
        return self.log is None

    @property
    def signals(self) -> tuple[SignalReport, ...]:
        """The signals of a foreign log."""
        return self.cut.reports if self.cut else ()


def read_own_trial(workspace: Folder, path: Path, candidate: str | None, data: bool) -> Read:
    """Read a trial written by grounded; its names, time grid and task must be this workspace's.

    Raises:
        GroundedError: if they are not, or its candidate is not of this workspace.
    """
    content = read_file(path, FILE_LIMIT)
    trial, meta, policy = read_trial(content, str(path))
    model, dt = workspace.base_model, workspace.config.task.dt
    for what, theirs, own in (
        ("states", trial.state_names, model.state_names),
        ("inputs", trial.input_names, model.input_names),
    ):
        same_names(str(path), what, theirs, own)
    if other := list(_other_units(workspace, meta)):
        raise refused("given.fit", path, what="units", theirs=tuple(other), own="others")
    same_dt(str(path), trial.dt, dt)
    if data:
        if not trial.candidate:
            return Read(trial, content)
        kept = ("system", "source", "source_sha256", "estimated", ESTIMATED_WITH, READ_BY)
        kept_of = {k: v for k, v in meta.items() if k in kept}
        kept_of |= {"kind": "data", "ran": trial.candidate}
        trial = replace(trial, candidate="")
        return Read(trial, encode(workspace, trial, kept_of))
    if candidate is not None and trial.candidate not in ("", candidate):
        raise refused("log.another", where=str(path), ran=candidate, other=trial.candidate)
    if trial.candidate:
        check_candidate(workspace, path, trial.candidate, meta.get("task", ""), policy)
        return Read(trial, content)
    trial = replace(trial, candidate=candidate or outstanding(workspace, path))
    check_candidate(workspace, path, trial.candidate)
    return Read(trial, encode(workspace, trial, about(workspace, trial.candidate)))


def _other_units(workspace: Folder, meta: dict[str, str]) -> Iterator[str]:
    """Yield the signals of a trial with stated units that differ from the model's."""
    model = workspace.base_model
    for kind, own in (("states", model.states), ("inputs", model.inputs)):
        for name, unit in json.loads(meta[kind]).items():
            if unit in ("", own[name]) or "1" in (unit.strip(), own[name]):
                continue
            from grounded.units import same_unit  # of a program of its own

            if not same_unit(unit, own[name]):
                yield f"{name} [{unit}, not {own[name]}]"


def check_candidate(
    workspace: Folder, path: Path, candidate: str, task: str = "", policy: bytes | None = None
) -> None:
    """Check that a candidate is of this workspace and task, and the policy equals its file."""
    if candidate not in workspace.candidate_ids():
        raise refused("log.earlier", path, ran=candidate, what="unknown")
    own = workspace.task.hash
    made, meta = workspace.candidate(candidate)
    if meta.get("task") != own or task not in ("", own):
        was = other_task(workspace.task, made)
        raise refused("log.earlier", path, ran=candidate, was=was)
    if policy is not None and policy != workspace.candidate_bytes(candidate):
        raise refused("log.earlier", path, ran=candidate, what="policy")


def outstanding(workspace: Folder, path: Path) -> str:
    """Return the candidate that waits for a trial, or raise that none does."""
    now = standing_in(workspace)
    if now.outstanding is None:
        best = now.incumbent.candidate.id if now.incumbent else ""
        raise GroundedError(none_waits(workspace, str(path), best))
    return now.outstanding.id


def about(workspace: Folder, candidate: str) -> dict[str, str]:
    """Return the metadata of a trial that is written here."""
    if not candidate:
        return {"kind": "data"}
    _, meta = workspace.candidate(candidate)
    return {"kind": "trial", "task": workspace.task.hash} | {
        key: meta[key] for key in ("iteration", "alpha")
    }


def encode(workspace: Folder, trial: Trial, facts: dict[str, str], start_ns: int = 0) -> bytes:
    """Return the file of a trial with these metadata."""
    return trial_bytes(
        trial,
        facts,
        workspace.candidate_bytes(trial.candidate) if trial.candidate else None,
        state_units=dict(workspace.base_model.states),
        input_units=dict(workspace.base_model.inputs),
        start_ns=start_ns,
    )
