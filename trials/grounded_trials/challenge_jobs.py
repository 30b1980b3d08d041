"""A challenge's cases as independent jobs: diagnosed without labels, scored with them.

Both run on one machine or on a Dask cluster that sees the same disk (`grounded.experiments.jobs`).
A diagnosis is kept in its own workspace, so a run that was cut off goes on where it was; what it
cost is kept beside the manifest, in times.json.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from grounded_trials.challenge_files import read_manifest, score_case
from grounded_trials.diagnosing import diagnose_in
from grounded_trials.diagnosis_file import FILE
from grounded_trials.store import write_atomically
from grounded_trials.workspace import Workspace

if TYPE_CHECKING:
    from grounded.experiments.jobs import Engine, Progress

TIMES = "times.json"


def diagnose_cases(
    folder: Path,
    *,
    without: Sequence[str] = (),
    again: bool = False,
    engine: Engine | None = None,
    progress: Progress | None = None,
) -> dict[str, float]:
    """Diagnoses every case that was not; CPU seconds of each that is known [s].

    Args:
        folder: the challenge.
        without: families of the built-in library that may not be blamed.
        again: those that were diagnosed before too.
        engine: where the jobs run.
        progress: called with jobs done and jobs in all.

    Raises:
        GroundedError: if the folder holds no challenge, or workers keep dying.
    """
    from grounded.experiments.jobs import Job, run_jobs

    names = undiagnosed(folder, again=again)
    jobs = [
        Job(
            diagnose_case,
            {"folder": str(folder.resolve()), "name": name, "without": list(without)},
        )
        for name in names
    ]
    times = read_times(folder)
    found = run_jobs(jobs, engine, progress=progress)
    times |= {str(one["case"]): float(one["cpu_s"]) for one in found}
    write_atomically(folder / TIMES, json.dumps(times, indent=1, sort_keys=True).encode())
    return times


def undiagnosed(folder: Path, *, again: bool = False) -> list[str]:
    """The cases that were not diagnosed yet, or all of them.

    Raises:
        GroundedError: if the folder holds no challenge.
    """
    names = list(read_manifest(folder))
    return [n for n in names if again or not (folder / n / "reports" / FILE).is_file()]


def diagnose_case(folder: str, name: str, without: Sequence[str]) -> dict[str, Any]:
    """A job: one case, diagnosed in its workspace."""
    from grounded.effects import Library

    begin = time.process_time()
    diagnose_in(Workspace(Path(folder) / name), library=Library().without(without))
    return {"case": name, "cpu_s": time.process_time() - begin}


def score_cases(
    folder: Path,
    labels: Path,
    *,
    engine: Engine | None = None,
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """The marks of every case, beside an oracle that knows its label; with CPU time [s] if known.

    Raises:
        GroundedError: if a case was not diagnosed, or a trial or label was changed.
    """
    from grounded.experiments.jobs import Job, run_jobs

    entries = read_manifest(folder)
    where = {"folder": str(folder.resolve()), "labels": str(labels.resolve())}
    jobs = [Job(score_one, where | {"name": name, "entry": e}) for name, e in entries.items()]
    times = read_times(folder)
    marks = run_jobs(jobs, engine, progress=progress)
    return [m | {"cpu_s": times[m["case"]]} if m["case"] in times else m for m in marks]


def score_one(folder: str, labels: str, name: str, entry: dict[str, Any]) -> dict[str, Any]:
    """A job: one case's marks."""
    return score_case(Path(folder), Path(labels), name, entry)


def read_times(folder: Path) -> dict[str, float]:
    """CPU seconds by case; nothing where the file is missing or can't be read."""
    try:
        return dict(json.loads((folder / TIMES).read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return {}
