"""The command to type next: one answer for every command and the page."""

from __future__ import annotations

from collections.abc import Sequence

from grounded.search import Standing
from grounded_trials.diagnosis_file import Diagnosis
from grounded_trials.since import since_diagnosis
from grounded_trials.workspace import Workspace

EXPORT = "grounded export best --format npz"


def next_command(
    workspace: Workspace, now: Standing, diagnosis: Diagnosis | None, usable: Sequence[str]
) -> str:
    """What a person does next, given where the search stands and what was diagnosed.

    Args:
        workspace: whose model may have changed since the diagnosis.
        now: where its search stands.
        diagnosis: the last one.
        usable: the trials that a diagnosis can use now, in order of arrival.
    """
    if now.phase == "await-trial":
        return another_trial(workspace, now)
    if diagnosis is None:
        return "grounded propose" if now.phase == "propose" else "grounded diagnose"
    since = since_diagnosis(workspace, diagnosis, usable)
    follow = after_diagnosis(workspace, diagnosis)
    if now.phase == "propose":  # what logs have shown is adopted before the first candidate
        if now.history or since.changed or not follow:
            return "grounded propose"
        return "grounded diagnose" if since.newer else follow
    if since.changed or since.newer:
        return "grounded diagnose"
    if diagnosis.no_cause:
        return another_trial(workspace, now)
    return follow or EXPORT


def another_trial(workspace: Workspace, now: Standing) -> str:
    """How to get one more trial: of what waits, of what comes next, or of the best again."""
    system = workspace.config.system
    here = bool(system.command or system.model)
    if now.phase == "await-trial":
        return "grounded run" if here else "grounded ingest TRIAL.mcap"
    if now.phase == "propose" or now.incumbent is None:
        return "grounded propose"
    return "grounded run best" if here else "grounded ingest TRIAL.mcap"


def after_diagnosis(workspace: Workspace, diagnosis: Diagnosis) -> str:
    """What to do about the effects that a diagnosis claims, "" where there is nothing to do."""
    new = diagnosis.open(workspace.config.model.effects)
    if diagnosis.kind not in ("effect", "several") or not new:
        return ""
    own = {f"parameter:{name}" for name in workspace.base_model.params}
    if own.issuperset(new):
        return "grounded fit"  # the model's form is right: all of its numbers at once
    return " ".join(["grounded adopt", *new])
