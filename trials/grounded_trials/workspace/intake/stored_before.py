"""A recording that is stored already: the same trial, a new run like it, or another reading of it.

One log, or one part of it, is one trial. Read through another [log] it would be a second one that
repeats the first with other numbers, which no diagnosis survives.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from grounded.errors import GroundedError, NextCommand
from grounded.result import listed
from grounded.trial import Trial, scattered
from grounded_trials.logs.log_files import log_files
from grounded_trials.logs.resample import ABSOLUTE_S
from grounded_trials.store.trial_file import read_trial
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.identity import ESTIMATED_WITH, LASTED, StoredTrial, sha256
from grounded_trials.workspace.intake.foreign import ForeignLog
from grounded_trials.workspace.proposing import standing_in

EDGE = 2  # last rows of a cut log, which its end may have changed
LEAST = 10  # rows that two recordings must share to be told as one


def refuse_as_another(path: Path, stored: Sequence[StoredTrial], wanted: str | None) -> None:
    """Refuses a log that is stored as a run of another candidate, or as data.

    Args:
        path: the log.
        stored: the trials that were made from it.
        wanted: the candidate that it is to be a run of, "" for data, None: whatever it was.

    Raises:
        GroundedError: with the trial to discard.
    """
    if not stored or wanted in (None, *(one.trial.candidate for one in stored)):
        return
    identity, as_run = stored[-1].stored.id, stored[-1].trial.candidate
    raise GroundedError(
        f"{path} is stored already, as {identity}, {_what(as_run)}: one log is one trial. To "
        f"have it as {_what(wanted)} instead, discard {identity} first",
        NextCommand("discard", (identity,)),
    )


def _what(candidate: str | None) -> str:
    return f"a run of {candidate}" if candidate else "data"


@dataclass(frozen=True)
class Aside:
    """A trial that was made of a log, and is set aside since."""

    id: str
    candidate: str  # "" for data

    def told(self) -> str:
        """Whose run the log is, and what says otherwise."""
        return (
            f"it was stored before, as {self.id}, {_what(self.candidate)}, which is set aside: it "
            f"is taken for {_what(self.candidate)} again. --candidate ID says otherwise"
        )


def set_aside_of(workspace: Folder, digest: str) -> Aside | None:
    """The last trial that was made of a log, by the hash of its bytes, of those set aside."""
    aside = workspace.discarded()
    for stored in reversed([one for one in workspace.store.list() if one.id in aside]):
        with suppress(GroundedError):  # a damaged one tells nothing
            trial, meta, _ = read_trial(workspace.store.read(stored))
            if meta.get("source_sha256") == digest:
                return Aside(stored.id, trial.candidate or "")
    return None


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
    digest, now = sha256(data), log.source.get(ESTIMATED_WITH, "")
    for one in log.stored:
        same = one.trial.candidate == trial.candidate
        guessed = one.meta.get("estimated", "") if one.meta.get(ESTIMATED_WITH, "") != now else ""
        kept = [name not in guessed.split(",") for name in trial.state_names]
        pairs = (
            (one.measured.states[:, kept], trial.states[:, kept]),
            (one.measured.inputs, trial.inputs),
        )
        if digest.startswith(one.stored.digest):
            return data
        if same and all(np.array_equal(a, b, equal_nan=True) for a, b in pairs):
            return workspace.store.read(one.stored)
    start, end = _span(read_trial(data)[1], trial)
    spans = {one.stored.id: _span(one.meta, one.trial) for one in log.stored}
    names = tuple(name for name, (a, b) in spans.items() if a < end and start < b)
    if not names:
        return data  # another part of a long recording
    raise _read_otherwise(log.path, names)


def estimated_otherwise(workspace: Folder, log: ForeignLog) -> tuple[str, ...]:
    """What to do about trials whose speeds another model estimated; said until the next trial."""
    if (now := log.source.get(ESTIMATED_WITH)) is None:
        return ()
    known = [one for one in workspace.whole_trials() if one.meta.get("estimated")]
    other = [one for one in known if one.meta.get(ESTIMATED_WITH, "") != now]
    if not other or known[-1] is not other[-1]:
        return ()
    names, before = (
        ", ".join(one.stored.id for one in other),
        other[-1].meta.get(ESTIMATED_WITH, ""),
    )
    with_, was = (", ".join(s.split(",")) or "no effect" for s in (now, before))
    return (
        f"{listed(log.source['estimated'].split(','))} is estimated with {with_} in the "
        f"model, in {names} with {was}: to have them alike, `discard` those and ingest their logs "
        "again",
    )


def _read_otherwise(path: Path, names: tuple[str, ...]) -> GroundedError:
    which = names[0] if len(names) == 1 else "them"
    return GroundedError(
        f"{path}: the same recording is stored as {', '.join(names)}, read in another way "
        f"(another [log], [estimate] or [task] dt): discard {which}, then ingest it again",
        NextCommand("discard", names),
    )


def same_recording(
    workspace: Folder, path: Path, data: bytes, log: ForeignLog | None
) -> StoredTrial | None:
    """The stored trial that a file is a copy of, or a part: what is left of a damaged one, say.

    The bytes of the file don't tell. That at the same times of its clock all rows are the same
    does; whole runs whose clock begins at zero may be alike where a simulator repeats itself, in a
    log as long as the other.

    Args:
        workspace: that may have stored it.
        path: the file.
        data: the trial in it, as it would be stored.
        log: which that was read from; None: the file is a trial of ours.

    Raises:
        GroundedError: if it has more of the recording than what is stored.
    """
    trial, meta, _ = read_trial(data)
    begin, end = _span(meta, trial)
    for one in workspace.whole_trials():
        first, last = _span(one.meta, one.measured)
        foreign = "source" in one.meta
        if foreign != (log is not None) or not (first < end and begin < last):
            continue
        here = trial
        if one.meta["start_ns"] != meta["start_ns"]:
            if log is None or (there := _from(log, one)) is None:
                continue
            here = there
        alike = _alike(one, here)
        stamped = first > ABSOLUTE_S  # else every log's clock may begin at zero
        if alike == "none" or (alike == "some" and not stamped):
            continue
        if alike == "some":
            raise _read_otherwise(path, (one.stored.id,))
        if here.finite_steps > one.measured.finite_steps:
            raise GroundedError(
                f"{path}: {one.stored.id} is a part of the same recording, which goes on here: "
                f"discard {one.stored.id}, then ingest it again",
                NextCommand("discard", (one.stored.id,)),
            )
        lasted = one.meta.get(LASTED)
        cut = lasted is not None and log is not None and lasted != log.source[LASTED]
        if stamped or cut or here.finite_steps < one.measured.finite_steps:
            return one
    return None


def _from(log: ForeignLog, one: StoredTrial) -> Trial | None:
    """A log as a trial that begins when a stored one does; None where it can't be cut there."""
    with suppress(GroundedError):
        _, found = log.cut("")
        after = 1e-9 * (int(one.meta["start_ns"]) - found.origin_ns)
        return log.cut(one.trial.candidate or "", after)[0]
    return None


def _alike(one: StoredTrial, here: Trial) -> Literal["all", "some", "none"]:
    """Which signals are the same row by row: all; the inputs and some states, read in another way.

    A signal that stays, and one that was estimated, tells nothing.
    """
    before = one.measured
    names = (before.state_names, before.input_names)
    rows = min(before.finite_steps, here.finite_steps) - EDGE
    if rows < LEAST or names != (here.state_names, here.input_names):
        return "none"
    guessed = one.meta.get("estimated", "").split(",")
    known = [i for i, name in enumerate(here.state_names) if name not in guessed]
    states, inputs = before.states[:rows, known], before.inputs[:rows]
    same = (states == here.states[:rows, known]).all(axis=0)
    telling = np.ptp(states, axis=0) > 0
    if not np.array_equal(inputs, here.inputs[:rows]) or not (same & telling).any():
        return "none"
    return "all" if same.all() else "some"


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
