"""Read a foreign log through [log], and cut the trial from it where its run begins."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

from grounded.errors import GroundedError
from grounded.findings import Finding
from grounded_trials.formats.text_tables import about_table
from grounded_trials.logs.log_files import log_files
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.identity import INTERPOLATED, ROWS
from grounded_trials.workspace.intake.opening.foreign import (
    ForeignLog,
    begun,
    mapping_of,
    misread,
    read_foreign,
)
from grounded_trials.workspace.intake.opening.reading import (
    Read,
    about,
    check_candidate,
    encode,
    outstanding,
)
from grounded_trials.workspace.intake.opening.stored_before import (
    refuse_as_another,
    refuse_known_data,
    set_aside_of,
)
from grounded_trials.workspace.where_to_mend import twice_in_time

SLIGHT = 0.002  # of a control step, by which interpolated states may be early


def read_log_file(
    workspace: Folder,
    path: Path,
    candidate: str | None,
    data: bool,
    sent_before: Mapping[str, float] = MappingProxyType({}),
) -> Read:
    """Read a foreign log through [log]; `sent_before`: inputs' values until their first samples.

    Raises:
        GroundedError: if it can't be mapped or sampled, if no candidate is outstanding, or if [log]
            removes a delay that the model has as well.
    """
    if twice := twice_in_time(workspace):
        raise GroundedError(twice)
    log = read_foreign(workspace, path, mapping_of(workspace, path).since(sent_before))
    ran = candidate or (log.stored[-1].trial.candidate if log.stored else "")
    refuse_as_another(workspace, path, log.stored, "" if data else candidate)
    if not (data or ran):
        refuse_known_data(workspace, path, log.stored, None)
    before = None if data or ran else set_aside_of(workspace, log.source["source_sha256"])
    if before and before.candidate in workspace.candidate_ids():
        ran = before.candidate
    chosen = "" if data else ran or outstanding(workspace, path)
    if chosen:
        refuse_as_another(workspace, path, log.stored, chosen)
        check_candidate(workspace, path, chosen)
    read = cut_log(log, chosen)
    return replace(read, before=before) if before and chosen == ran else read


def cut_log(log: ForeignLog, candidate: str, start: float | None = None) -> Read:
    """Cut the trial from a log, from `start` [s] on; None: from [log.span] or the first command."""
    trial, grid = log.cut(candidate, start)
    facts = about(log.workspace, candidate) | log.source
    facts |= {ROWS: f"{grid.row_s:.6g}"} if grid.row_s and not candidate else {}
    early = grid.interpolated_s / trial.dt > SLIGHT
    facts |= {INTERPOLATED: f"{grid.interpolated_s:.3g}"} if early else {}
    encoded = encode(log.workspace, trial, facts, grid.start_ns)
    remarks = [one for file in log_files(log.path) for one in about_table(file).findings]
    return Read(
        trial,
        encoded,
        (
            *misread(log),
            *log.unlike_units,
            *log.unread,
            *remarks,
            *grid.findings,
            *(() if candidate else begun(grid, trial.dt, trial.input_names)),
        ),
        grid.reports,
        log=log,
        cut=grid,
        last_s=(grid.last_ns - grid.start_ns) * 1e-9,
    )


def cut_short(read: Read, steps: int, fell: Finding | None = None) -> Read:
    """Cut a run in a foreign log after `steps`, where it failed, if it is longer."""
    if read.log is None or read.cut is None or read.trial.steps <= steps:
        return read
    trial, workspace = read.trial.until(steps), read.log.workspace
    facts = about(workspace, trial.candidate) | read.log.source
    data = encode(workspace, trial, facts, read.cut.start_ns)
    return replace(read, trial=trial, data=data).telling(*([fell] if fell else []))
