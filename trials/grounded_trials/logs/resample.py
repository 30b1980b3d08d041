"""Resample asynchronous samples onto the control grid; arrays in, arrays out.

    state k = value at t_k = start + k dt       linear interpolation between the samples around t_k
    input k = value held at t_k + dt / 2        zero-order hold, at the middle of the step

Inputs are taken at the middle because a command's stamp scatters around its t_k: taken at t_k,
every late one would appear a whole step later. Commands of data that change in no steps, as those
of a driver or of a faster program, are taken as their mean over the step: the value at its middle
would be up to half a step early or late, and most often early if rows are half a step apart.

Gaps, clocks that jump and clocks that differ are refused, since they hide what happened. Everything
else is counted and reported.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from grounded.checks import refused
from grounded.findings import Finding
from grounded_trials.formats.messages import Floats, Ints
from grounded_trials.logs.command_steps import first_step, in_motion, rows_apart
from grounded_trials.logs.samples import (
    REGULAR,
    SPARSE,
    Samples,
    at_rest,
    check_overlap,
    tidy,
)
from grounded_trials.logs.signal_report import (
    SignalReport,
    check_clocks,
    findings_of,
    report_of,
    vanished,
)
from grounded_trials.logs.signals import Clock, Series, SignalSpec

START, END = "[log.span] start", "[log.span] end"  # names of the series that a span watches
ABSOLUTE_S = 1e8  # larger times are stamps, not relative to the beginning of the log
STEP_LIMIT = 2_000_000
NEVER = -(2**63)  # before every stamp [ns]


@dataclass(frozen=True)
class Crossing:
    """The first time a signal is above, or below, a value."""

    path: str
    above: float | None = None
    below: float | None = None
    clock: Clock = "log"


@dataclass(frozen=True)
class Span:
    """Which part of a log is the trial.

    A number is in seconds after the first sample of any signal (from 1e8 on it is a stamp), by its
    stamp: delay_s moves the samples of a sensor, but not this origin. "first-input" is the time
    when every input has been sent once. Without an end the trial lasts as long as every state is
    known and the inputs are sent.
    """

    start: Literal["first-input"] | float | Crossing = "first-input"
    end: float | Crossing | None = None

    def signals(self) -> dict[str, SignalSpec]:
        """Return the signals it watches, to be read along with the states and inputs."""
        ends = {START: self.start, END: self.end}
        return {
            name: SignalSpec(end.path, end.clock)
            for name, end in ends.items()
            if isinstance(end, Crossing)
        }


@dataclass(frozen=True, eq=False)
class Gridded:
    """A log on the control grid, with reports and warnings."""

    states: Floats  # (T + 1, n)
    inputs: Floats  # (T, m)
    start_inputs: Floats | None  # (m,) held before t = 0; None if the log does not contain them
    start_states: Mapping[str, float]  # at t = 0, as the samples before show them; see `Trial`
    start_ns: int  # t = 0 on the signals' clock [ns]
    origin_ns: int  # stamp of the first sample of any signal, on the same clock [ns]
    late_s: float  # shift of the start because a state was not known yet [s]
    row_s: float  # interval of rows that repeat commands, by which these may be logged late [s]
    early: Callable[[], float]  # by which responses may begin early between two samples [s]
    told: Callable[[], tuple[tuple[SignalReport, ...], tuple[Finding, ...]]]  # of its signals

    @property
    def reports(self) -> tuple[SignalReport, ...]:
        """The reports of the states, then of the inputs."""
        return self._told[0]

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What is odd about the samples."""
        return self._told[1]

    @cached_property
    def interpolated_s(self) -> float:
        """By how much a response may begin early between two samples [s], see `begins_early`."""
        return self.early()

    @cached_property
    def _told(self) -> tuple[tuple[SignalReport, ...], tuple[Finding, ...]]:
        return self.told()  # on request: a run is sought in many spans of a log


