"""Detect recordings that are stored already: the same trial, or another reading of it.

One log, or one part of it, is one trial. Read through another [log] it would become a second trial
that repeats the first with other numbers, which would invalidate any diagnosis.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from grounded.checks import refused
from grounded.errors import NextCommand
from grounded.trial import Trial
from grounded_trials.store.trial_file import read_trial
from grounded_trials.workspace.candidates.search_state import standing_in
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.identity import ESTIMATED_WITH, StoredTrial, sha256
from grounded_trials.workspace.next_step import to_run

if TYPE_CHECKING:
    from grounded_trials.workspace.intake.opening.foreign import ForeignLog


def refuse_as_another(
    workspace: Folder, path: Path, stored: Sequence[StoredTrial], wanted: str | None
) -> None:
    """Refuse a log that is stored as a run of another candidate, or as data."""
    ran = [one.trial.candidate for one in stored]
    if not ran or wanted in ran or (wanted is None and ran[-1]):
        return
    now, identity = standing_in(workspace), stored[-1].stored.id
    waits = now.outstanding.id if now.outstanding else ""
    then = NextCommand("discard", (identity,))
    if wanted is None and waits:  # the log of data was most likely passed by mistake
        then = to_run(workspace, waits)
    used = ran[-1] or "data"
    raise refused("log.stored", path, trial=identity, used=used, waits=waits, then=then)


def as_stored(workspace: Folder, log: ForeignLog, trial: Trial, data: bytes) -> bytes:
    """Return the stored file of a log's trial, else the new one; refuse it with other numbers."""
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
    raise refused("log.stored", log.path, trial=names, other=1, then=NextCommand("discard", names))


def _span(meta: Mapping[str, str], trial: Trial) -> tuple[float, float]:
    """Return the start and the end of a trial on its log's clock [s]."""
    start = int(meta["start_ns"]) * 1e-9
    return start, start + trial.steps * trial.dt
