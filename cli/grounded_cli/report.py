"""grounded report, view: the trials as text, page, pictures or recording, and its viewer."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from grounded.refusals import refused
from grounded_cli.console.options import exits, json_asked
from grounded_cli.console.terminal import (
    next_line,
    open_workspace,
    progress,
    remark,
    say,
    show,
    sparkline,
    table,
)
from grounded_trials.report.report_text import report_text
from grounded_trials.report.reporting import Report


def report(html: bool, png: bool, rrd: bool) -> Iterator[Report]:
    """Print the report, or write its files."""
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


def view() -> Iterator[Path]:
    """Write the recording and open it."""
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
