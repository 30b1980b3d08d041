"""grounded recover: what can be saved of a damaged log."""

from __future__ import annotations

from pathlib import Path

import click

from grounded_cli.options import as_json
from grounded_cli.terminal import progress, say, show, show_json


@click.command("recover")
@click.argument("log", metavar="LOG")
@click.option("-o", "--output", metavar="FILE", help="Default: LOG with -recovered in its name.")
@as_json
def command(log: str, output: str | None, json_: bool) -> None:
    """Save what can be saved of a damaged MCAP file; exit 3 when something was lost.

    The damaged file is not changed.
    """
    from grounded_trials.recover import recover_log

    source = Path(log)
    target = Path(output) if output else source.with_name(f"{source.stem}-recovered.mcap")
    with progress(f"reading {log}"):
        found = recover_log(source, target)
    saved = sum(found.messages.values())
    if json_:
        show_json(
            {
                "file": str(found.target),
                "messages": dict(found.messages),
                "lost_messages": dict(found.lost_messages),
                "losses": list(found.losses),
                "unverified": found.unverified,
                "complete": found.complete,
            }
        )
    else:
        for loss in found.losses:
            say(f"lost: {loss}")
        show(f"{saved} messages are saved in {found.target}")
        for topic, count in found.messages.items():
            lost = found.lost_messages.get(topic, 0)
            show(f"  {topic}: {count}" + (f", {lost} lost" if lost else ""))
        if found.unverified:
            show(f"  {found.unverified} of them carry no checksum that could vouch for them")
    if not found.complete:
        click.get_current_context().exit(3)
