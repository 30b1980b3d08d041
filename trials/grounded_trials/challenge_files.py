"""The blind challenge on disk: workspaces to diagnose, and their labels sealed apart.

    DIR/single-0007/       a workspace: module, parameters, target, trials; nothing says the answer
    DIR/manifest.json      for each case the SHA-256 of its label and of each of its trials
    LABELS/single-0007.json  the answer; it is opened only if it has the announced hash

Labels belong on another disk while the cases are diagnosed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from grounded.errors import GroundedError
from grounded_trials.config import FILE
from grounded_trials.examples import toml_of
from grounded_trials.mcap_log import trial_bytes
from grounded_trials.store import Store, write_atomically
from grounded_trials.target_file import write_target
from grounded_trials.workspace import Workspace

if TYPE_CHECKING:
    from grounded.diagnosis.challenge import Case

MANIFEST = "manifest.json"


def write_cases(
    cases: Iterator[Case], folder: Path, labels: Path, tick: Callable[[int], None]
) -> list[str]:
    """Writes the workspaces, then the labels, then the manifest; returns the cases' names.

    Raises:
        GroundedError: if the folder holds a challenge already, or the labels would lie inside it.
    """
    if (folder / MANIFEST).exists():
        raise GroundedError(f"{folder} holds a challenge already: name another folder")
    if labels.resolve().is_relative_to(folder.resolve()):
        raise GroundedError(f"the labels ({labels}) must lie outside {folder}: they are sealed")
    for place in (folder, labels):
        place.mkdir(parents=True, exist_ok=True)
    entries: dict[str, Any] = {}
    for number, case in enumerate(cases, start=1):
        trials = _write_case(case, folder / case.name)
        text = json.dumps(case.label, sort_keys=True)
        write_atomically(labels / f"{case.name}.json", text.encode())
        label = hashlib.sha256(text.encode()).hexdigest()
        entries[case.name] = {"label_sha256": label, "trials_sha256": trials}
        tick(number)
    document = json.dumps({"format": "grounded challenge 1", "cases": entries}, indent=1)
    write_atomically(folder / MANIFEST, document.encode())
    return list(entries)


def _write_case(case: Case, folder: Path) -> list[str]:
    """A case as a workspace; the hashes of its trials."""
    from grounded.diagnosis.challenge import task_of

    folder.mkdir(parents=True)
    task, names = task_of(case), case.model.state_names
    columns = {name: case.target[:, i] for i, name in enumerate(names)}
    write_target(folder / "target.csv", case.dt, columns)
    values = ", ".join(
        f"{name} = {float(value)!r}"
        for name, value in zip(case.model.param_names, case.model.values, strict=True)
    )
    lines = toml_of(task, case.name).split("\n")
    at = next(i for i, line in enumerate(lines) if line.startswith("file ="))
    lines[at : at + 1] = [f'module = "grounded.models.{case.system}"', f"params = {{ {values} }}"]
    system = next(i for i, line in enumerate(lines) if line.startswith("[system]"))
    write_atomically(folder / FILE, ("\n".join(lines[:system]) + "\n").encode())
    store = Store(folder / "trials")
    return [store.add(trial_bytes(trial, {"kind": "data"})).sha256 for trial in case.trials]


def read_manifest(folder: Path) -> dict[str, Any]:
    """The cases of a challenge.

    Raises:
        GroundedError: if there is none.
    """
    try:
        document = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        return dict(document["cases"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise GroundedError(
            f"{folder} holds no challenge ({error}): make one with `grounded challenge make`"
        ) from None


def open_label(labels: Path, name: str, entry: dict[str, Any]) -> dict[str, Any]:
    """A case's label, if it is the one that was announced.

    Raises:
        GroundedError: if it is missing or was changed.
    """
    path = labels / f"{name}.json"
    try:
        data = path.read_bytes()
    except OSError as error:
        raise GroundedError(f"{path} can't be read: {error.strerror}; name --labels DIR") from None
    if hashlib.sha256(data).hexdigest() != entry["label_sha256"]:
        raise GroundedError(f"{path} is not the label that the manifest announced: it was changed")
    return dict(json.loads(data))


def score_case(folder: Path, labels: Path, name: str, entry: dict[str, Any]) -> dict[str, Any]:
    """One case's marks, from its reports/diagnosis.json.

    Raises:
        GroundedError: if it was not diagnosed, or a trial or label was changed.
    """
    from grounded.diagnosis.challenge import judge, oracle

    workspace = Workspace(folder / name)
    hashes = [hashlib.sha256(workspace.store.read(s)).hexdigest() for s in workspace.store.list()]
    if hashes != entry["trials_sha256"]:
        raise GroundedError(f"{folder / name}: its trials are not those that were made")
    path = workspace.reports / "diagnosis.json"
    try:
        diagnosis = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise GroundedError(
            f"{folder / name} was not diagnosed: run `grounded challenge run {folder}`"
        ) from None
    label = open_label(labels, name, entry)
    task = workspace.task
    latency = np.zeros(task.model.m) if task.latency is None else task.latency
    known = oracle(task.model, workspace.task_trials(), latency, label)
    return judge(label, diagnosis, known)
