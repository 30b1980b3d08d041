"""The command to type next: one answer for every command and the page."""

from __future__ import annotations

from collections.abc import Sequence

from grounded.search import Standing
from grounded_trials.diagnosis_file import Diagnosis
from grounded_trials.workspace import Workspace

EXPORT = "grounded export best --format npz"


def next_command(workspace: Workspace, now: Standing, diagnosis: Diagnosis | None) -> str:
    """What a person does next, given where the search stands and what was diagnosed."""
    if now.phase == "await-trial":
        system = workspace.config.system
        return "grounded run" if system.command or system.model else "grounded ingest TRIAL.mcap"
    known = diagnosis is not None and not _outdated(workspace, diagnosis)
    follow = ""
    if known and diagnosis is not None:
        follow = after_diagnosis(workspace, diagnosis.kind, diagnosis.effects)
    if now.phase == "propose":  # what logs have shown is adopted before the first candidate
        return follow * (not now.history) or "grounded propose"
    return follow or EXPORT if known else "grounded diagnose"


def after_diagnosis(workspace: Workspace, kind: str, effects: Sequence[str]) -> str:
    """What to do about the effects that a diagnosis claims, "" where there is nothing to do."""
    adopted = {str(effect["name"]) for effect in workspace.config.model.effects}
    new = [name for name in effects if name not in adopted]
    if kind not in ("effect", "several") or not new:
        return ""
    if all(name.startswith("parameter:") for name in new):
        return "grounded fit"  # the model's form is right: all of its numbers at once
    return " ".join(["grounded adopt", *new])


def _outdated(workspace: Workspace, diagnosis: Diagnosis) -> bool:
    """Whether it is about another model: effects or parameters were taken over since."""
    model = workspace.config.model
    adopted = tuple(str(effect["name"]) for effect in model.effects)
    params = dict(diagnosis.model_params) if diagnosis.model_params is not None else None
    return adopted != diagnosis.adopted or params not in (None, dict(model.params))
