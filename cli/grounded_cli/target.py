"""grounded target: draw the manoeuvre that the states are to follow."""

from __future__ import annotations

import math
from collections.abc import Iterator

from grounded.result import listed
from grounded_cli.console.options import misuse, values_by_name
from grounded_cli.console.terminal import field, number, show, tell
from grounded_cli.console.workspace import next_line, open_workspace
from grounded_trials.starting.drawing import Drawn, Manoeuvre
from grounded_trials.starting.shapes import Drive
from grounded_trials.wording import extent, with_unit

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
