"""The [log] table of grounded.toml: how a foreign log maps to the model's states and inputs.

`log_mapping` parses the table; `read_log` reads and resamples a log accordingly.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from grounded.checks import refused, unknown
from grounded.errors import GroundedError
from grounded.findings import Finding, found
from grounded.model import Model
from grounded_trials.formats.message_path import parse_path
from grounded_trials.formats.tables import AS_IT_SAYS, LATEST, Layout
from grounded_trials.logs.resample import Crossing, Gridded, Span, to_grid
from grounded_trials.logs.signals import Clock, Series, SignalSpec, read_signals
from grounded_trials.logs.stated_units import LENGTHS, is_angle
from grounded_trials.toml_table import Table

PART = re.compile(r"((?:^|[._])(?:orientation|rotation|quaternion))\.([xyzw])$")
ABOUT = {"x": "roll", "y": "pitch", "z": "yaw", "w": "yaw"}  # the angle closest to each component
SMALL_ANGLE_SCALE = 2.0  # a scale of 2 is intended: 2 sin(a / 2) is a for small angles

LATEST_S = 1e-9 * LATEST


def log_mapping(table: Table, states: Sequence[str], inputs: Sequence[str]) -> LogMapping | None:
    """Parse the [log] table; None if there is none."""
    if not table.values:
        return None
    table.expect(("clock", "state", "input", "span", "columns", "rate"))
    clock, signals = table.take("clock", Clock, "header"), list[dict[str, SignalSpec]]()
    for kind, names in (("state", states), ("input", inputs)):
        group = table.sub(kind)
        group.expect(names)
        signals.append({one: _signal(group.sub(one), clock) for one in names if one in group})
    return LogMapping(signals[0], signals[1], _span(table.sub("span")), layout_of(table))


def layout_of(table: Table) -> Layout:
    """Return the names and the rate of tables that do not say them, `columns` and `rate`."""
    columns = table.take("columns", list, [])
    if not all(isinstance(name, str) and name for name in columns):
        raise table.error("columns", "list", columns)
    rate = table.take("rate", float, 0.0)
    if rate < 0:
        raise table.error("rate", "positive", rate)
    return Layout(tuple(columns), rate)


def _signal(table: Table, clock: str) -> SignalSpec:
    spec = table.into(SignalSpec)
    _check_path(table, spec.path)
    for key, seconds in (("max_age_s", spec.max_age_s), ("delay_s", spec.delay_s)):
        _check_time(table, key, seconds)
    if spec.max_age_s is not None and spec.max_age_s <= 0:
        raise table.error("max_age_s", "positive", spec.max_age_s)
    if spec.scale == 0:
        raise table.error("scale", "nonzero", spec.scale)
    return spec if "clock" in table else replace(spec, clock=cast(Clock, clock))


def _check_time(table: Table, key: str, value: float | None) -> None:
    """Check a time [s]: beyond a log's clock it has no whole nanoseconds."""
    if value is not None and abs(value) > LATEST_S:
        raise table.error(key, "time", value)


def _check_path(table: Table, path: str) -> None:
    try:
        parse_path(path)
    except GroundedError as error:
        raise table.error("path", "path", str(error)) from None


def _span(table: Table) -> Span:
    table.expect(("start", "end"))
    start, end = _end(table, "start"), _end(table, "end")
    if end == "first-input":
        raise table.error("end", "crossing", end)
    return Span(start="first-input" if start is None else start, end=end)


def _end(table: Table, key: str) -> Any:
    """Parse one end of the span: None, "first-input", a time, or a crossing."""
    value = table.values.get(key)
    if value is None or isinstance(value, str):
        return table.take(key, Literal["first-input"])
    if not isinstance(value, dict):
        time = table.take(key, float)
        _check_time(table, key, time)
        return time
    crossing = table.sub(key).into(Crossing)
    _check_path(table.sub(key), crossing.path)
    if (crossing.above is None) == (crossing.below is None):
        raise table.error(key, "crossing", value)
    return crossing


@dataclass(frozen=True)
class LogMapping:
    """The [log] table: the signal of each state and input, and which part is the trial."""

    states: Mapping[str, SignalSpec]
    inputs: Mapping[str, SignalSpec]
    span: Span = field(default_factory=Span)
    layout: Layout = AS_IT_SAYS

    def since(self, before: Mapping[str, float]) -> LogMapping:
        """Return it with the values of inputs, of these names only, until their first samples."""
        for name in before:
            if name not in self.inputs:
                raise unknown("input", name, self.inputs, of="[log]")
        new = {name: replace(self.inputs[name], before=value) for name, value in before.items()}
        return replace(self, inputs={**self.inputs, **new})


def read_log(
    paths: str | Path | Sequence[str | Path],
    mapping: LogMapping,
    dt: float,
    *,
    states: Sequence[str] | None = None,
    **how: Any,
) -> Gridded:
    """Read a log, or several in order, and sample it every dt [s].

    `states` are those to read, in array order, all mapped ones by default; for `how`, and for what
    is refused, see `to_grid`.
    """
    states, inputs = list(mapping.states) if states is None else states, list(mapping.inputs)
    series = mapped_signals(paths, mapping, states, inputs)
    return to_grid(series, dt, states, inputs, mapping.span, **how)


def mapped_signals(
    paths: str | Path | Sequence[str | Path],
    mapping: LogMapping,
    states: Sequence[str],
    inputs: Sequence[str],
) -> dict[str, Series]:
    """Return the raw samples of a log's states and inputs, and of the signals for its span."""
    if missing := ["state"] * (not states) + ["input"] * (not inputs):
        raise refused("log.no_signal", *missing, what="any")
    paths_of = {mapping.states[name].path: name for name in states}
    for name in inputs:
        if (path := mapping.inputs[name].path) in paths_of:
            places = f"[log.state.{paths_of[path]}]", f"[log.input.{name}]"
            raise refused("given.twice", *places, name=path)
    specs = {name: mapping.states[name] for name in states}
    specs |= {name: mapping.inputs[name] for name in inputs} | mapping.span.signals()
    series = read_signals(paths, specs, mapping.layout)
    return series | {name: _with_row_before(series[name]) for name in inputs}


def _with_row_before(series: Series) -> Series:
    """Return an input with a sample of its value until then just before its first one."""
    spec, first = series.spec, int(np.argmin(series.t))
    if spec.before is None:
        return series
    apart = np.diff(np.sort(series.t))
    interval = int(np.median(apart)) if len(apart) else 10**9
    return replace(
        series,
        t=np.r_[series.t[first] - interval, series.t],
        values=np.r_[(spec.before - spec.offset) / spec.scale, series.values],
        log_times=np.r_[series.log_times[first] - interval, series.log_times],
    )


def misread(model: Model, mapping: LogMapping | None) -> list[Finding]:
    """Return angles that are read from a part of a quaternion, and lengths from angles.

    The data may not show it: the z of an orientation is sin(yaw / 2), as smooth as a yaw.
    """
    some = []
    for name, one in (mapping.states if mapping else {}).items():
        unit, part = model.states.get(name, ""), PART.search(one.path)
        angle = name in model.angles or unit in ("rad", "deg")
        if unit in LENGTHS and is_angle(one.path) and one.scale == 1:
            some.append(found("log.path", name, path=one.path, what="an angle"))
        elif part and angle and abs(one.scale) != SMALL_ANGLE_SCALE:
            instead = f"{one.path[: part.end(1)]}.@rpy.{ABOUT[part[2]]}"
            what = "a part of a quaternion"
            some.append(found("log.path", name, path=one.path, what=what, instead=instead))
    return some