def to_grid(
    series: Mapping[str, Series],
    dt: float,
    states: Sequence[str],
    inputs: Sequence[str],
    span: Span | None = None,
    *,
    angles: Sequence[str] = (),
    steps: int | None = None,
    rest: Floats | None = None,
    rates: Sequence[str] = (),
    past: Floats | None = None,
) -> Gridded:
    """Sample signals every dt.

    Args:
        series: the raw samples by name, with those that the span watches as START and END.
        dt: control interval [s].
        states: names in array order.
        inputs: names in array order.
        span: which part of the log to use.
        angles: names that are unwrapped whether their spec says so or not.
        steps: at most this many steps.
        rest: (m,) inputs at rest before a run; the start is then moved as in `command_steps`.
            None: the start is not moved.
        rates: names of states that are velocities.
        past: (m,) inputs before their first samples, for a span that begins a step or more before
            these; None: such a log is refused.

    Raises:
        GroundedError: for a gap longer than max_age_s, a clock that jumps, signals on different
            clocks, or a span that is not in the log.
    """
    span = span or Span()
    names = [*states, *inputs]
    clocks = check_clocks({n: series[n] for n in (*names, *span.signals())})
    samples = {n: tidy(n, series[n], unwrap=n in angles) for n in names}
    measured, sent = ([samples[n] for n in some] for some in (states, inputs))
    check_overlap(measured, sent)
    tracked = [one for one in measured if one.spec.resample != "hold"]
    for one in (*tracked, *(one for one in sent if one.spec.resample == "linear")):
        one.check_linear(dt)

    # Where the trial begins: of data, where commands change in steps; and where it ends.
    known, until = _extent(measured, sent, dt)
    origin = min(s.first_stamp if s.spec.before is None else _begun(s) for s in samples.values())
    if isinstance(span.start, str):
        asked = max(map(_begun, sent))
    else:
        asked = _instant(span.start, START, series, origin, NEVER)
    # moved to a sample if a state is not known yet; a given one may be a little before (`slack`)
    start = asked if asked >= known else max(int(one.t[0]) for one in measured)
    late = (start - asked) * 1e-9
    if past is not None:  # for an input of which nothing was sent in the first step
        before, half = start - round(dt * 1e9), start + dt * 0.5e9
        pairs = zip(sent, past.tolist(), strict=True)
        sent = [one.held_from(before, u) if one.t[0] > half else one for one, u in pairs]
    still, usual = False, "hold"
    if rest is not None:
        still = at_rest({one.name: one.leading_to(start) for one in tracked}, rates)
        moved, in_steps = first_step(sent, start, dt)
        start, usual = start + moved, "hold" if in_steps else "mean"
    if span.end is not None:
        until = min(until, _instant(span.end, END, series, origin, start))
    count = _steps(start, until, dt, steps, origin, stamped_otherwise(samples.values(), dt))

    # The values: of states at the grid, of inputs in the middle of its steps.
    grid = start + np.round(dt * 1e9 * np.arange(count + 1)).astype(np.int64)
    middle = start + np.round(dt * 1e9 * (np.arange(count) + 0.5)).astype(np.int64)
    at = dict.fromkeys(states, grid) | dict.fromkeys(inputs, middle)
    how: dict[str, Any] = dict.fromkeys(states, "linear") | dict.fromkeys(inputs, usual)
    whole = dict(zip(names, (*measured, *sent), strict=True))
    values = {n: s.sampled(s.spec.resample or how[n], at[n], dt, start) for n, s in whole.items()}

    def told() -> tuple[tuple[SignalReport, ...], tuple[Finding, ...]]:
        own = ((samples[n], series[n], values[n], at[n]) for n in names)
        reports = tuple(report_of(*one, start) for one in own)
        cut = (steps is None or count < steps) and span.end is None
        gone = vanished(measured, int(grid[-1] + dt * 1e9)) if cut else []
        return reports, (*findings_of(reports, late), *clocks, *gone)

    # The states where it begins: their mean at rest, else, or without a velocity, where a line
    # leads; a boat that drifts is not where it was on average.
    leads = {one.name: one.leading_to(start) for one in tracked}
    stood = bool(rates) and at_rest(leads, rates)
    return Gridded(
        states=np.column_stack([values[name] for name in states]),
        inputs=np.column_stack([values[name] for name in inputs]),
        start_inputs=_held_before(sent, start, dt, rest, still),
        start_states={
            name: one.mean if stood else one.line
            for name, one in leads.items()
            if one and (stood or one.exact)
        },
        start_ns=start,
        origin_ns=origin,
        late_s=late,
        row_s=rows_apart(sent, measured),
        early=lambda: max((begins_early(one, grid) for one in tracked), default=0.0),
        told=told,
    )


