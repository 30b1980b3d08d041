"""grounded target: draw the manoeuvre that the states are to follow."""

from __future__ import annotations

import math
from collections.abc import Iterator

import click
from click.core import ParameterSource

from grounded.result import listed
from grounded_cli.console import options
from grounded_cli.console.options import command, flag, misuse, values_by_name
from grounded_cli.console.terminal import field, number, show, tell
from grounded_cli.console.workspace_option import next_line, open_workspace
from grounded_trials.starting.drawing import Drawn, Manoeuvre
from grounded_trials.starting.shapes import Drive
from grounded_trials.wording import extent, with_unit

PATHS = ("line", "circle", "figure-8")
OF_SHAPES = {  # the shapes that an option is for
    **dict.fromkeys(("size", "speed", "accel", "hold"), PATHS),
    **dict.fromkeys(("lateral", "laps"), PATHS[1:]),
    "seconds": ("line", "step", "swing-up"),
    "to": (*PATHS, "step", "swing-up"),
    "rest": PATHS[:1],
}


@command("target")
@click.argument("shape", metavar="SHAPE|FILE")
@click.option(
    "--size",
    type=float,
    default=2.0,
    help="Length of a line, radius of a circle, half the width of a figure-8's loops [m] (2).",
)
@click.option("--speed", type=float, help="Maximum speed [m/s] (1).")
@click.option("--accel", type=float, help="Maximum acceleration along the path [m/s^2] (1).")
@click.option(
    "--lateral", type=float, default=4.0, help="Maximum lateral acceleration [m/s^2] (4)."
)
@click.option("--laps", type=float, default=1.0, help="Laps of a circle or figure-8 (1).")
@click.option("--hold", type=float, default=0.0, help="Time at rest at a path's end [s] (0).")
@click.option(
    "--to",
    multiple=True,
    metavar="STATE=VALUE",
    help="Where a line, step or swing-up ends; what a state keeps along a path (a height). "
    "A velocity along a line or path follows it, and must end at this value.",
)
@click.option(
    "--seconds", type=float, help="Duration of a step or swing-up (5), or of a line to a STATE."
)
@flag("--rest", help="Let the states that a line leaves free rest at its end, by weights.")
@options.details
def target(
    shape: str,
    to: tuple[str, ...],
    seconds: float | None,
    rest: bool,
    details: bool,
    **pace: float | None,
) -> Iterator[Drawn]:
    """Write target.csv: a line, circle, figure-8, step or swing-up, or a recorded run.

    FILE is a log, read through [log], a stored trial (t0001), or a CSV with columns `t` and states.
    Paths start from rest and keep to the given speeds and accelerations. A line with --to, or of a
    robot with one axis, goes from [task] start to rest, in the states' own units; --seconds,
    --speed and --accel set its pace. A step begins at [task] start. A swing-up brings the first
    angle that hangs under its weight upright; --to names another angle, or more states. A path
    begins at the position in [task] start, along x, and a figure-8 at its crossing: its length lies
    45 degrees to the right of x. What --to names, such as the height of a drone, keeps its value,
    but a velocity that moves the robot along the path follows it. With --hold a path ends at rest
    and stays there. With --rest the states that a line leaves free, such as the angle of a beam
    under a ball, rest at its end, and may move on the way.

    The previous target is kept as target.csv.bak, and grounded.toml as grounded.toml.bak. If
    [task] start is empty and a stored trial begins at rest, it is set to where. [task] horizon is
    updated, and so are the weights in [reward] state unless you chose them, and input_change of
    inputs with [limits] if it is still what `init` wrote. Earlier trials stay available to fit and
    diagnose; the search starts again.
    """
    context = click.get_current_context()
    for name, shapes in OF_SHAPES.items():
        given = context.get_parameter_source(name) is not ParameterSource.DEFAULT
        if given and shape not in shapes:
            raise misuse(" | ".join(shapes), f"--{name}", how="first")
    paces = {name: value for name, value in pace.items() if value is not None}
    asked = {name: value for name, value in paces.items() if name in ("speed", "accel")}
    if shape == "line" and seconds is not None and len(asked) > 1:
        raise misuse("--seconds", "--speed with --accel")
    ends = values_by_name(to, "--to")
    drawn = open_workspace().draw(Manoeuvre(shape, Drive(**paces), ends, seconds, asked, rest))
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
