"""excite: the drive to record first, by the crude model alone; see `grounded.search.design`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from grounded.checks import wrong
from grounded.errors import GroundedError, NextCommand
from grounded.findings import Finding, Quantity, Weight, found
from grounded.model import Model
from grounded.result import UNSAID, Document
from grounded.search.design import Drive, design
from grounded.search.noise import sensor_noise
from grounded.task import MAX_HORIZON, Task
from grounded_trials.workspace.adoption import known_values
from grounded_trials.workspace.candidates.at_rest import resting
from grounded_trials.workspace.candidates.first_plan import idle_inputs, no_effect, unlimited
from grounded_trials.workspace.diagnosing import near, probe_candidate
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.next_step import to_run

LENGTHS = (5.0, 10.0, 20.0, 40.0)  # [s] that are tried until no parameter stays weak


@dataclass(frozen=True, eq=False, repr=False)
class Excited(Document):
    """The result of `excite`: a drive, and what its log will tell."""

    candidate: str  # that `run`, `export` and `ingest` take
    file: Path
    seconds: float
    pattern: str  # "multisine" or "staircase"
    frequencies_hz: tuple[float, float]  # the slowest and the quickest of it
    size: float  # the share of the inputs' range that it uses
    feedback: bool
    # of each uncertain parameter its value with the +- now, and the +- that a fit leaves at best
    parameters: Mapping[str, Mapping[str, Any]]
    findings: tuple[Finding, ...]  # what to know before it runs
    drive: Drive = field(metadata=UNSAID)
    then: NextCommand = field(metadata=UNSAID)


def excite_in(workspace: Folder, seconds: float | None = None) -> Excited:
    """Write the drive that makes the model's uncertain parameters identifiable.

    Args:
        workspace: the workspace; it needs no target.
        seconds: its duration; None: the shortest of `LENGTHS` that
            leaves no parameter weak, or no fewer if longer.

    Raises:
        GroundedError: if no parameter is uncertain, an input has no limits, none moves the model,
            nothing bounds the states, or no drive stays inside these bounds.
    """
    task = _bounded(workspace)
    idle = idle_inputs(workspace.task, workspace.task.start[None], workspace.task.past[None])
    told = [no_effect(workspace, idle)] if idle else []
    if len(idle) == task.model.m:
        raise GroundedError(told[0].weighing(Weight.REFUSE))
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
    told += [found("plan.drive_weak", *drive.weak)] if drive.weak else []
    policy = workspace.planner.narrowed(drive.policy)
    candidate = workspace.save_probe(probe_candidate(workspace, policy, drive.run))
    slow, quick = drive.cycles
    long = drive.policy.horizon * drive.policy.dt
    params = ((one, share, task.model.params[one]) for one, share in drive.left.items())
    return Excited(
        candidate=candidate.id,
        file=workspace.candidate_path(candidate.id),
        seconds=long,
        pattern=drive.pattern,
        frequencies_hz=(slow / long, quick / long),
        size=drive.size,
        feedback=drive.policy.gain is not None,
        parameters={
            name: {**Quantity(p.value, p.unit, p.spread).to_json(), "std_after": share * p.spread}
            for name, share, p in params
        },
        findings=tuple(told),
        drive=drive,
        then=to_run(workspace, candidate.id, candidate.id),
    )


def _bounded(workspace: Folder) -> Task:
    """Return the task at rest, its states bounded by [safety] or by where logs have been."""
    planner = workspace.planner
    task = planner.plan.with_model(_as_known(workspace, planner.plan.model))
    if not task.model.uncertain:
        raise GroundedError(found("given.constant", str(workspace.config.model.file)))
    if free := unlimited(task):
        raise GroundedError(found("plan.no_limits", *free, weight=Weight.REFUSE))
    trials = [one for one in workspace.task_trials() if one.steps > 1]
    if trials:
        task = near(task, planner.task.model.n, trials)
    assert task.safety_low is not None and task.safety_high is not None
    if not np.isfinite([*task.safety_low, *task.safety_high]).any():
        raise GroundedError(found("plan.no_drive", state=task.model.state_names[0]))
    held = resting(task, planner.loose)
    return task if held is None else replace(task, past=held)


def _as_known(workspace: Folder, model: Model) -> Model:
    """Return a model whose parameters are as uncertain as fits and adoptions have left them."""
    known = known_values(workspace)
    told = {
        name: replace(one, std=known[name].std)
        for name, one in model.params.items()
        if one.uncertain and name in known and 0 < known[name].std < one.spread
    }
    return replace(model, params={**model.params, **told})
