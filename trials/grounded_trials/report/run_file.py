"""Writes a trial as a table: csv or npz."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from grounded.checks import one_of
from grounded_trials.store.store import write_atomically
from grounded_trials.workspace.candidates.exporting import Exported, format_of
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.identity import unknown_candidate, unknown_trial

FORMATS = ("csv", "npz")


def export_run(
    workspace: Folder, identity: str, form: str | None, path: Path | None, *, runner: bool = False
) -> Exported:
    """Write a trial as csv or npz, see `Workspace.export`."""
    if runner:
        raise unknown_candidate(workspace, identity)
    form = form or format_of(path, FORMATS, "csv")
    one_of("the format of a run", form, FORMATS)
    path = path or Path(f"{identity}.{form}")
    trial = next((one.trial for one in workspace.trials() if one.trial.id == identity), None)
    if trial is None:
        raise unknown_trial(workspace, identity)
    last = np.full((1, trial.inputs.shape[1]), np.nan)  # the last state has no input
    times = trial.dt * np.arange(len(trial.states))[:, None]
    rows = np.hstack([times, trial.states, np.vstack([trial.inputs, last])])
    names, stream = ("t", *trial.state_names, *trial.input_names), io.BytesIO()
    if form == "npz":
        np.savez(stream, **dict(zip(names, rows.T, strict=True)))
    else:
        np.savetxt(stream, rows, fmt="%.10g", delimiter=",", header=",".join(names), comments="")
    write_atomically(path, stream.getvalue())
    return Exported(identity, path, form)
