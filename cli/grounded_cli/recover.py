"""grounded recover: save the readable part of a damaged log."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from grounded.errors import GroundedError, NextCommand
from grounded_cli.console.options import as_json
from grounded_cli.console.terminal import field, progress, say, show, show_json
from grounded_cli.console.workspace_option import next_line, open_workspace
from grounded_trials.wording import count

if TYPE_CHECKING:
    from grounded.errors import NextCommand
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
        show_json(_document(found))
    else:
        _tell(found)
    if not found.complete:
        click.get_current_context().exit(3)


def _document(found: Recovery) -> dict[str, Any]:
    document: dict[str, Any] = {
        "file": str(found.target),
        "messages": dict(found.messages),
        "lost_messages": dict(found.lost_messages),
        "losses": [one.sentence for one in found.losses],
        "findings": [one.to_json() for one in found.losses],
        "unverified": found.unverified,
        "duration_s": found.duration_s,
        "complete": found.complete,
    }
    if _is_trial(found):
        document |= {
            "candidate": found.candidate or None,
            "steps": found.steps,
            "planned_steps": found.planned,
            "hole": found.hole,
        }
    return document


def _tell(found: Recovery) -> None:
    for loss in found.losses:
        say(field("lost", loss.sentence))
    if found.complete:
        show(field("lost", "nothing"))
    saved = count(sum(found.messages.values()), "message")
    show(field("saved", f"{saved} in {found.duration_s:.2f} s: {found.target}"))
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
    planned = f" of {found.planned}" if found.planned is not None else ""
    return f"{found.steps}{planned} steps{ran}{', with a hole' * found.hole}"


def _of_foreign(found: Recovery, target: str) -> NextCommand:
    """Return `ingest` for a log that [log] of this workspace can read, else `inspect`.

    It is data, unless a candidate waits for its trial, which this log may be.
    """
    from grounded_trials.formats.message_path import parse_path
    from grounded_trials.logs.log_table import log_mapping
    from grounded_trials.workspace.candidates.search_state import standing_in

    try:
        workspace = open_workspace()
        model = workspace.base_model
        mapping = log_mapping(workspace.config.log, model.state_names, model.input_names)
        specs = (*mapping.states.values(), *mapping.inputs.values()) if mapping else ()
        if not specs or any(parse_path(one.path).topic not in found.messages for one in specs):
            return NextCommand("inspect", (target,))
        waits = workspace.candidate_ids() and standing_in(workspace).outstanding
    except GroundedError:  # no workspace here, or one that can't be read
        return NextCommand("inspect", (target,))
    return NextCommand("ingest", (target,) if waits else ("--data", target))


def _next(found: Recovery) -> str:
    """Return the lines that say what to do with the file."""
    from grounded_trials.store.own_files import CANDIDATE

    target = str(found.target)
    if found.format == CANDIDATE:
        return next_line(NextCommand("propose"))
    if not _is_trial(found):
        return next_line(_of_foreign(found, target))
    if found.hole:
        return next_line(NextCommand("run", (found.candidate,) if found.candidate else ()))
    short = found.planned is None or found.steps < found.planned
    if found.complete or not (found.candidate and short):
        return next_line(NextCommand("ingest", (target,)))
    return next_line(NextCommand("ingest", ("--data", target)))
