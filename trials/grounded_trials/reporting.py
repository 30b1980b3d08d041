"""reports/: the files that a report is made of. All of it may be deleted and made again."""

from __future__ import annotations

from pathlib import Path

from grounded.errors import GroundedError
from grounded_trials.findings import Findings
from grounded_trials.gathering import gather
from grounded_trials.workspace import Workspace

RECORDING, PAGE = "recording.rrd", "report.html"


def save_recording(workspace: Workspace, findings: Findings | None = None) -> Path:
    """reports/recording.rrd for the Rerun viewer."""
    from grounded_trials.recording import write_recording

    path = _place(workspace) / RECORDING
    write_recording(findings or gather(workspace), path)
    return path


def save(
    workspace: Workspace, findings: Findings, *, html: bool, png: bool, rrd: bool
) -> list[Path]:
    """Writes what was asked for; returns the files."""
    paths = []
    if html:
        raise GroundedError("the page is not written yet")
    if png:
        raise GroundedError("pictures are not written yet")
    if rrd:
        paths.append(save_recording(workspace, findings))
    return paths


def _place(workspace: Workspace) -> Path:
    try:
        workspace.reports.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise GroundedError(f"{workspace.reports} can't be made: {error.strerror}") from None
    return workspace.reports
