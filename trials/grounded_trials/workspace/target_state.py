"""Whether a manoeuvre was drawn, or target.csv is still what `init` wrote."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from grounded.errors import GroundedError, NextCommand
from grounded_trials.workspace.folder import Folder

PROPOSE = NextCommand("propose")
TARGET = NextCommand("target", ("SHAPE",))
WRITTEN = 1e-3  # tolerance for target.csv, relative to its range, due to the digits in the file


def to_plan(workspace: Folder) -> NextCommand:
    """Return `propose`, or `target` if no candidate was made and no manoeuvre was drawn yet."""
    return TARGET if undrawn(workspace) else PROPOSE


def undrawn(workspace: Folder) -> bool:
    """Return whether no candidate was made and target.csv is still what `init --from` wrote.

    That is the run in the log, or, if the log could not be sampled, zeros for the first state only,
    with a start at zero.
    """
    task = workspace.config.task
    with suppress(GroundedError):  # `propose` reports an unreadable target
        if not task.target or workspace.candidate_ids():
            return False
        first, *others = np.asarray(workspace.task.target, float).T
        if first.any() or not all(np.isnan(column).all() for column in others):
            return bool(logged_target(workspace))
        return not task.start.get(workspace.base_model.state_names[0])
    return False


def logged_target(workspace: Folder) -> str:
    """Return the trial whose states target.csv still repeats, as `init --from` wrote it; or "".

    Only trials that ran no candidate count, also those that are set aside: a log in a wrong unit is
    ingested again, but target.csv is the run as it was first read. The target must equal their
    states row by row.
    """
    if not workspace.config.task.target:
        return ""
    task = workspace.task
    asked = np.isfinite(task.target).any(axis=0)
    for trial in (one.trial for one in (*workspace.whole_trials(), *workspace.aside_trials())):
        rows = len(task.target)
        if trial.candidate or trial.steps + 1 < rows or not workspace.fits(trial):
            continue
        off = np.abs(trial.states[:rows, asked] - task.target[:, asked])
        moved = np.ptp(task.target[:, asked], axis=0).max(initial=0.0)
        if moved > 0 and off.size and np.nanmax(off) < WRITTEN * moved:
            return trial.id
    return ""


def still_logged(workspace: Folder) -> bool:
    """Return whether the target of a workspace made from a log is still the run in that log.

    If that log was not ingested, there is no trial to compare with. Then the target is the log's
    until `target` replaces it, which keeps the old one as .bak.
    """
    if any(not stored.trial.candidate for stored in workspace.whole_trials()):
        return bool(logged_target(workspace))
    return not (workspace.folder / f"{workspace.config.task.target}.bak").exists()
