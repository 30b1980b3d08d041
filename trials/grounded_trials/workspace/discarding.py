"""Set trials aside, and choose the command to type next.

A log in a wrong unit is ingested again once [log] is corrected; after a run the search says what is
next, usually to run its candidate again.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from grounded.errors import GroundedError, NextCommand
from grounded.trial import interpolate_gaps
from grounded_trials.logs.log_files import log_files
from grounded_trials.store.trial_file import read_trial
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.identity import SetAside, set_aside
from grounded_trials.workspace.proposing import standing_in, status_of


def discard_in(workspace: Folder, trials: Sequence[str], why: str) -> SetAside:
    """Record that trials were discarded, see `Workspace.discard`."""
    done = set_aside(workspace, "discard", trials, why)
    with suppress(GroundedError):  # of files that are damaged: `status` names them
        if then := _instead(workspace, done.trials[-1]):
            return replace(done, then=then)
    return done


def _instead(workspace: Folder, name: str) -> NextCommand | None:
    """Return the command to type after a trial was discarded; None if `status` has to show it."""
    from grounded_trials.workspace.intake.remarks.log_faults import log_faults

    stored = workspace.store.find(name)
    trial, meta, _ = read_trial(workspace.store.read(stored), stored.path.name)
    if not workspace.fits(trial):
        return None
    faults = log_faults(workspace, interpolate_gaps(trial).trial) if "source" in meta else ()
    if any(one.mend for one in faults):
        what = ("--candidate", trial.candidate) if trial.candidate else ("--data",)
        return NextCommand("ingest", (_found(workspace, meta), *what))
    return status_of(workspace, standing_in(workspace)).then if trial.candidate else None


def _found(workspace: Folder, meta: Mapping[str, str]) -> str:
    """Return the path of a trial's log if it is in or beside a folder in use, else LOG."""
    from grounded_trials.workspace.intake.opening.foreign import hashed

    name, home = Path(meta["source"]).name, workspace.folder.resolve()
    for folder in (Path.cwd(), home, home.parent):
        with suppress(GroundedError, OSError, ValueError):  # its name may be none
            if hashed(log_files(folder / name)) == meta.get("source_sha256"):
                return os.path.relpath(folder / name)
    return "LOG"
