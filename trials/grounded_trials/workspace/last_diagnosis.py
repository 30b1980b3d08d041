"""The last diagnosis of a workspace, reports/diagnosis.json, and the trials that the next can use.

A diagnosis uses the stored trials up to the first missing input or unbounded number; gaps in single
states stay gaps. The file may come from another version or an untrusted source, so no text in it is
trusted.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from grounded.errors import GroundedError, NextCommand
from grounded_trials.store.documents import read_document, write_document
from grounded_trials.store.store import made_folder

if TYPE_CHECKING:
    from grounded.diagnosis.report import Diagnosis
    from grounded.trial import Trial
    from grounded_trials.workspace.folder import Folder

FILE = "diagnosis.json"
LEAST_STEPS = 2


def write_diagnosis(folder: Path, found: Diagnosis) -> None:
    """Write a diagnosis to a reports folder, which is made if it is missing."""
    write_document(made_folder(folder) / FILE, found.to_json())


def read_diagnosis(folder: Path) -> Diagnosis | None:
    """Read the diagnosis in a reports folder; return None if there is none.

    Raises:
        GroundedError: if the file can't be read, or does not hold a diagnosis.
    """
    path = folder / FILE
    try:
        document = read_document(path)
        from grounded.diagnosis.report import Diagnosis  # slow, and seldom needed

        return _with_limit(Diagnosis.from_json(document))
    except FileNotFoundError:
        return None
    except (ValueError, RecursionError, GroundedError) as error:
        raise GroundedError(
            f"{path} can't be read ({error}): diagnose again", then=NextCommand("diagnose")
        ) from None


def _with_limit(found: Diagnosis) -> Diagnosis:
    """Add `Verdict.limit` to a diagnosis of an older version, which has it only in the sentence."""
    said = found.verdict
    if said.limit or said.kind != "unknown":
        return found
    why = next((text for text in found.unknowable if text in said.sentence), "")
    return replace(found, verdict=replace(said, limit=why))


def diagnosable(workspace: Folder) -> list[Trial]:
    """Return the trials in order of arrival, each up to the first missing or unbounded number.

    A fit needs complete states. A diagnosis does not, so a sensor dropout only costs its own
    samples, not the rest of the trial.

    Raises:
        GroundedError: if a stored file is damaged.
    """
    cut = [trial.until(trial.known_steps) for trial in workspace.task_trials(measured=True)]
    return [trial for trial in cut if trial.steps >= LEAST_STEPS]
