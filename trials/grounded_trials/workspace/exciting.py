"""excite: the drive to record first, by the crude model alone; see `grounded.diagnosis.design`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from grounded.checks import wrong
from grounded.diagnosis.design import Drive, design, uncertain
from grounded.errors import GroundedError, NextCommand
from grounded.findings import Finding, Quantity, Weight, found
from grounded.result import Result
from grounded.search.candidate import Candidate
from grounded.search.scatter import sensor_noise
from grounded.task import MAX_HORIZON, Task
from grounded_trials.workspace.candidates.at_rest import resting
from grounded_trials.workspace.candidates.exporting import to_run
from grounded_trials.workspace.diagnosing import near
from grounded_trials.workspace.folder import Folder

LENGTHS = (5.0, 10.0, 20.0, 40.0)  # [s] that are tried until no parameter stays weak


@dataclass(frozen=True, eq=False, repr=False)
class Excited(Result):
    """The result of `excite`: a drive, and what its log will tell.

    Args:
        candidate: the drive as a candidate, which `run`, `export` and `ingest` take.
        file: its file.
        drive: how it was made.
        known: of each uncertain parameter, its value with the +- of the prior, and the +- that a
            fit of the drive's log leaves at best.
        findings: what to know before it runs.
        then: the command to type next.
    """

    candidate: Candidate
    file: Path
    drive: Drive
    known: Mapping[str, tuple[Quantity, float]]
    findings: tuple[Finding, ...]
    then: NextCommand

    def summary(self) -> str:
        """Return the candidate and its file."""
        return f"{self.candidate.id}: {self.file}"

    def to_json(self) -> dict[str, Any]:
        """Return the document of `excite --json`."""
        drive = self.drive
        long = drive.policy.horizon * drive.policy.dt
        return {
            "candidate": self.candidate.id,
            "file": str(self.file),
            "seconds": long,
            "pattern": drive.pattern,
            "frequencies_hz": [
                one / (drive.policy.horizon * drive.policy.dt) for one in drive.cycles
            ],
            "size": drive.size,
            "feedback": drive.policy.gain is not None,
            "parameters": {
                name: {**prior.to_json(), "std_after": after}
                for name, (prior, after) in self.known.items()
            },
            "findings": [one.to_json() for one in self.findings],
        }


def excite_in(workspace: Folder, seconds: float | None = None) -> Excited:
    """Write the drive that makes the model's uncertain parameters identifiable.

    Args:
        workspace: the workspace; it needs no target.
        seconds: its duration; None: the shortest of `LENGTHS` that
            leaves no parameter weak, or no fewer if longer.

    Raises:
        GroundedError: if no parameter is uncertain, an input has no limits, nothing bounds the
            states, or no drive stays inside [safety].
    """
    task = _bounded(workspace)
    lengths = LENGTHS if seconds is None else (seconds,)
    hidden = task.model.state_names[workspace.base_model.n :]
    noise = np.zeros(task.model.n)
    noise[: workspace.base_model.n] = sensor_noise(workspace.task_trials(), workspace.base_model.n)
    drive = None
    for length in lengths:
        steps = round(length / task.dt)
        if not 2 <= steps <= MAX_HORIZON:
            raise wrong("--seconds", length, low=2 * task.dt, high=MAX_HORIZON * task.dt)
        made = design(task, steps, noise, hidden)
        if made is None or (drive is not None and len(made.weak) == len(drive.weak)):
            break  # what stays in [safety] for 5 s may not for 10 s, and some only act together
        drive = made
        if not made.weak:
            break
    if drive is None:
        raise GroundedError(found("plan.no_drive"))
    told = [found("plan.drive_weak", *drive.weak)] if drive.weak else []
    candidate = _stored(workspace, drive)
    params = task.model.params
    known = {
        name: (Quantity(one.value, one.unit, one.spread), share * one.spread)
        for name, share in drive.left.items()
        for one in (params[name],)
    }
    then = to_run(workspace, candidate.id, candidate.id)
    return Excited(
        candidate, workspace.candidate_path(candidate.id), drive, known, tuple(told), then
    )


def _bounded(workspace: Folder) -> Task:
    """Return the task at rest, its states bounded by [safety] or by where logs have been."""
    planner, task = workspace.planner, workspace.planner.plan
    if not uncertain(task):
        raise GroundedError(found("given.constant", str(workspace.config.model.file)))
    ends = zip(task.model.input_names, task.low, task.high, strict=True)
    if free := [name for name, *both in ends if not np.isfinite(both).all()]:
        raise GroundedError(found("plan.no_limits", *free, weight=Weight.REFUSE))
    trials = [one for one in workspace.task_trials() if one.steps > 1]
    if trials:
        task = near(planner, trials)
    assert task.safety_low is not None and task.safety_high is not None
    if not np.isfinite([*task.safety_low, *task.safety_high]).any():
        raise GroundedError(found("plan.no_drive", state=task.model.state_names[0]))
    stands = resting(task, np.zeros(task.model.n, bool), planner.loose)
    return task if stands is None else replace(task, past=stands[task.model.n :])


def _stored(workspace: Folder, drive: Drive) -> Candidate:
    """Write a drive as a candidate that is none of the search."""
    planner, n = workspace.planner, workspace.base_model.n
    model = workspace.base_model
    candidate = Candidate(
        id=workspace.next_id(),
        policy=planner.narrowed(drive.policy),
        iteration=0,
        alpha=1.0,
        base="",
        model=planner.fingerprint,
        predicted_states=drive.run.states[:, :n],
        predicted_inputs=drive.run.inputs,
        predicted_utility=math.nan,
        units={**model.states, **model.inputs},
    )
    return workspace.save_probe(candidate)
