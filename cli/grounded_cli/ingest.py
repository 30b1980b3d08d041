"""grounded ingest, next: store logs of the real system, and go on from them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import click

from grounded.errors import NextCommand
from grounded.findings import found
from grounded_cli.console import completion as complete
from grounded_cli.console.options import as_json, values_by_name
from grounded_cli.console.options import details as all_findings
from grounded_cli.console.terminal import (
    field,
    number,
    progress,
    show,
    show_json,
    table,
    tell,
)
from grounded_cli.console.workspace_option import in_workspace, next_line, open_workspace
from grounded_trials.wording import extent, with_unit

if TYPE_CHECKING:
    from grounded.model import Model
    from grounded_trials.workspace.intake.ingest import Ingested

FINDINGS_TOLD = 3  # findings that are told without --details
ASIDE = "set aside"  # a verdict


@click.command("ingest")
@click.argument("files", nargs=-1, required=True, metavar="FILE...")
@click.option(
    "--candidate", metavar="ID", shell_complete=complete.candidates, help="Which candidate was run."
)
@click.option("--data", is_flag=True, help="The log ran no candidate: for fit and diagnose only.")
@click.option(
    "--group",
    default="",
    metavar="NAME",
    help="A condition that no signal shows: wet.",
)
@click.option(
    "--before", multiple=True, metavar="U=0", help="An input before a log that begins with a step."
)
@all_findings
@in_workspace
@as_json
def command(
    files: tuple[str, ...],
    candidate: str | None,
    data: bool,
    group: str,
    before: tuple[str, ...],
    details: bool,
    json_: bool,
) -> None:
    """Check, resample and store logs of any format that `inspect` reads.

    Ingesting a file again succeeds and names the trial it is stored as. Trials written by grounded
    are stored unchanged; other logs are mapped by the [log] table (`grounded inspect LOG` prints
    one).
    """
    from pathlib import Path

    from grounded_trials.logs.log_files import logs_in

    workspace = open_workspace()
    held = values_by_name(before, "--before")
    done = []
    for name in (str(log) for file in files for log in logs_in(Path(file))):
        with progress(f"reading {name}"):
            about: Any = {"candidate": candidate, "data": data, "group": group, "before": held}
            done.append(workspace.ingest(name, **about))
        if not json_:
            _tell(name, done[-1], workspace.base_model, details)
    if json_:
        show_json({"trials": [one.to_json() for one in done]})
    else:
        show(f"\n{next_line(done[-1].then)}")


@click.command("next")
@click.argument("log", metavar="LOG")
@click.option(
    "--candidate", metavar="ID", shell_complete=complete.candidates, help="Which candidate was run."
)
@all_findings
@in_workspace
@as_json
def following(log: str, candidate: str | None, details: bool, json_: bool) -> None:
    """Ingest a log, show the verdict, propose, and export for the robot.

    Does the same as `ingest LOG`, `propose` and `export ID --runner`, or `export` in the format in
    which the last candidate was exported; the file is written into the workspace's folder.
    """
    from grounded_cli.propose import tell_proposed

    workspace = open_workspace()
    with progress(f"reading {log} and planning"):
        done = workspace.next(log, candidate=candidate)
    if json_:
        show_json(done.to_json())
        return
    if done.proposed is None:
        _tell(log, done.taken, workspace.base_model, details)
        first = found(
            "search.discard_first", trial=done.taken.trial, candidate=done.taken.candidate
        )
        tell([first], all_=True)
        show(next_line(done.taken.then))
        return
    _tell(log, done.taken, workspace.base_model, details)
    show("")
    tell_proposed(done.proposed, last=done.exported is None)
    if done.removed:
        show(field("removed", ", ".join(map(str, done.removed)), "  "))
    if done.exported is not None:
        files = filter(None, (done.exported.file, done.exported.runner))
        show(field("files", ", ".join(map(str, files)), "  "))
        then = next_line(NextCommand("next", ("LOG",)))
        tell([found("search.to_robot", done.exported.candidate)], all_=True)
        show(then)


def _tell(name: str, one: Ingested, model: Model, details: bool) -> None:
    if one.known:
        show(f"{name}: {one.trial}, stored before")
    tell(one.findings, name, most=len(one.findings) if details else FINDINGS_TOLD)
    if not one.known:
        show(f"{name}: {one.trial}")
    if not one.candidate:
        show(field("data", "for fit and diagnose", "  "))
    else:
        ended = one.utility == float("-inf")
        gained = "no utility" if ended else f"utility {number(one.utility)}"
        if one.runs > 1 and number(one.mean) != number(one.utility) and math.isfinite(one.mean):
            gained += f" (mean of its {one.runs} runs: {number(one.mean)})"
        early = one.verdict == "crashed" and one.then.verb == "discard"
        text = f"{gained}, {'ended early' if early else one.verdict}"
        text = ASIDE if one.verdict == ASIDE and ended else text
        show(field(one.candidate, text, "  "))
    if one.off_target:
        show(field("off target", "; ".join(each.finding.what for each in one.off_target), "  "))
    if one.signals:
        units = {**model.states, **model.inputs}
        rows = [
            (
                s.name,
                f"{s.rate_hz:.1f}",
                f"{1e3 * s.jitter_s:.1f}",
                f"{1e3 * s.largest_gap_s:.0f}",
                "-" if s.skew_s is None else f"{1e3 * s.skew_s:.1f}",
                str(s.bridged),
                with_unit(" .. ".join(f"{v:.3g}" for v in extent(s.low, s.high)), units[s.name]),
            )
            for s in one.signals
        ]
        header = ("signal", "Hz", "jitter ms", "gap ms", "skew ms", "bridged", "range")
        show(table(rows, header))
