"""grounded recover: save the readable part of a damaged log."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from grounded.errors import NextCommand
from grounded_cli.console.options import as_json
from grounded_cli.console.terminal import field, progress, say, show, show_json
from grounded_cli.console.workspace_option import next_line
from grounded_trials.wording import count

if TYPE_CHECKING:
    from grounded_trials.logs.recover import Recovery


@click.command("recover")
@click.argument("log", metavar="LOG")
@click.option("-o", "--output", metavar="FILE", help="Default: LOG with -recovered in its name.")
@as_json
def command(log: str, output: str | None, json_: bool) -> None:
    """Recover what is readable in a damaged MCAP file; exit with 3 if something was lost.

    The damaged file is not changed.
    """
    from grounded_trials.logs.recover import recover_log

    source = Path(log)
    target = Path(output) if output else source.with_name(f"{source.stem}-recovered.mcap")
    with progress(f"reading {log}"):
        found = recover_log(source, target)
    if json_:
        show_json(found.to_json())
    else:
        _tell(found)
    if not found.complete:
        click.get_current_context().exit(3)


def _tell(found: Recovery) -> None:
    for loss in found.losses:
        say(field("lost", loss))
    if found.complete:
        show(field("lost", "nothing"))
    saved = count(sum(found.messages.values()), "message")
    show(field("saved", f"{saved} in {found.duration_s:.2f} s: {found.file}"))
    for topic, number in found.messages.items():
        lost = found.lost_messages.get(topic, 0)
        show(f"  {topic}: {number}" + (f", {lost} lost" if lost else ""))
    if found.unverified:
        show(field("unchecked", count(found.unverified, "message")))
    if _is_trial(found):
        show(field("trial", _steps(found)))
    show(f"\n{_next(found)}")


def _is_trial(found: Recovery) -> bool:
    from grounded_trials.store.own_files import TRIAL

    return found.format == TRIAL


def _steps(found: Recovery) -> str:
    """Describe how much of a trial written by grounded is left."""
    ran = f" of {found.candidate}" * bool(found.candidate)
    planned = f" of {found.planned_steps}" if found.planned_steps is not None else ""
    return f"{found.steps}{planned} steps{ran}{', with a hole' * bool(found.hole)}"


def _next(found: Recovery) -> str:
    """Return the lines that say what to do with the file."""
    from grounded_trials.store.own_files import CANDIDATE

    target = str(found.file)
    if found.format == CANDIDATE:
        return next_line(NextCommand("propose"))
    if not _is_trial(found):
        return next_line(NextCommand("inspect", (target,)))  # which says how it is ingested
    if found.hole:
        return next_line(NextCommand("run", (found.candidate,) if found.candidate else ()))
    short = found.planned_steps is None or (found.steps or 0) < found.planned_steps
    if found.complete or not (found.candidate and short):
        return next_line(NextCommand("ingest", (target,)))
    return next_line(NextCommand("ingest", ("--data", target)))