def _held_before(
    sent: Sequence[Samples], start: int, dt: float, rest: Floats | None, still: bool
) -> Floats | None:
    """Return the inputs before a run (m,), those at rest if it stood still; None if unknown."""
    held = np.array([one.before(start - round(dt * 0.5e9)) for one in sent])
    if still and rest is not None:
        held = np.where(np.isfinite(held), held, rest)
    if rest is not None and not np.isfinite(held).all() and in_motion(sent, start, rest):
        held = np.where(np.isfinite(held), held, [one.y[0] for one in sent])
    return held if np.isfinite(held).all() else None


def begins_early(samples: Samples, grid: Ints) -> float:
    """Return by how much a response may begin early by linear interpolation at the grid [s].

    Where the course bends at a part c between two samples h apart, a straight line is off at a part
    f by what the course changes in min(c (1 - f), f (1 - c)) h, at most f (1 - f) h. This is the
    root mean square of that bound over the grid, divided by sqrt(2) since bends are anywhere.
    """
    i, j = samples.around(grid)
    h = (samples.t[j] - samples.t[i]) * 1e-9
    f = np.clip((grid - samples.t[i]) * 1e-9 / h, 0.0, 1.0)
    return float(np.sqrt(np.mean((f * (1 - f) * h) ** 2) / 2))


def _extent(measured: Sequence[Samples], sent: Sequence[Samples], dt: float) -> tuple[int, int]:
    """Return from when every state is known, and until when every signal is known [ns]."""
    first, last = [], []
    for s in measured:
        held = s.spec.resample == "hold"
        slack = 0 if held else int(s.slack(dt) * 1e9)  # rounded down: beyond it values are refused
        first.append(int(s.t[0]) - slack)
        last.append(int(s.t[-1]) + (round(s.max_gap(dt) * 1e9) if held else slack))
    for s in sent:
        if s.spec.max_age_s is not None:
            last.append(int(s.t[-1]) + round(s.spec.max_age_s * 1e9))
        elif len(s.t) > REGULAR:
            last.append(int(s.t[-1]) + round(max(s.interval, dt) * 1.5e9))
    return max(first), min(last)


def _begun(samples: Samples) -> int:
    """Return the stamp of the first sample in the log [ns], behind the one that `before` adds."""
    return int(samples.t[0 if samples.spec.before is None else 1])


def _instant(
    end: float | Crossing, name: str, series: Mapping[str, Series], origin: int, after: int
) -> int:
    """Return the stamp [ns] of a time, or of the first sample that is beyond a signal's limit."""
    if not isinstance(end, Crossing):
        return round(end * 1e9) + (0 if abs(end) >= ABSOLUTE_S else origin)
    order = np.argsort(series[name].t, kind="stable")
    t, y = series[name].t[order], series[name].values[order]
    sign, limit = (-1, end.below or 0.0) if end.above is None else (1, end.above)
    beyond = (sign * (y - limit) > 0) & (t > after)
    if not beyond.any():
        like = f"{'above' if sign > 0 else 'below'} {limit}"
        given = f"{y.min():g} to {y.max():g}"
        where = f"{name}: {end.path}"
        raise refused("given.value", where, must="span", like=like, given=given)
    return int(t[np.argmax(beyond)])


def stamped_otherwise(samples: Iterable[Samples], dt: float) -> float:
    """Return the longest interval of samples [s] if it is so short that their times seem wrong."""
    every = max((one.interval for one in samples if len(one.t) > 1), default=0.0)
    return every if every * SPARSE < dt else 0.0


def _steps(start: int, stop: int, dt: float, most: int | None, origin: int, every: float) -> int:
    count = int(np.floor((stop - start) / (dt * 1e9) + 1e-6))
    if not 1 <= count <= STEP_LIMIT:
        begin, end = ((at - origin) * 1e-9 for at in (start, stop))
        facts = {"steps": max(count, 0), "dt": dt, "every": every}
        raise refused("file.steps", start=begin, stop=end, **facts)
    return count if most is None else min(count, most)
