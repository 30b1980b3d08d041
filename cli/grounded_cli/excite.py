"""grounded excite: the drive to record first."""

from __future__ import annotations

from collections.abc import Iterator

from grounded.result import with_unit
from grounded_cli.console.terminal import field, number, progress, show, table, tell
from grounded_cli.console.workspace import next_line, open_workspace
from grounded_trials.workspace.exciting import Excited


def excite(seconds: float | None) -> Iterator[Excited]:
    """Write the drive to record first."""
    workspace = open_workspace()
    with progress("designing a drive"):
        made = workspace.excite(seconds)
    tell(made.findings)
    yield made
    slow, quick = made.frequencies_hz
    held = ", with feedback" * made.feedback
    show(f"Run {made.candidate}: {made.file}")
    what = f"{made.seconds:g} s, {made.pattern} of {slow:.2g} to {quick:.2g} Hz"
    show(field("what", f"{what}, {made.size:.0%} of limits{held}", "  "))
    run, units = made.drive.run, workspace.base_model.states
    for name, values in zip(run.state_names, run.states.T, strict=True):
        unit = units.get(name)
        if unit is not None:
            span = f"{number(values.min())} to {number(values.max())}"
            show(field(name, with_unit(span, unit), "  "))
    rows = [
        [name, with_unit(number(p["value"]), p["unit"]), number(p["std"]), number(p["std_after"])]
        for name, p in made.parameters.items()
    ]
    show("\n" + table(rows, ["parameter", "value", "+- now", "+- after"]))
    show(f"\n{next_line(made.then)}")
