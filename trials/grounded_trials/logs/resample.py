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

from grounded.errors import GroundedError
from grounded.findings import Finding, found
from grounded_trials.formats.messages import Floats, Ints
from grounded_trials.logs.command_steps import (
    first_step,
    in_motion,
    rows_apart,
)
from grounded_trials.logs.samples import (
    REGULAR,
    SPARSE,
    How,
    Lead,
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
    assumed: bool  # the log does not contain them, so they are None or as in its first row
    start_states: Mapping[str, float]  # at t = 0, as the samples before show them; see `Trial`
    start_ns: int  # t = 0 on the signals' clock [ns]
    origin_ns: int  # stamp of the first sample of any signal, on the same clock [ns]
    late_s: float  # shift of the start because a state was not known yet [s]
    moved_s: float  # further shift to where the commands change [s]
    row_s: float  # interval of rows that repeat commands, by which these may be logged late [s]
    early: Callable[[], float]  # by which responses may begin early between two samples [s]
    last_ns: int  # last sample of the state whose samples end first, on the same clock [ns]
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

    # Where the trial begins and ends.
    known, until = _extent(measured, sent, dt)
    origin = min(s.first_stamp if s.spec.before is None else _begun(s) for s in samples.values())
    start, late = _start(span, series, measured, sent, known, origin)
    begun = _Commands.at(start, dt, sent, tracked, rates, rest, past)
    start += begun.moved
    stop = min(until, _end(span, series, start, origin, until))
    count = _steps(start, stop, dt, steps, origin, stamped_otherwise(samples.values(), dt))

    # The values: of states at the grid, of inputs in the middle of its steps.
    grid = start + np.round(dt * 1e9 * np.arange(count + 1)).astype(np.int64)
    middle = start + np.round(dt * 1e9 * (np.arange(count) + 0.5)).astype(np.int64)
    at = dict.fromkeys(states, grid) | dict.fromkeys(inputs, middle)
    whole = dict(zip(names, (*measured, *begun.sent), strict=True))
    usual: dict[str, How] = {
        **dict.fromkeys(states, "linear"),
        **dict.fromkeys(inputs, begun.usual),
    }
    values = {n: whole[n].sampled(whole[n].spec.resample or usual[n], at[n], dt, start) for n in at}

    def told() -> tuple[tuple[SignalReport, ...], tuple[Finding, ...]]:
        own = ((samples[n], series[n], values[n], at[n]) for n in names)
        reports = tuple(report_of(*one, start) for one in own)
        cut = stop == until and (steps is None or count < steps) and span.end is None
        gone = vanished(measured, int(grid[-1] + dt * 1e9)) if cut else []
        return reports, (*findings_of(reports, late), *clocks, *gone)

    held, assumed = begun.held_before(start, dt, rest)
    return Gridded(
        states=np.column_stack([values[name] for name in states]),
        inputs=np.column_stack([values[name] for name in inputs]),
        start_inputs=held,
        assumed=assumed,
        start_states=_start_states({one.name: one.leading_to(start) for one in tracked}, rates),
        start_ns=start,
        origin_ns=origin,
        late_s=late,
        moved_s=begun.moved * 1e-9,
        row_s=rows_apart(begun.sent, measured),
        early=lambda: max((begins_early(one, grid) for one in tracked), default=0.0),
        last_ns=min(int(one.t[-1]) for one in measured),
        told=told,
    )


@dataclass(frozen=True)
class _Commands:
    """The inputs from where every signal is known on."""

    sent: Sequence[Samples]
    moved: int  # shift of the start to where they change [ns]
    usual: How  # how they are sampled: changes in no steps have a mean
    still: bool  # whether the robot stood still until then

    @classmethod
    def at(
        cls,
        start: int,
        dt: float,
        sent: Sequence[Samples],
        tracked: Sequence[Samples],
        rates: Sequence[str],
        rest: Floats | None,
        past: Floats | None,
    ) -> _Commands:
        """Find the first step at or after a start [ns]; for the others see `to_grid`."""
        before = start - round(dt * 1e9)
        if past is not None:  # for an input of which nothing was sent in the first step
            waits = (one.t[0] > start + dt * 0.5e9 for one in sent)
            three = zip(sent, past.tolist(), waits, strict=True)
            sent = [one.held_from(before, u) if wait else one for one, u, wait in three]
        if rest is None:
            return cls(sent, 0, "hold", False)
        still = at_rest({one.name: one.leading_to(start) for one in tracked}, rates)
        moved, in_steps = first_step(sent, start, dt)
        return cls(sent, moved, "hold" if in_steps else "mean", still)

    def held_before(self, start: int, dt: float, rest: Floats | None) -> tuple[Floats | None, bool]:
        """Return the inputs before a run (m,), None if unknown, and if the log lacks one of them.

        Args:
            start: of the run [ns].
            dt: control interval [s].
            rest: (m,) inputs at rest.
        """
        held = np.array([one.before(start - round(dt * 0.5e9)) for one in self.sent])
        if self.still and rest is not None:
            held = np.where(np.isfinite(held), held, rest)
        assumed = not np.isfinite(held).all()
        if assumed and rest is not None and in_motion(self.sent, start, rest):
            held = np.where(np.isfinite(held), held, [one.y[0] for one in self.sent])
        return (held if np.isfinite(held).all() else None), assumed


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


def _start_states(leads: Mapping[str, Lead | None], rates: Sequence[str]) -> dict[str, float]:
    """Return the values at t = 0 as the samples before tell, for the states of which they do.

    That is their mean at rest, else, or without a velocity, where a line leads: a boat that drifts
    is not where it was on average.
    """
    still = bool(rates) and at_rest(leads, rates)
    known = {name: one for name, one in leads.items() if one and (still or one.exact)}
    return {name: one.mean if still else one.line for name, one in known.items()}


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


def _start(
    span: Span,
    series: Mapping[str, Series],
    measured: Sequence[Samples],
    sent: Sequence[Samples],
    known: int,
    origin: int,
) -> tuple[int, float]:
    """Return t = 0 [ns], and by how much it was moved because a state was not known yet [s].

    A start that is moved is at a sample, a given one may be a little before the first (`slack`).
    """
    if isinstance(span.start, Crossing):
        start = _crossing(span.start, series[START], "start", None)
    elif isinstance(span.start, str):
        start = max(map(_begun, sent))
    else:
        start = _time(span.start, origin)
    if start >= known:
        return start, 0.0
    first = max(int(one.t[0]) for one in measured)
    return first, (first - start) * 1e-9


def _end(span: Span, series: Mapping[str, Series], start: int, origin: int, until: int) -> int:
    if span.end is None:
        return until
    if isinstance(span.end, Crossing):
        return _crossing(span.end, series[END], "end", start)
    return _time(span.end, origin)


def _time(seconds: float, origin: int) -> int:
    return round(seconds * 1e9) + (0 if abs(seconds) >= ABSOLUTE_S else origin)


def _crossing(crossing: Crossing, series: Series, which: str, after: int | None) -> int:
    """Return the first stamp [ns] at which the watched signal is beyond its value."""
    order = np.argsort(series.t, kind="stable")
    t, y = series.t[order], series.values[order]
    beyond = np.ones(len(t), dtype=np.bool_)
    if crossing.above is not None:
        beyond &= y > crossing.above
    if crossing.below is not None:
        beyond &= y < crossing.below
    if after is not None:
        beyond &= t > after
    if not beyond.any():
        limits = {"above": crossing.above, "below": crossing.below}
        wanted = " and ".join(f"{k} {v}" for k, v in limits.items() if v is not None)
        facts: dict[str, Any] = {"given": f"{y.min():g} to {y.max():g}"}
        raise GroundedError(
            found(
                "given.value",
                f"[log.span] {which}: {crossing.path}",
                like=wanted,
                must="span",
                **facts,
            )
        )
    return int(t[np.argmax(beyond)])


def stamped_otherwise(samples: Iterable[Samples], dt: float) -> float:
    """Return the longest interval of samples [s] if it is so short that their times seem wrong."""
    every = max((one.interval for one in samples if len(one.t) > 1), default=0.0)
    return every if every * SPARSE < dt else 0.0


def _steps(start: int, stop: int, dt: float, most: int | None, origin: int, every: float) -> int:
    count = int(np.floor((stop - start) / (dt * 1e9) + 1e-6))
    if not 1 <= count <= STEP_LIMIT:
        ends: dict[str, Any] = {"start": (start - origin) * 1e-9, "stop": (stop - origin) * 1e-9}
        facts: dict[str, Any] = {"steps": max(count, 0), "dt": dt, "every": every}
        raise GroundedError(found("file.steps", **facts, **ends))
    return count if most is None else min(count, most)
