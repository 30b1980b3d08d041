"""grounded report: what the trials as text, page, pictures and recording."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from grounded_cli.address import addressed
from grounded_cli.options import as_json, in_workspace, open_workspace
from grounded_cli.terminal import progress, remark, show, show_json, sparkline, table
from grounded_trials.wording import folded

if TYPE_CHECKING:
    from grounded_trials.report.findings import Findings
    from grounded_trials.workspace.folder import Workspace


@click.command("report")
@click.option("--html", is_flag=True, help="Write reports/report.html, one page with everything.")
@click.option("--png", is_flag=True, help="Write the page's figures as pictures, reports/*.png.")
@click.option("--rrd", is_flag=True, help="Write reports/recording.rrd for the Rerun viewer.")
@in_workspace
@as_json
def command(html: bool, png: bool, rrd: bool, folder: str | None, json_: bool) -> None:
    """Show utilities, trajectories, bias and gap of all stored trials.

    A damaged or missing trial is left out and named (exit code 3).
    """
    workspace = open_workspace(folder)
    from grounded_trials.report.gathering import gather
    from grounded_trials.report.report_text import report_text
    from grounded_trials.report.reporting import save

    with progress("reading trials"):
        findings = gather(workspace)
    with progress("writing"):
        paths = save(workspace, findings, html=html, png=png, rrd=rrd)
    if json_:
        show_json(as_document(findings, paths))
    elif paths:
        for path in paths:
            show(str(path))
        show(f"\n{folded(findings.next_command)}")
    else:
        show(report_text(findings, table, sparkline))
    if findings.lost:
        for one in findings.lost if paths or json_ else ():
            remark("left out", f"{one.file}: {one.reason}")
        click.get_current_context().exit(3)


def write_all(workspace: Workspace) -> dict[str, str]:
    """The page, and the recording where rerun is installed; their files by kind."""
    from importlib.util import find_spec

    from grounded_trials.report.gathering import gather
    from grounded_trials.report.reporting import save

    rrd = find_spec("rerun") is not None
    paths = save(workspace, gather(workspace), html=True, png=False, rrd=rrd)
    if not rrd:
        remark("note", "no recording was written: pip install 'grounded[view]' brings the viewer")
    return {path.suffix[1:]: str(path) for path in paths}


def as_document(findings: Findings, paths: list[Any]) -> dict[str, Any]:
    """The fields of CONTRACT.md, and the figures of the text by state and input."""
    from grounded_trials.report.findings import prediction_error, rms, tracking_error

    task, names = findings.task, findings.task.model.state_names
    runs = {"model_policy": findings.first, "best": findings.best}
    document: dict[str, Any] = {
        "paths": {path.suffix[1:]: str(path) for path in paths if path.suffix != ".png"},
        "utilities": findings.standing.utilities,
        "phase": findings.standing.phase,
        "sentence": findings.standing.sentence,
        "optimum": findings.optimum,
        "lost": [vars(one) for one in findings.lost],
        "next": addressed(findings.next_command),
    }
    pictures = [str(path) for path in paths if path.suffix == ".png"]
    if pictures:
        document["paths"]["png"] = pictures
    for key, run in runs.items():
        if run is None:
            document[key] = None
            continue
        measures = {
            "tracking_error": rms(tracking_error(task, run.trial)),
            "prediction_error": rms(prediction_error(task, run)),
            "bias_rate": rms(run.residual) / task.dt,
        }
        document[key] = {"candidate": run.candidate.id, "utility": run.utility} | {
            name: dict(zip(names, map(float, values), strict=True))
            for name, values in measures.items()
        }
    diagnosis = findings.diagnosis
    if diagnosis is not None:
        verdict = {"kind": diagnosis.kind, "effects": diagnosis.effects}
        document["verdict"] = verdict | {"sentence": diagnosis.sentence}
        document["outdated"] = findings.since.sentence or None
    return document
