"""grounded report: the trials as text, page, pictures and recording."""

from __future__ import annotations

import click

from grounded_cli.options import as_json, in_workspace, next_line, open_workspace
from grounded_cli.terminal import progress, remark, show, show_json, sparkline, table


@click.command("report")
@click.option("--html", is_flag=True, help="Write reports/report.html, one page with everything.")
@click.option("--png", is_flag=True, help="Write the page's figures as pictures, reports/*.png.")
@click.option("--rrd", is_flag=True, help="Write reports/recording.rrd for the Rerun viewer.")
@in_workspace
@as_json
def command(html: bool, png: bool, rrd: bool, json_: bool) -> None:
    """Show utilities, trajectories, bias and gap of all stored trials.

    A damaged or missing trial is left out and named (exit code 3).
    """
    workspace = open_workspace()
    with progress("reading trials"):
        report = workspace.report(html=html, png=png, rrd=rrd)
    if json_:
        show_json(report.to_json())
    elif report.paths:
        for path in report.paths:
            show(str(path))
        show(f"\n{next_line(report.findings.then)}")
    else:
        from grounded_trials.report.report_text import report_text

        show(report_text(report.findings, table, sparkline))
    if report.findings.lost:
        for one in report.findings.lost if report.paths or json_ else ():
            remark("left out", f"{one.file}: {one.reason}")
        click.get_current_context().exit(3)
