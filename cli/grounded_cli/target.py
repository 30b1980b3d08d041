"""grounded target, excite: draw the manoeuvre, or the drive to record first."""

from __future__ import annotations

import math
from collections.abc import Iterator

from grounded.result import listed, with_unit
from grounded_cli.console.options import misuse, values_by_name
from grounded_cli.console.terminal import (
    field,
    next_line,
    number,
    open_workspace,
    progress,
    show,
    table,
    tell,
)
from grounded_trials.starting.drawing import Drawn, Manoeuvre
from grounded_trials.starting.shapes import Drive
from grounded_trials.wording import extent
from grounded_trials.workspace.exciting import Excited

PATHS = ("line", "circle", "figure-8")
OF_SHAPES = {  # the shapes that an option is for
    **dict.fromkeys(("size", "speed", "accel", "hold"), PATHS),
    **dict.fromkeys(("lateral", "laps"), PATHS[1:]),
    "seconds": ("line", "step"),
    "to": (*PATHS, "step"),
    "rest": PATHS[:1],
}


def target(
    shape: str,
    to: tuple[str, ...],
    seconds: float | None,
    rest: bool,
    details: bool,
    **pace: float | None,
) -> Iterator[Drawn]:
    """Draw a target; print what was drawn."""
    for name, shapes in OF_SHAPES.items():
        given = {**pace, "to": to or None, "seconds": seconds, "rest": rest or None}[name]
        if given is not None and shape not in shapes:
            raise misuse(" | ".join(shapes), f"--{name}", how="first")
    paces = {name: value for name, value in pace.items() if value is not None}
    if shape == "line" and seconds is not None and {"speed", "accel"} & paces.keys():
        raise misuse("--seconds", "--speed and --accel")
    ends = values_by_name(to, "--to")
    drawn = open_workspace().draw(Manoeuvre(shape, Drive(**paces), ends, seconds, rest))
    yield drawn
    _tell(drawn, shape, details=details)


def _tell(drawn: Drawn, shape: str, *, details: bool) -> None:
    """Print what was drawn: duration, ranges, what is free and weighed; then the findings."""
    show(f"{drawn.path}: {shape}, {drawn.horizon * drawn.dt:.4g} s, {drawn.horizon} steps")
    fastest, tightest = drawn.driven
    if math.isfinite(tightest):
        show(field("driven", f"at up to {fastest:.3g} m/s, turning radius {tightest:.3g} m", "  "))
    for name, span in drawn.ranges.items():
        low, high = extent(*span)
        text = f"{number(low)} to {number(high)}" if low < high else f"stays at {number(low)}"
        show(field(name, with_unit(text, drawn.units[name]), "  "))
    if drawn.free:
        show(field("free", listed(drawn.free), "  "))
    for kind, weights in drawn.weights.items():
        text = ", ".join(f"{name} = {number(weight)}" for name, weight in weights.items())
        show(field("weights", f"[reward] {kind}: {text}", "  "))
    tell(drawn.findings, all_=details)
    show(f"\n{next_line(drawn.then)}")


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
