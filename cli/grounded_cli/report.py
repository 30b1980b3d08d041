"""grounded report, view: the trials as text, page, pictures or recording, and its viewer."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from grounded.refusals import refused
from grounded_cli.console.options import command, exits, flag, json_asked
from grounded_cli.console.terminal import progress, remark, say, show, sparkline, table
from grounded_cli.console.workspace_option import next_line, open_workspace
from grounded_trials.report.report_text import report_text
from grounded_trials.report.reporting import Report


@command("report")
@flag("--html", help="Write reports/report.html, one page with everything.")
@flag("--png", help="Write the page's figures as pictures, reports/*.png.")
@flag("--rrd", help="Write reports/recording.rrd for the Rerun viewer.")
def report(html: bool, png: bool, rrd: bool) -> Iterator[Report]:
    """Show utilities, trajectories, bias and gap of all stored trials.

    A damaged or missing trial is left out and named (exit code 3).
    """
    with progress("reading trials"):
        report = open_workspace().report(html=html, png=png, rrd=rrd)
    exits(3 if report.findings.lost else 0)
    for one in report.findings.lost if report.paths or json_asked() else ():
        remark("left out", f"{one.file}: {one.reason}")
    yield report
    if not report.paths:
        return show(report_text(report.findings, table, sparkline))
    for path in report.paths:
        show(str(path))
    show(f"\n{next_line(report.findings.then)}")


@command("view", json=False)
def view() -> Iterator[Path]:
    """Open the recording in the Rerun viewer: paths, states, inputs, bias, trial by trial.

    The file reports/recording.rrd is written first. If this machine has no screen, copy the file to
    one that has (with the extra `view`) and open it there: rerun recording.rrd
    """
    with progress("writing the recording"):
        path = open_workspace().report(rrd=True).paths[-1]
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
