"""grounded run: the candidate on the real system of grounded.toml."""

from __future__ import annotations

import click

from grounded_cli import completion as complete
from grounded_cli.options import anyway, as_json, in_workspace, next_line, open_workspace
from grounded_cli.terminal import progress, remark, show, show_json


@click.command("run")
@click.argument("candidate", required=False, shell_complete=complete.candidates)
@anyway
@in_workspace
@as_json
def command(candidate: str | None, anyway: bool, json_: bool) -> None:
    """Run the candidate on [system] and write a trial file for `grounded ingest`.

    CANDIDATE is the outstanding one by default; any candidate, `best` too, may be run again (its
    utilities are averaged). It is refused if its file was rewritten, or if [limits], [safety], the
    task or the model changed so that it must not be run any more.
    """
    workspace = open_workspace()

    def warn(text: str) -> None:
        remark("warning", text)

    with progress(f"running {candidate or 'the candidate'}"):
        ran = workspace.run(candidate, anyway=anyway, warn=warn)
    for note in ran.notes:
        remark("note", note)
    if json_:
        show_json(ran.to_json())
    else:
        show(f"{ran.candidate} was run: {ran.trial_file}")
        show(f"\n{next_line(ran.then)}")
