"""reports/: the files that a report is made of. All of it may be deleted and made again."""

from __future__ import annotations

import json
from pathlib import Path

from grounded.errors import GroundedError
from grounded_trials.report.findings import Findings
from grounded_trials.report.gathering import gather
from grounded_trials.store.store import write_atomically
from grounded_trials.workspace.folder import Workspace

RECORDING, PAGE, OPTIMUM = "recording.rrd", "report.html", "optimum.json"


def save_recording(workspace: Workspace, findings: Findings | None = None) -> Path:
    """reports/recording.rrd for the Rerun viewer."""
    from grounded_trials.report.recording.recording import write_recording

    path = _place(workspace) / RECORDING
    write_recording(findings or gather(workspace), path)
    return path


def save_page(workspace: Workspace, findings: Findings | None = None) -> Path:
    """reports/report.html."""
    from grounded_trials.report.page.page import page

    path = _place(workspace) / PAGE
    write_atomically(path, page(findings or gather(workspace)).encode())
    return path


def save_pictures(workspace: Workspace, findings: Findings | None = None) -> list[Path]:
    """reports/utility.png, paths.png and so on: the figures of the page."""
    from grounded_trials.report.figures.png import png
    from grounded_trials.report.figures.runs import all_figures

    paths = []
    for figure in all_figures(findings or gather(workspace)):
        path = _place(workspace) / f"{figure.name}.png"
        write_atomically(path, png(figure))
        paths.append(path)
    return paths


def save_optimum(workspace: Workspace, utility: float | None) -> None:
    """Leaves the optimum of the real system, where a study knows it, for the report to show."""
    if utility is not None:
        document = json.dumps({"utility": utility}, allow_nan=False)
        write_atomically(_place(workspace) / OPTIMUM, document.encode())


def save(
    workspace: Workspace, findings: Findings, *, html: bool, png: bool, rrd: bool
) -> list[Path]:
    """Writes what was asked for; returns the files."""
    paths = []
    if html:
        paths.append(save_page(workspace, findings))
    if png:
        paths += save_pictures(workspace, findings)
    if rrd:
        paths.append(save_recording(workspace, findings))
    return paths


def _place(workspace: Workspace) -> Path:
    try:
        workspace.reports.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise GroundedError(f"{workspace.reports} can't be made: {error.strerror}") from None
    return workspace.reports
