"""grounded export: write a candidate for the robot's own program, or the model for a simulator."""

from __future__ import annotations

from pathlib import Path

import click

from grounded.errors import NextCommand
from grounded.findings import found
from grounded_cli.console import completion as complete
from grounded_cli.console.options import anyway, as_json, misuse
from grounded_cli.console.terminal import field, show, show_json, table, tell
from grounded_cli.console.workspace_option import (
    in_workspace,
    next_line,
    open_workspace,
)

FORMATS = ("csv", "npz", "bag", "json")


@click.command("export")
@click.argument("candidate", metavar="ID", required=False, shell_complete=complete.candidates)
@click.option(
    "--format",
    "form",
    type=click.Choice(FORMATS),
    help="Default: by the ending of FILE, without one json; of a trial a bag.",
)
@click.option(
    "-o",
    "--output",
    metavar="FILE",
    help="Default: ID.FORMAT in the current folder, even with -C DIR; `next` writes into DIR.",
)
@click.option(
    "--runner",
    is_flag=True,
    help="Write npz, and beside it grounded_runner.py, which runs it and needs only numpy.",
)
@click.option(
    "--model", is_flag=True, help="Write the model with the values found: MJCF, URDF or model.py."
)
@click.option(
    "--library",
    metavar="FILE.yaml",
    help="Write what is known of one actuator; ID is its input (default: the only one).",
)
@anyway
@in_workspace
@as_json
def command(
    candidate: str | None,
    form: str | None,
    output: str | None,
    runner: bool,
    model: bool,
    library: str | None,
    anyway: bool,
    json_: bool,
) -> None:
    """Write a candidate as csv, npz or json, with units and the time base in the file.

    --format bag writes the predicted run as a ROS 2 bag of standard messages. A trial (t0007) can
    be written as a bag, csv or npz.

    `best` names the best candidate so far. A candidate that must not be run any more (see
    `grounded run`) is refused. One that was run in an earlier task is allowed if it keeps to the
    current [limits] and [safety].

    --model writes the model as it is now, fitted values and adopted effects, in the form that it
    came in; all else of that file stays as it is. --library writes one actuator, from which another
    workspace begins (`grounded init --actuators`).
    """
    for_robot = form or runner or anyway
    if library is not None and not (model or output or for_robot):
        return _library(library, candidate, json_)
    if (candidate is None) != model or library or (model and for_robot):
        raise misuse("ID", "--model", "--library")
    if candidate is None:
        return _model(output, json_)
    named = Path(output or "").suffix.lstrip(".").lower()
    if form is not None and named in FORMATS and named != form:
        raise misuse(f"-o {output}", f"--format {form}")
    done = open_workspace().export(candidate, output, form=form, runner=runner, anyway=anyway)
    tell(done.findings, all_=True)
    if json_:
        show_json(done.to_json())
    else:
        show(f"{done.candidate} is written to {done.file}")
        if done.runner is not None:
            show(field("runner", str(done.runner)))
            then = NextCommand("next", ("LOG", *done.named))
            tell([found("search.to_robot", done.candidate, ended=done.search_ended)], all_=True)
            show(next_line(NextCommand("report", ("--html",)) if done.search_ended else then))


def _model(output: str | None, json_: bool) -> None:
    """Write the model, and tell its values."""
    done = open_workspace().export_model(output)
    tell(done.findings, all_=True)
    if json_:
        return show_json(done.to_json())
    show(f"the model is written to {', '.join(map(str, (done.file, *done.others)))}")
    rows = [(name, f"{one.was:g}", one.text) for name, one in done.values.items()]
    show("\n" + table(rows, ("", "was", "now")) if rows else "  unchanged")


def _library(file: str, actuator: str | None, json_: bool) -> None:
    """Write an actuator, and tell what is known of it."""
    from grounded.diagnosis.parts import Estimate

    done = open_workspace().export_actuator(file, actuator)
    if json_:
        return show_json(done.to_json())
    show(f"{done.actuator} is written to {done.file}\n")
    values = ((key, Estimate(**one).text) for key, one in done.values.items())
    show(table([*values], ("number", "value")))
