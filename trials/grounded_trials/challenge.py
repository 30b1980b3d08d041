"""The blind challenge on disk: writes cases, diagnoses them without their labels, scores them.

    DIR/single-0007/       a workspace: module, parameters, target, trials, but no label
    DIR/manifest.json      for each case the SHA-256 of its label and of each of its trials
    LABELS/single-0007.json  the label; it is accepted only with the hash in the manifest

Keep the labels on another disk while the cases are diagnosed. Cases are independent jobs
(`grounded.experiments.jobs`). Each diagnosis is stored in its own workspace, so an interrupted run
continues where it stopped.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from grounded.challenge import Case, judge, of_crude, oracle, sealed
from grounded.checks import refused, wrong
from grounded.diagnosis.parts import Diagnosis, Verdict
from grounded.effects import Library
from grounded.engine import Engine
from grounded.errors import GroundedError, NextCommand
from grounded.experiments.jobs import Progress, run_jobs
from grounded.findings import found
from grounded_trials.plain_file import read_file, unreadable
from grounded_trials.starting.examples import toml_of
from grounded_trials.store.documents import read_document
from grounded_trials.store.store import DIGITS, Store, made_folder, write_atomically
from grounded_trials.store.trial_file import trial_bytes
from grounded_trials.workspace.diagnosing import diagnose_in
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.last_diagnosis import FILE as DIAGNOSIS
from grounded_trials.workspace.last_diagnosis import write_diagnosis
from grounded_trials.workspace.user_files.config import FILE
from grounded_trials.workspace.user_files.task_file import write_target

MANIFEST = "manifest.json"
LIMIT = 2**26  # [bytes] of a manifest or a label


def write_cases(
    cases: Iterator[Case], folder: Path, labels: Path, tick: Callable[[int], None]
) -> list[str]:
    """Write the workspaces and labels of all cases, then the manifest; return the cases' names.

    The manifest is written last: a folder without one was interrupted, and writing the same cases
    again continues there. The labels must lie outside the folder; `tick` gets the number of cases.
    """
    if (folder / MANIFEST).exists():
        raise refused("file.exists", folder / MANIFEST)
    if labels.resolve().is_relative_to(folder.resolve()):
        raise wrong("folder of the labels", got=str(labels), must="outside")
    for place in (folder, labels):
        made_folder(place)
    entries: dict[str, Any] = {}
    for number, case in enumerate(cases, start=1):
        trials = _write_case(case, folder / case.name)
        text = json.dumps(case.label, sort_keys=True)
        write_atomically(labels / f"{case.name}.json", text.encode())
        entries[case.name] = {"label_sha256": sealed(case.label), "trials_sha256": trials}
        tick(number)
    document = json.dumps({"format": "grounded challenge 1", "cases": entries}, indent=1)
    write_atomically(folder / MANIFEST, document.encode())
    return list(entries)


def _write_case(case: Case, folder: Path) -> list[str]:
    """Write a case as a workspace; return the SHA-256 of each of its trials."""
    store = Store(folder / "trials")
    files = [trial_bytes(trial, {"kind": "data"}) for trial in case.trials]
    hashes = [hashlib.sha256(data).hexdigest() for data in files]
    stored = [entry.digest for entry in store.list()]
    if stored != [digest[:DIGITS] for digest in hashes[: len(stored)]]:
        raise refused("file.exists", folder / "trials")
    made_folder(folder)
    task, model = case.task, case.task.model
    columns = {name: task.target[:, i] for i, name in enumerate(model.state_names)}
    write_target(folder / "target.csv", task.dt, columns)
    values = ", ".join(
        f"{name} = {float(value)!r}"
        for name, value in zip(model.param_names, model.values, strict=True)
    )
    lines = toml_of(task, case.name).split("\n")
    at = next(i for i, line in enumerate(lines) if line.startswith("file ="))
    lines[at : at + 1] = [f'module = "grounded.models.{case.system}"', f"params = {{ {values} }}"]
    system = next(i for i, line in enumerate(lines) if line.startswith("[system]"))
    write_atomically(folder / FILE, ("\n".join(lines[:system]) + "\n").encode())
    return [store.add(data).sha256 for data in files]


def read_manifest(folder: Path) -> dict[str, Any]:
    """Read the cases of a challenge from its manifest."""
    path = folder / MANIFEST
    try:
        return dict(json.loads(read_file(path, LIMIT))["cases"])
    except (ValueError, KeyError, TypeError):
        raise unreadable(path, "format", kind="challenge") from None


def open_label(labels: Path, name: str, entry: dict[str, Any]) -> dict[str, Any]:
    """Read a case's label and check its hash against the manifest's entry."""
    path = labels / f"{name}.json"
    data = read_file(path, LIMIT)
    if hashlib.sha256(data).hexdigest() != entry["label_sha256"]:
        raise refused("file.changed", path, what="manifest")
    return dict(json.loads(data))


def score_case(
    folder: str | Path, labels: str | Path, name: str, entry: dict[str, Any]
) -> dict[str, Any]:
    """Score one case from its reports/diagnosis.json (a job)."""
    workspace = Folder(Path(folder) / name)
    hashes = [hashlib.sha256(workspace.store.read(s)).hexdigest() for s in workspace.store.list()]
    if hashes != entry["trials_sha256"]:
        raise refused("file.changed", workspace.folder / "trials", what="manifest")
    path = workspace.reports / "diagnosis.json"
    try:
        diagnosis = read_document(path)
    except FileNotFoundError:
        then = NextCommand("challenge", ("run", str(folder)))
        raise refused("search.undiagnosed", workspace.folder, then=then) from None
    task = workspace.task
    label = of_crude(open_label(Path(labels), name, entry), task.model)
    latency = np.zeros(task.model.m) if task.latency is None else task.latency
    known = oracle(task.model, workspace.task_trials(), latency, label)
    return judge(label, diagnosis, known)


def diagnose_cases(
    folder: Path,
    *,
    without: Sequence[str] = (),
    again: bool = False,
    engine: Engine | None = None,
    progress: Progress | None = None,
) -> dict[str, float]:
    """Diagnose the cases without a diagnosis, or `again` all; return the CPU time [s] by case."""
    every = read_manifest(folder)
    names = [n for n in every if again or not (folder / n / "reports" / DIAGNOSIS).is_file()]
    where = {"folder": str(folder.resolve()), "without": list(without)}
    found = run_jobs(diagnose_case, [where | {"name": n} for n in names], engine, progress)
    return {str(one["case"]): float(one["cpu_s"]) for one in found}


def diagnose_case(folder: str, name: str, without: Sequence[str]) -> dict[str, Any]:
    """Diagnose one case in its workspace (a job); return its name and CPU time [s].

    A case whose logs are refused counts as unknown: nothing is named, and the others go on.
    """
    begin, case = time.process_time(), Folder(Path(folder) / name)
    try:
        diagnose_in(case, without=without, library=Library())
    except GroundedError as error:
        refused = found("gap.refused", why=str(error))
        write_diagnosis(case.reports, Diagnosis(Verdict("unknown"), findings=(refused,)))
    return {"case": name, "cpu_s": time.process_time() - begin}


def score_cases(
    folder: Path,
    labels: Path,
    *,
    engine: Engine | None = None,
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """Score every case against an oracle that knows its label."""
    entries = read_manifest(folder)
    where = {"folder": str(folder.resolve()), "labels": str(labels.resolve())}
    cases = [where | {"name": name, "entry": entry} for name, entry in entries.items()]
    return run_jobs(score_case, cases, engine, progress)
