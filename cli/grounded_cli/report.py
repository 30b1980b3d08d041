"""grounded report, view: the trials as text, page, pictures or recording, and its viewer."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from grounded.errors import GroundedError
from grounded.refusals import refused
from grounded_cli.console.options import command, exits, flag, json_asked
from grounded_cli.console.terminal import number, progress, remark, say, show, sparkline, table
from grounded_cli.console.workspace_option import next_line, open_workspace
from grounded_trials import Workspace
from grounded_trials.report.report_text import report_text
from grounded_trials.report.reporting import Report, save_recording
from grounded_trials.wording import count


@command("report")
@flag("--html", help="Write reports/report.html, one page with everything.")
@flag("--png", help="Write the page's figures as pictures, reports/*.png.")
@flag("--rrd", help="Write reports/recording.rrd for the Rerun viewer.")
@flag("--watch", help="Write the page again whenever a trial comes in.")
def report(html: bool, png: bool, rrd: bool, watch: bool) -> Iterator[Report | dict[str, Any]]:
    """Show utilities, trajectories, bias and gap of all stored trials.

    A damaged or missing trial is left out and named (exit code 3). With --watch the page stays
    current beside `learn` or a session at the track, until Ctrl-C; in a browser it reloads itself.
    """
    workspace = open_workspace()
    if watch:
        return _watch(workspace)
    with progress("reading trials"):
        report = workspace.report(html=html, png=png, rrd=rrd)
    exits(3 if report.findings.lost else 0)
    for one in report.findings.lost if report.paths or json_asked() else ():
        remark("left out", f"{one.file}: {one.reason}")
    yield report
    if not report.paths:
        return show(report_text(report.findings, table, sparkline))
    for path in report.paths:
        show(str(path))
    show(f"\n{next_line(report.findings.then)}")


def _watch(workspace: Workspace) -> None:
    """Report each time that the page was written, or why it could not be, until Ctrl-C."""

    def trouble(error: GroundedError) -> None:
        remark("waiting", str(error))

    try:
        for report in workspace.watch(trouble=trouble):
            (path,), findings = report.paths, report.findings
            best = findings.best
            known = "" if best is None else f", best {best.candidate.id} {number(best.utility)}"
            trials = count(len(findings.runs) + findings.left_runs, "trial")
            show(f"{path}: {trials}{known}")
    except KeyboardInterrupt:
        say("stopped")


@command("view", json=False)
def view() -> Iterator[Path]:
    """Open the recording in the Rerun viewer: paths, states, inputs, bias, trial by trial.

    The file reports/recording.rrd is written first. If this machine has no screen, copy the file to
    one that has (with the extra `view`) and open it there: rerun recording.rrd
    """
    with progress("writing the recording"):
        path = save_recording(open_workspace())
    yield path
    if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ):
        raise refused("run.viewer", path, screen=True)
    beside = Path(sys.executable).with_name("rerun")
    program = str(beside) if beside.exists() else shutil.which("rerun")
    if program is None:
        raise refused("run.viewer", path, missing=True)
    # A new viewer, bound to this machine only: by default it listens on every address.
    words = [program, "--new", "--bind", "127.0.0.1", str(path)]
    viewer = subprocess.Popen(words, stdout=2, start_new_session=True)
    try:
        code = viewer.wait(timeout=2.0)
    except subprocess.TimeoutExpired:
        viewer.returncode = 0  # it keeps running: Popen must not warn about it
        return say(f"{path} is open")
    if code != 0:
        raise refused("run.viewer", path, exit=code)
