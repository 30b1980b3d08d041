"""The command to type next: one answer for every command and the page.

What happened since a diagnosis: newer trials, adopted effects, other parameters.

A verdict is about the model and the trials of its day; what was adopted since is no longer missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from grounded.errors import NextCommand
from grounded.search.standing import Standing
from grounded_trials.workspace.diagnosing import diagnosable
from grounded_trials.workspace.diagnosis_file import Diagnosis
from grounded_trials.workspace.folder import Folder

EXPORT = NextCommand("export", ("best", "--format", "npz"))


def next_command(
    workspace: Folder, now: Standing, diagnosis: Diagnosis | None, usable: Sequence[str]
) -> NextCommand:
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
        return NextCommand("propose") if now.phase == "propose" else NextCommand("diagnose")
    since = since_diagnosis(workspace, diagnosis, usable)
    follow = after_diagnosis(workspace, diagnosis)
    if now.phase == "propose":  # what logs have shown is adopted before the first candidate
        if now.history or since.changed or not follow:
            return NextCommand("propose")
        return NextCommand("diagnose") if since.newer else follow
    if since.changed or since.newer:
        return NextCommand("diagnose")
    if diagnosis.no_cause:
        return another_trial(workspace, now)
    return follow or EXPORT


def another_trial(workspace: Folder, now: Standing) -> NextCommand:
    """How to get one more trial: of what waits, of what comes next, or of the best again."""
    system = workspace.config.system
    here = bool(system.command or system.model)
    if now.phase == "await-trial":
        return NextCommand("run") if here else NextCommand("ingest", ("TRIAL.mcap",))
    if now.phase == "propose" or now.incumbent is None:
        return NextCommand("propose")
    return NextCommand("run", ("best",)) if here else NextCommand("ingest", ("TRIAL.mcap",))


def after_diagnosis(workspace: Folder, diagnosis: Diagnosis) -> NextCommand | None:
    """What to do about the effects that a diagnosis claims, None where there is nothing to do."""
    new = diagnosis.open(workspace.config.model.effects)
    if diagnosis.kind not in ("effect", "several") or not new:
        return None
    own = {f"parameter:{name}" for name in workspace.base_model.params}
    if own.issuperset(new):
        return NextCommand("fit")  # the model's form is right: all of its numbers at once
    return NextCommand("adopt", tuple(new))


@dataclass(frozen=True)
class Since:
    """The days between a diagnosis and now."""

    used: int = 0  # of the trials that can be used, those it was made from
    usable: int = 0
    newer: int = 0  # that can be used and came after it
    adopted: tuple[str, ...] = ()  # claimed effects that are part of the model now
    missing: tuple[str, ...] = ()  # claimed effects that are not, where some are
    changed: bool = False  # it was made with another model

    @property
    def sentence(self) -> str:
        """Why it is no longer the last word; "" where it is."""
        parts = []
        if self.newer:
            parts.append(f"diagnosed with {self.used} of {self.usable} trials")
        if self.adopted:
            but = f", but not {', '.join(self.missing)}" * bool(self.missing)
            parts.append(f"adopted since: {', '.join(self.adopted)}{but}")
        elif self.changed:
            parts.append("the model was changed since")
        return "; ".join([*parts, "run `grounded diagnose` again"]) if parts else ""


def usable_ids(workspace: Folder) -> list[str]:
    """The trials that a diagnosis can use, in order of arrival.

    Raises:
        GroundedError: if a stored file is damaged.
    """
    return [trial.id for trial in diagnosable(workspace)]


def since_diagnosis(workspace: Folder, diagnosis: Diagnosis, usable: Sequence[str]) -> Since:
    """What a diagnosis does not know.

    Args:
        workspace: whose model it was about.
        diagnosis: as it was kept.
        usable: the trials that can be used now, in order of arrival.
    """
    model, seen = workspace.config.model, set(diagnosis.trials)
    params = None if diagnosis.model_params is None else dict(diagnosis.model_params)
    last = max((k for k, name in enumerate(usable) if name in seen), default=-1)
    missing = diagnosis.open(model.effects)
    adopted = tuple(name for name in diagnosis.effects if name not in missing)
    same = [dict(e) for e in model.effects] == [dict(e) for e in diagnosis.adopted]
    return Since(
        used=sum(name in seen for name in usable),
        usable=len(usable),
        newer=len(usable) - 1 - last if seen else 0,
        adopted=adopted,
        missing=missing if adopted else (),
        changed=not same or params not in (None, dict(model.params)),
    )
