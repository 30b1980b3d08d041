"""grounded target: draw the manoeuvre that the states are to follow."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import click

from grounded.errors import NextCommand
from grounded.result import listed
from grounded_cli.console.options import as_json
from grounded_cli.console.terminal import field, number, remark, sentence, show, show_json
from grounded_cli.console.workspace_option import in_workspace, next_line, open_workspace, typed
from grounded_trials.wording import extent, misread, with_unit

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from grounded.frozen import Array
    from grounded_trials import Workspace
    from grounded_trials.workspace.user_files.config import TaskTable

SECONDS = 5.0  # default duration of a step or a swing-up
REACHED = 0.95  # of --speed: a path that stays below it brings a note
STRAIGHT = 1e3  # times --size: larger turning radii are those of a straight line
OBEYED = 0.1  # of a sensor's bias: a target that ends there was drawn in readings
TURNS = 2.0  # a larger angle brings a warning: it may be meant in degrees


@click.command("target")
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
@click.option(
    "--rest",
    "at_rest",
    is_flag=True,
    help="Let the states that a line leaves free rest at its end, by weights in [reward] terminal.",
)
@in_workspace
@as_json
def command(
    shape: str,
    size: float,
    speed: float | None,
    accel: float | None,
    lateral: float,
    laps: float,
    hold: float,
    to: tuple[str, ...],
    seconds: float | None,
    at_rest: bool,
    json_: bool,
) -> None:
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
    from grounded.places import velocities
    from grounded_trials.starting.shapes import (
        PATHS,
        Drive,
        has_plane,
        line_target,
        path_target,
        step_target,
        swing_up,
    )
    from grounded_trials.workspace.candidates.at_rest import rest_of_trials
    from grounded_trials.workspace.candidates.handover import INSPECT, unmapped
    from grounded_trials.workspace.candidates.rest_at_end import NOISY, names_told, rest_at_end
    from grounded_trials.workspace.candidates.standstill import read_at_start
    from grounded_trials.workspace.off_target import (
        driven,
        position_names,
        rates_beside,
        usual_weights,
    )
    from grounded_trials.workspace.user_files.config import set_start
    from grounded_trials.workspace.user_files.task_file import limits_of_log, without_range

    workspace = open_workspace()
    model, dt = workspace.base_model, workspace.config.task.dt
    rest, seen = rest_of_trials(workspace)
    start, ends = workspace.config.task.start or rest, _values(to)
    paces = {k: v for k, v in (("speed", speed), ("accel", accel)) if v is not None}
    drive = Drive(size=size, lateral=lateral, laps=laps, hold=hold, **paces)
    long = SECONDS if seconds is None else seconds
    if shape == "line" and (ends or not has_plane(model)):
        if seconds is not None and len(paces) > 1:
            raise click.UsageError(
                "a line takes only two of --seconds, --speed and --accel: omit one"
            )
        columns = line_target(ends, start, drive, model, dt, seconds, next(iter(paces), ""))
    elif shape == "step":
        columns = step_target(ends, model, dt, long, start)
    elif shape == "swing-up":
        columns = swing_up(model, dt, long, ends, start)
    elif seconds is not None:
        raise click.UsageError(
            "--seconds is for a step, a swing-up or a line --to STATE=VALUE; use --speed and "
            "--accel to set how fast a path is driven"
        )
    elif shape in PATHS:
        columns = path_target(shape, drive, model, dt, ends, start)
    else:
        columns, rest = _recorded(workspace, shape), {}
    before, old = _reward(workspace), workspace.config.task
    if at_rest and shape != "line":
        raise click.UsageError(
            "--rest is for a line: a swing-up ends at rest as it is, a path with --hold"
        )
    resting = rest_at_end(workspace, columns, start) if shape == "line" else None
    ended = resting if at_rest else None
    if ended is not None:
        columns = {**columns, **ended.columns}
    extra = (ended.weights, [*ended.columns]) if ended is not None else ()
    path, ran = workspace.target(columns, *extra), bool(workspace.candidate_ids())
    if rest:
        set_start(workspace.config.file, rest)
        workspace.forget()
    reward = _reward(workspace)
    rows = len(next(iter(columns.values())))
    ranges = {name: (float(v.min()), float(v.max())) for name, v in columns.items()}
    free = [name for name in model.states if name not in columns]
    if json_:
        found = {"target": str(path), "horizon": rows - 1, "columns": ranges, "free": free}
        show_json(found)
        return
    planar = shape in PATHS and has_plane(model)
    fastest, tightest = driven(model, columns, dt) if planar else (math.nan, math.inf)
    if speed is not None and not ends and fastest < REACHED * speed:
        by = f"--accel {drive.accel:g} and --lateral {lateral:g} m/s^2"
        remark(
            "note", f"it reaches {fastest:.3g} m/s at most, not --speed {speed:g}: {by} limit it"
        )
    for name, value in ends.items():
        if model.states.get(name) == "rad" and abs(value) > TURNS * 2 * math.pi:
            remark(
                "warning",
                f"{name} = {value:g} rad is {abs(value) / (2 * math.pi):.2g} turns: if you meant "
                f"degrees, use `--to {name}={math.radians(value):.4g}`",
            )
    show(f"{path}: {shape}, {(rows - 1) * dt:.4g} s, {rows - 1} steps")
    if tightest < STRAIGHT * size:
        show(field("driven", f"at up to {fastest:.3g} m/s, turning radius {tightest:.3g} m", "  "))
    for name, (low, high) in ranges.items():
        low, high = extent(low, high)
        span = f"{number(low)} to {number(high)}" if low < high else f"stays at {number(low)}"
        text = with_unit(span, model.states[name])
        show(field(name, text, "  "))
    if free:
        rates = velocities(model) if resting else []
        text = _free(free, reward, rates, path=shape in PATHS and not ends)
        if resting is not None and ended is None:
            told = names_told([*resting.columns], resting.columns)
            text += (
                f". To ask for rest at the end, but not on the way ({told}, by weights in [reward] "
                "terminal): draw it again with `--rest` as well"
            )
        show(field("free", text, "  "))
    elif at_rest and ended is None:
        remark("note", "--rest has nothing to add: every state has a column already")
    if ran:
        _tell_undo(old, before, reward, rows - 1)
    if rest:
        sentence(
            f"[task] start is new, where {seen} rests: "
            f"{_equal(rest)}. If runs "
            "begin elsewhere, change it and draw the target again"
        )
    each, at_end = usual_weights(model, columns), () if ended is None else ended.columns
    suggested = {name: float(f"{w:.6g}") for name, w in each.items() if name not in at_end}
    shared = len({*position_names(model)} & {*columns}) > 1
    alike = ", coordinates of a position alike by the smaller of their ranges" * shared
    alike += ", at least a fifth of the larger" * shared
    slower = ", a tenth of that for velocities of positions" * bool(rates_beside(model, columns))
    for kind, by in (
        ("state", f"1 / (range in the target)^2{alike}{slower}"),
        ("terminal", "ten times such weights, for the end"),
        ("input_change", "0.04 / (range of [limits])^2"),
    ):
        if (weights := reward.get(kind, {})) != before.get(kind, {}):
            sentence(f"[reward] {kind} is new, {by}: {_equal(weights)}")
        elif kind == "state" and weights and weights != suggested:
            remark(
                "note",
                f"[reward] state is kept, since its weights are not those that the target before "
                f"this one gave: {_equal(weights)}. This one gives {_equal(suggested)}; to have "
                "these, delete the line and draw the target again",
            )
    noisy = {} if ended is None else {n: (s, ended.weights[n]) for n, s in ended.noise.items()}
    for name, (deviation, weight) in noisy.items():
        if reward["terminal"][name] != weight:
            continue  # the user's own
        its = with_unit(f"{deviation:.2g}", model.states[name])
        remark(
            "note",
            f"the weight of {name} at the end is only {number(weight)}: with it, the sensor noise "
            f"({its}) costs {NOISY:g} of the utility; with a larger one, the inputs would answer "
            "that noise",
        )
    bounds = workspace.config.safety.pairs(list(model.states))
    for name, (low, high) in ranges.items():
        least, most = bounds.get(name, (-math.inf, math.inf))
        if low < least or high > most:
            bound = least if low < least else most
            goes = with_unit(number(low if low < least else high), model.states[name])
            remark("note", f"{name} goes to {goes}, beyond its bound in [safety], {number(bound)}")
    for effect in workspace.config.model.effects:
        family, _, name = str(effect["name"]).partition(":")
        if family != "sensor_bias" or name not in columns:
            continue
        begins = float(workspace.config.task.start.get(name, columns[name][0]))
        asked = {"the target ends at": float(columns[name][-1])}
        if not read_at_start(workspace, name, effect["b"]):
            asked["[task] start is"] = begins
        off = [
            f"{what} {with_unit(number(value), model.states[name])}"
            for what, value in asked.items()
            if not math.isclose(value, effect["b"], rel_tol=OBEYED)
        ]
        if off:
            remark(
                "note",
                f"the target and [task] start of {name} are in readings of its sensor, which by "
                f"the adopted sensor_bias:{name} reads "
                f"{misread(effect['b'], model.states[name])}: a true 0 is {effect['b']:.3g} there, "
                f"but {listed(off)}. If a true 0 is meant, correct that",
            )
    at_end = ended.columns if ended is not None else {}  # which have weights for the end
    if still := [name for name in without_range(columns, model.states) if name not in at_end]:
        at = {number(ranges[name][0]) for name in still}
        stay = f"{'stay' if len(still) > 1 else 'stays'} at {listed(at)}"
        remark(
            "note",
            f"{listed(still)} {stay if len(at) == 1 else 'stay as they are'} in the target, "
            "so it does not show what a small error is there: choose the weight in "
            "[reward] state",
        )
    if limited := limits_of_log(workspace.config):
        remark("note", limited)
    then = NextCommand("propose")
    if lost := unmapped(workspace):
        remark("note", f"{lost}: `propose` plans for all inputs, so map all of them first")
        then = INSPECT
    if weighed := _weighed(free, reward):
        remove = f"remove the weight of {listed(weighed)} from [reward] in grounded.toml"
        show("")
        sentence(f"next: {remove}, then: {typed(then)}")
        return
    show(f"\n{next_line(then)}")


def _equal(by_name: Mapping[str, float]) -> str:
    return ", ".join(f"{name} = {number(value)}" for name, value in by_name.items())


def _tell_undo(
    old: TaskTable,
    before: dict[str, dict[str, float]],
    reward: dict[str, dict[str, float]],
    steps: int,
) -> None:
    """Say what a new target replaced, in a workspace with candidates, and how to go back."""
    was = [f"horizon = {old.horizon}"] * (old.horizon != steps)
    was += [
        f"[reward] {kind}: {_equal(weights)}"
        for kind, weights in before.items()
        if weights != reward.get(kind)
    ]
    sentence(
        f"before: {'; '.join([*was, f'the target in {old.target}.bak'])}. To go back to it and its "
        f"candidates, copy {old.target}.bak and grounded.toml.bak over {old.target} and "
        "grounded.toml"
    )


def _free(
    names: list[str],
    reward: dict[str, dict[str, float]],
    rates: Sequence[str] = (),
    *,
    path: bool = False,
) -> str:
    """Explain what it means that the target has no column for some states.

    Args:
        names: the states.
        reward: the tables of [reward].
        rates: the model's velocities if the target is a line, which ends at rest.
        path: whether it is a path in the plane, along which a single value of a rate fits nothing.
    """
    weighed = _weighed(names, reward)
    it = "them" if len(names) > 1 else "it"
    ends = [f"--to {n}={'0' if n in rates else 'VALUE'}" for n in weighed]
    add = f"add a column (`{' '.join(ends)}`), or remove the weight"
    text = f"{listed(names)}: no column in the target, so a run may take {it} anywhere"
    if weighed:
        text += (
            f". [reward] weighs {listed(weighed)}, and `propose` refuses weights without a column: "
            f"{'remove the weight, or add a column in the table' if path else add}"
        )
    return text


def _weighed(names: Sequence[str], reward: dict[str, dict[str, float]]) -> list[str]:
    """Return which of some states have a weight."""
    return [n for n in names if any(reward.get(k, {}).get(n) for k in ("state", "terminal"))]


def _reward(workspace: Workspace) -> dict[str, dict[str, float]]:
    import tomllib

    written = tomllib.loads(workspace.config.file.read_text(encoding="utf-8"))
    return dict(written.get("reward", {}))


def _values(pairs: tuple[str, ...]) -> dict[str, float]:
    found = {}
    for pair in pairs:
        name, _, value = pair.partition("=")
        try:
            end = float(value)
        except ValueError:
            end = math.nan
        if not math.isfinite(end):
            raise click.UsageError(f"--to {pair}: expected STATE=VALUE, such as x=1.0")
        found[name.strip()] = end
    return found


def _recorded(workspace: Workspace, file: str) -> dict[str, Array]:
    """Read a run of a log, or the columns of a CSV of states."""
    from grounded_trials.starting.recorded_run import recorded_run
    from grounded_trials.starting.shapes import SHAPES

    return recorded_run(workspace, file, SHAPES)
