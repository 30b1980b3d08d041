"""A recording that is stored already: the same trial, a new run like it, or another reading of it.

One log, or one part of it, is one trial. Read through another [log] it would be a second one that
repeats the first with other numbers, which no diagnosis survives.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from grounded.errors import GroundedError, NextCommand
from grounded.trial import Trial, scattered
from grounded_trials.logs.log_files import log_files
from grounded_trials.store.trial_file import read_trial
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.foreign import ForeignLog
from grounded_trials.workspace.identity import sha256
from grounded_trials.workspace.proposing import standing_in


def refuse_as_another(log: ForeignLog, wanted: str | None) -> None:
    """Refuses a log that is stored as a run of another candidate, or as data.

    Args:
        log: as it was read.
        wanted: the candidate that it is to be a run of, "" for data, None: whatever it was.

    Raises:
        GroundedError: with the trial to discard.
    """
    if not log.stored or wanted in (None, *(one.trial.candidate for one in log.stored)):
        return
    identity, as_run = log.stored[-1].stored.id, log.stored[-1].trial.candidate
    raise GroundedError(
        f"{log.path} is stored already, as {identity}, {_what(as_run)}: one log is one trial. To "
        f"have it as {_what(wanted)} instead, discard {identity} first",
        NextCommand("discard", (identity,)),
    )


def _what(candidate: str | None) -> str:
    return f"a run of {candidate}" if candidate else "data"


def as_stored(workspace: Folder, log: ForeignLog, trial: Trial, data: bytes) -> bytes:
    """The file of the trial that a log was stored as, whatever the log's name is now.

    Args:
        workspace: that has stored it.
        log: with `stored` trials.
        trial: as it was read now.
        data: that trial's file.

    Raises:
        GroundedError: if it was stored with other numbers, read in another way.
    """
    digest = sha256(data)
    for one in log.stored:
        same = one.trial.candidate == trial.candidate
        pairs = ((one.measured.states, trial.states), (one.measured.inputs, trial.inputs))
        if digest.startswith(one.stored.digest):
            return data
        if same and all(np.array_equal(a, b, equal_nan=True) for a, b in pairs):
            return workspace.store.read(one.stored)
    start, end = _span(read_trial(data)[1], trial)
    spans = {one.stored.id: _span(one.meta, one.trial) for one in log.stored}
    names = tuple(name for name, (a, b) in spans.items() if a < end and start < b)
    if not names:
        return data  # another part of a long recording
    which = names[0] if len(names) == 1 else "them"
    raise GroundedError(
        f"{log.path}: the same recording is stored as {', '.join(names)}, read in another way "
        f"(another [log], [estimate] or [task] dt): discard {which}, then ingest it again",
        NextCommand("discard", names),
    )


def _span(meta: Mapping[str, str], trial: Trial) -> tuple[float, float]:
    """From when to when a trial lasts, on its log's clock [s]."""
    start = int(meta["start_ns"]) * 1e-9
    return start, start + trial.steps * trial.dt


def repeated(workspace: Folder, path: Path, trial: Trial, data: bytes) -> str:
    """The stored trial that a new run repeats to the last bit, "" for none.

    The same bytes are a new run, not the old one ingested twice, where a run of that candidate is
    being waited for and the file was written after the stored one.
    """
    digest = sha256(data)
    known = [one for one in workspace.store.list() if digest.startswith(one.digest)]
    if not known or not trial.candidate:
        return ""
    waiting = standing_in(workspace).outstanding
    files = log_files(path) if path.is_dir() else [path]
    written = max(file.stat().st_mtime_ns for file in files)
    fresh = written > known[-1].path.stat().st_mtime_ns
    return known[-1].id if fresh and waiting and waiting.id == trial.candidate else ""


def what_repeats(workspace: Folder) -> str:
    """What an exact repeat says: no noise, or a copy where other trials of a candidate differ."""
    ran = [trial for trial in workspace.task_trials() if trial.candidate]
    if scattered([trial.whole(workspace.task.horizon) for trial in ran]):
        return (
            "other trials of one candidate differ, so it looks like a copy, or a program with a "
            "fixed seed: `discard` it and run again"
        )
    taken = "the system is taken as deterministic"
    return f"{taken}, and no candidate is run a second time from now on"
