"""grounded excite: the drive to record first."""

from __future__ import annotations

import click

from grounded.result import with_unit
from grounded_cli.console.options import as_json
from grounded_cli.console.terminal import field, number, progress, show, show_json, table, tell
from grounded_cli.console.workspace_option import in_workspace, next_line, open_workspace


@click.command("excite")
@click.option("--seconds", type=float, help="Its duration (5 to 40, until no parameter is weak).")
@in_workspace
@as_json
def command(seconds: float | None, json_: bool) -> None:
    """Write a drive that makes the model's uncertain parameters identifiable.

    It needs no target: multisines or staircases on all inputs, from [task] start, inside [limits]
    and, by the model, inside [safety]. The table says how well its log will tell each parameter if
    the model is right but for these: `fit` and `diagnose` say how well it did.
    """
    workspace = open_workspace()
    with progress("designing a drive"):
        made = workspace.excite(seconds)
    tell(made.findings)
    if json_:
        show_json(made.to_json())
        return
    drive = made.drive
    long = drive.policy.horizon * drive.policy.dt
    slow, quick = (cycles / long for cycles in drive.cycles)
    held = ", with feedback" if drive.policy.gain is not None else ""
    show(f"Run {made.candidate.id}: {made.file}")
    what = (
        f"{long:g} s, {drive.pattern} of {slow:.2g} to {quick:.2g} Hz, {drive.size:.0%} of limits"
    )
    show(field("what", what + held, "  "))
    for name, values in zip(drive.run.state_names, drive.run.states.T, strict=True):
        unit = made.candidate.units.get(name)
        if unit is not None:
            span = f"{number(values.min())} to {number(values.max())}"
            show(field(name, with_unit(span, unit), "  "))
    rows = [
        [name, with_unit(number(prior.value), prior.unit), number(prior.std), number(after)]
        for name, (prior, after) in made.known.items()
    ]
    show("\n" + table(rows, ["parameter", "value", "+- now", "+- after"]))
    show(f"\n{next_line(made.then)}")
