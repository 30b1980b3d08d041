"""grounded explain: what a code of a finding means."""

from __future__ import annotations

import click

from grounded.findings.catalogue import codes, entry_of
from grounded.refusals import unknown
from grounded_cli.console.options import as_json
from grounded_cli.console.terminal import field, show, show_json


@click.command("explain")
@click.argument("code", required=False, default="")
@as_json
def command(code: str, json_: bool) -> None:
    """Print what a finding's CODE means and what to do about it; without CODE, list all."""
    known = codes()
    if code and code not in known:
        raise unknown("code", code, known)
    chosen = [code] if code else known
    if json_:
        show_json({"findings": {one: vars(entry_of(one)) for one in chosen}})
        return
    for one in chosen:
        entry = entry_of(one)
        show(field(one, f"{entry.weight}: {entry.short}", width=max(len(one), 10)))
        if code and entry.remedy:
            show(field("remedy", entry.remedy))
        if code and entry.hides:
            show(field("hides", ", ".join(entry.hides)))
