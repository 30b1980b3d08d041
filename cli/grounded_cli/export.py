"""grounded export: write a candidate for the robot's own program, or the model for a simulator."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from grounded.diagnosis.parts import Estimate
from grounded.errors import NextCommand
from grounded.findings import found
from grounded_cli.console.options import misuse
from grounded_cli.console.terminal import field, next_line, open_workspace, show, table, tell
from grounded_trials.workspace.candidates.exporting import Exported
from grounded_trials.workspace.home.library import Shelved
from grounded_trials.workspace.home.taking_home import TakenHome

FORMATS = ("csv", "npz", "json")


def export(
    candidate: str | None,
    form: str | None,
    output: str | None,
    runner: bool,
    model: bool,
    library: str | None,
    anyway: bool,
) -> Iterator[Exported | Shelved | TakenHome]:
    """Write a candidate, a trial, the model, or an actuator."""
    for_robot = form or runner or anyway
    if library is not None and not (model or output or for_robot):
        shelved = open_workspace().export_actuator(library, candidate)
        yield shelved
        show(f"{shelved.actuator} is written to {shelved.file}\n")
        values = ((key, Estimate(**one).text) for key, one in shelved.values.items())
        return show(table([*values], ("number", "value")))
    if (candidate is None) != model or library or (model and for_robot):
        raise misuse("ID", "--model", "--library")
    if candidate is None:
        home = open_workspace().export_model(output)
        tell(home.findings, all_=True)
        yield home
        show(f"the model is written to {', '.join(map(str, (home.file, *home.others)))}")
        rows = [(name, f"{one.was:g}", one.text) for name, one in home.values.items()]
        return show("\n" + table(rows, ("", "was", "now")) if rows else "  unchanged")
    named = Path(output or "").suffix.lstrip(".").lower()
    if form is not None and named in FORMATS and named != form:
        raise misuse(f"-o {output}", f"--format {form}")
    done = open_workspace().export(candidate, output, form=form, runner=runner, anyway=anyway)
    tell(done.findings, all_=True)
    yield done
    show(f"{done.candidate} is written to {done.file}")
    if done.runner is not None:
        show(field("runner", str(done.runner)))
        then = NextCommand("next", ("LOG", *done.named))
        tell([found("search.to_robot", done.candidate, ended=done.search_ended)], all_=True)
        show(next_line(NextCommand("report", ("--html",)) if done.search_ended else then))
