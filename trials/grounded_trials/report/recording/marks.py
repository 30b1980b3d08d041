"""How curves, paths and bodies go into a recording: by whole columns, names and colours once."""

from __future__ import annotations

from typing import Any

import numpy as np

from grounded.frozen import Array
from grounded_trials.report.scene import Scene

CAR = (
    [(-0.5, -0.25, 0), (0.5, -0.25, 0), (0.5, 0.25, 0), (-0.5, 0.25, 0), (-0.5, -0.25, 0)],
    [(0.5, -0.25, 0), (0.85, 0, 0), (0.5, 0.25, 0)],
)
AIRCRAFT = (
    [(-0.6, 0, 0), (0.5, 0, 0)],
    [(-0.1, 0.8, 0), (0.2, 0, 0), (-0.1, -0.8, 0), (-0.1, 0.8, 0)],
    [(-0.6, 0.25, 0), (-0.6, -0.25, 0)],
    [(-0.4, 0, 0), (-0.65, 0, 0.25), (-0.6, 0, 0)],
)
COLOURS = {
    "desired": (170, 170, 170),
    "model_policy": (213, 94, 0),
    "best": (86, 180, 233),
    "predicted": (204, 121, 167),
    "other": (110, 110, 110),
    "accepted": (0, 158, 115),
    "limit": (230, 159, 0),
}
SERIES = [
    (86, 180, 233),
    (230, 159, 0),
    (0, 158, 115),
    (240, 228, 66),
    (204, 121, 167),
    (213, 94, 0),
]
FRAMES = 600  # poses of a body in an animation
VERTICES = 1000  # of a path in space


def line(
    stream: Any,
    at: str,
    values: Array,
    dt: float,
    colour: str,
    name: str = "",
    width: float = 1.5,
) -> None:
    """One curve over time, named by default after its colour; what is not finite is left out."""
    import rerun as rr

    style = rr.SeriesLines(colors=COLOURS[colour], names=name or colour, widths=width)
    stream.log(at, style, static=True)
    keep = np.flatnonzero(np.isfinite(values))
    times = [rr.TimeColumn("time", duration=keep * dt)]
    stream.send_columns(at, times, rr.Scalars.columns(scalars=values[keep]))


def columns(stream: Any, at: str, values: Array, dt: float, names: list[str]) -> None:
    """All columns of an array as one entity."""
    import rerun as rr

    count, width = values.shape
    colours = [SERIES[i % len(SERIES)] for i in range(width)]
    stream.log(at, rr.SeriesLines(colors=colours, names=names), static=True)
    scalars = rr.Scalars.columns(scalars=np.ascontiguousarray(values).reshape(-1))
    times = [rr.TimeColumn("time", duration=np.arange(count) * dt)]
    stream.send_columns(at, times, scalars.partition([width] * count))


def path(stream: Any, at: str, points: Array, colour: str, width: float) -> None:
    """A path in space, all of it at once."""
    import rerun as rr

    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return
    points = points[np.unique(np.linspace(0, len(points) - 1, VERTICES).astype(int))]
    strip = rr.LineStrips3D([points], colors=COLOURS[colour], radii=rr.Radius.ui_points(width))
    stream.log(at, strip, static=True)


def body(
    stream: Any, at: str, scene: Scene, states: Array, dt: float, size: float, colour: str
) -> None:
    """A shape that moves and turns with the states."""
    import rerun as rr

    rows = np.flatnonzero(np.isfinite(states).all(axis=1))
    rows = rows[:: max(1, len(rows) // FRAMES)]
    if not scene.spatial:
        shape: Any = rr.Points3D([[0, 0, 0]], colors=COLOURS[colour], radii=rr.Radius.ui_points(6))
    else:
        strips = [size * np.array(s) for s in (AIRCRAFT if scene.volume else CAR)]
        shape = rr.LineStrips3D(strips, colors=COLOURS[colour], radii=rr.Radius.ui_points(2))
    stream.log(at, shape, static=True)
    pose = rr.Transform3D.columns(
        translation=scene.points(states[rows]), mat3x3=scene.rotations(states[rows])
    )
    stream.send_columns(at, [rr.TimeColumn("time", duration=rows * dt)], pose)
