"""What happened since a diagnosis: newer trials, adopted effects, other parameters.

A verdict is about the model and the trials of its day; what was adopted since is no longer missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from grounded_trials.diagnosable import diagnosable
from grounded_trials.diagnosis_file import Diagnosis
from grounded_trials.workspace import Workspace


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


def usable_ids(workspace: Workspace) -> list[str]:
    """The trials that a diagnosis can use, in order of arrival.

    Raises:
        GroundedError: if a stored file is damaged.
    """
    return [trial.id for trial in diagnosable(workspace)]


def since_diagnosis(workspace: Workspace, diagnosis: Diagnosis, usable: Sequence[str]) -> Since:
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
