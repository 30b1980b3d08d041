"""grounded explain: what a code of a finding means."""

from __future__ import annotations

import click

from grounded.findings.catalogue import codes, entry_of
from grounded.findings.numbers import bare
from grounded.refusals import unknown
from grounded_cli.console.options import as_json
from grounded_cli.console.terminal import field, show, show_json


@click.command("explain")
@click.argument("code", required=False, default="")
@as_json
def command(code: str, json_: bool) -> None:
    """Print what a finding's CODE means and what to do about it; without CODE, the codes."""
    known = codes()
    if code and code not in known:
        raise unknown("code", code, known)
    chosen = [code] if code else known
    if json_:
        show_json({"findings": {one: vars(entry_of(one)) for one in chosen}})
        return
    for one in chosen:
        entry = entry_of(one)
        said = f": {bare(entry.short)}" if code else ""
        show(field(one, f"{entry.weight}{said}", width=max(*map(len, chosen), 10)))
        if code and entry.remedy:
            show(field("remedy", bare(entry.remedy)))
        if code and entry.hides:
            show(field("hides", ", ".join(entry.hides)))
