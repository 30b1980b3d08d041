"""grounded report, view: the trials as text, page, pictures or recording, and its viewer."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

from grounded.errors import NextCommand
from grounded.refusals import refused
from grounded.search.pictures import few
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
from grounded_trials.report.findings import Findings
from grounded_trials.report.reporting import Report
from grounded_trials.report.tables import about, counted, error_table, improved
from grounded_trials.wording import folded, rendered, wrapped
from grounded_trials.workspace.next_step import DIAGNOSE

ROWS = 15  # candidates in the table; others are counted


def report(html: bool, png: bool, rrd: bool) -> Iterator[Report]:
    """Print the report, or write its files."""
    with progress("reading trials"):
        report = open_workspace().report(html=html, png=png, rrd=rrd)
    exits(3 if report.findings.lost else 0)
    for one in report.findings.lost if report.paths or json_asked() else ():
        remark("left out", f"{one.file}: {one.reason}")
    yield report
    if not report.paths:
        return show(report_text(report.findings))
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


def report_text(findings: Findings) -> str:
    """Return the whole report."""
    now, history = findings.standing, findings.history

    # the task, its trials, and what became better
    head = [f"{findings.name}: {about(findings)}", "; ".join(counted(findings))]
    if findings.effects:
        head.append(f"adopted: {', '.join(findings.effects)}")
    lines = [line for text in head for line in wrapped(text, "", "  ")]
    lines += ["", *_indented(f"{value}: {what}" for value, what in improved(findings))]

    # the candidates
    if history:
        kept, left = few(history, ROWS)
        lines += ["", table([now.row(one) for one in kept], now.table()[1])]
        more = f"({left} more: {rendered(NextCommand('status'), findings.folder)})"
        spark = sparkline([tried.utility for tried in history if tried.utilities])
        lines += _indented(filter(None, (more * bool(left), spark)))
    lines += _indented([f"{now.outcome}: {now.sentence}"])

    # errors by state, and what was diagnosed
    errors = error_table(findings)
    if errors.rows:
        lines += ["", table(errors.rows, errors.header)]
    gap = findings.lines or [rendered(DIAGNOSE, findings.folder)]
    lines += ["", "gap to the model", *_indented(gap)]
    if (said := findings.told) is not None and said.rows:
        lines += ["", table(said.rows, said.header)]
    if findings.lost:
        lines += ["", "left out", *_indented(f"{one.file}: {one.reason}" for one in findings.lost)]
    return "\n".join([*lines, "", folded(rendered(findings.then, findings.folder))])


def _indented(texts: Iterable[str]) -> list[str]:
    return [line for text in texts for line in wrapped(text, "  ", "    ")]
