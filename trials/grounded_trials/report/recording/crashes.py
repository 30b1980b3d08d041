"""Crashes in a recording: a labelled cross where a run ended early, and one in its plots, when.

For every run, in space: /paths/crashes/t0007, and /trials/t0007/crash beside its path.
Over time, the last values: /trials/t0007/state/ended, and /state/x/ended_best for compared runs.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from grounded.figures.body import Body
from grounded.frozen import Array
from grounded_trials.report.figures.paths import crash, ended
from grounded_trials.report.findings import Run

ARM = 0.02  # half the size of a cross, as a fraction of the path's size
LABELS = 6  # largest number of crashes whose labels are always shown; more show on hovering
CROSS = ((1, 1, 0), (1, -1, 0), (1, 0, 1), (1, 0, -1))  # seen from above, and from the side


def mark_place(
    stream: Any, at: str, body: Body, run: Run, size: float, colour: Any, shown: bool
) -> None:
    """Record a labelled cross where a run ended early.

    Args:
        stream: the recording.
        at: name of the entity.
        body: the body that moved.
        run: the run; nothing is recorded if it is complete.
        size: size of the paths.
        colour: colour of the cross.
        shown: whether the label is always visible.
    """
    import rerun as rr

    last = crash(run)
    place = None if last is None else body.path(run.trial.states[[last]])[0]
    if place is None or not np.isfinite(place).all():
        return
    arms = ARM * size * np.array(CROSS)
    cross = [[place - arm, place + arm] for arm in arms]
    labels = [ended(run), *[""] * (len(cross) - 1)]
    width = rr.Radius.ui_points(2)
    strips = rr.LineStrips3D(cross, colors=colour, labels=labels, show_labels=shown, radii=width)
    stream.log(at, strips, static=True)


def mark_time(stream: Any, at: str, run: Run, dt: float, columns: list[int], colour: Any) -> None:
    """Record the last values of some states, as crosses, at the time at which a run ended early."""
    import rerun as rr

    last = crash(run)
    values: Array = np.zeros(0) if last is None else run.trial.states[last, columns]
    if last is None or not np.isfinite(values).all():
        return
    look = rr.SeriesPoints(
        colors=[colour] * len(columns),
        markers=["cross"] * len(columns),
        marker_sizes=[5.0] * len(columns),
        names=[ended(run)] * len(columns),
    )
    stream.log(at, look, static=True)
    when = [rr.TimeColumn("time", duration=np.array([last * dt]))]
    stream.send_columns(at, when, rr.Scalars.columns(scalars=values).partition([len(columns)]))
