"""grounded recover: save the readable part of a damaged log."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from grounded.errors import NextCommand
from grounded_cli.console.options import exits
from grounded_cli.console.terminal import field, progress, say, show
from grounded_cli.console.workspace import next_line
from grounded_trials.logs.recover import Recovery, recover_log
from grounded_trials.store.own_files import CANDIDATE, TRIAL
from grounded_trials.wording import count


def recover(log: str, output: str | None) -> Iterator[Recovery]:
    """Save the readable part of a damaged log."""
    source = Path(log)
    target = Path(output) if output else source.with_name(f"{source.stem}-recovered.mcap")
    with progress(f"reading {log}"):
        found = recover_log(source, target)
    exits(0 if found.complete else 3)
    yield found
    for loss in found.losses:
        say(field("lost", loss))
    if found.complete:
        show(field("lost", "nothing"))
    saved = count(sum(found.messages.values()), "message")
    show(field("saved", f"{saved} in {found.duration_s:.2f} s: {found.file}"))
    for topic, number in found.messages.items():
        lost = found.lost_messages.get(topic, 0)
        show(f"  {topic}: {number}" + (f", {lost} lost" if lost else ""))
    show(f"\n{next_line(_next(found))}")


def _next(found: Recovery) -> NextCommand:
    """Return what to do with the file."""
    target = str(found.file)
    if found.format == CANDIDATE:
        return NextCommand("propose")
    if found.format != TRIAL:
        return NextCommand("inspect", (target,))  # which says how it is ingested
    whole = all(one.facts.get("index") for one in found.findings)
    return NextCommand("ingest", (target,) if whole else ("--data", target))
