"""Estimate states that are not measured, with the smoother of `grounded.estimate`.

    [estimate]
    measured = { x = 0.002, y = 0.002, psi = 0.005 }   # standard deviation of each measured state
    process = { v = 0.05 }                             # optional, per control step; else estimated

The measured states are smoothed with the model that plans (the crude one with all adopted effects),
on a time grid about as fine as they were sampled. The process noise is estimated from the same log
by maximum likelihood, where commands change, since model errors show in motion and not while the
robot waits. What was sent before the log is not in it: with a latency, that acts on its first
samples. Either its first command was held before, or the log begins with a run, before which the
robot received the task's held input (and waited at its start); the likeliest is used. The whole log
is smoothed before a run is located in it, since the samples before the
start and after the end of a run carry information about its speeds.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.checks import refused
from grounded.errors import GroundedError
from grounded.estimate import NoiseStd, Record, cut, part, process_noise, smoothed
from grounded.findings import found
from grounded.frozen import Array
from grounded.model import Model
from grounded.places import probe, rate_states
from grounded.task import Task
from grounded_trials.formats.messages import Ints
from grounded_trials.logs.resample import stamped_otherwise
from grounded_trials.logs.samples import Samples, at_rest, check_overlap, tidy
from grounded_trials.logs.signals import Series, SignalSpec
from grounded_trials.toml_table import Table

FINEST = 8  # largest number of smoother rows in a control step
PIECE_S, PIECE = 5.0, 100  # least length of the pieces that are smoothed in parallel [s], rows
OVERLAP_S, OVERLAP = 1.5, 30  # least overlap of the pieces on each side [s], rows
FEWEST_ROWS = 3  # smallest number of rows that can be smoothed
MARGIN_S = 0.5  # time after the last change of a command that still counts as motion [s]
START_SPREAD = 10.0  # std of an initial state, relative to the state's size
# std of the state of a robot that waits at a run's start, relative to the same
WAITING_SPREAD = 0.02
EXACT = 1e-3  # relative tolerance for a step to be a multiple of a simulator's own
ANGLE = 1.0  # largest std of an initial angle [rad]: an angle half a turn off may fit as well
SIZED = 256  # instants at which the size of states is computed


@dataclass(frozen=True)
class EstimateTable:
    """[estimate]: std of the noise of measured states, and of the process noise."""

    measured: dict[str, float]
    process: dict[str, float]


def read_estimate(table: Table, model: Model) -> EstimateTable:
    """Read and check the [estimate] table; measured states are in the model's order."""
    table.expect(("measured", "process"))
    measured = table.sub("measured").numbers(model.state_names)
    process = table.sub("process").numbers(model.state_names)
    for kind, values in (("measured", measured), ("process", process)):
        for name, std in values.items():
            if std <= 0:
                raise table.error(f"{kind}.{name}", "positive", std)
    if not measured:
        raise table.error("measured", "deviations")
    return EstimateTable(measured, process)


def with_estimates(
    series: Mapping[str, Series],
    table: EstimateTable,
    task: Task,
    asked: Sequence[str] | None = None,
) -> dict[str, Series]:
    """Add estimates of the states that are not measured to a log's signals.

    All of the model's, or those `asked` for, without the memory states of effects, which are no
    signals. Unusable samples, or a smoother that fails, are an error.
    """
    model = task.model
    guessed = [name for name in asked or model.state_names if name not in table.measured]
    if not guessed:
        return dict(series)
    samples = [tidy(n, series[n], unwrap=n in model.angles) for n in table.measured]
    sent = [tidy(name, series[name], unwrap=False) for name in model.input_names]
    check_overlap(samples, sent)
    lasts = 1e-9 * (min(int(s.t[-1]) for s in samples) - max(int(s.t[0]) for s in samples))
    if lasts < task.dt:
        every = stamped_otherwise((*samples, *sent), task.dt)
        raise GroundedError(
            found("file.steps", steps=0, dt=task.dt, every=every, start=0.0, stop=max(lasts, 0.0))
        )
    clock = _Clock.of(samples, min(int(s.t[0]) for s in (*samples, *sent)), task)
    records = _records(samples, sent, clock, task)
    if not records:
        return dict(series)
    times, states = _smoothed(records, table, task, _sizes(samples, task))
    t, first = clock.stamps(times), series[next(iter(table.measured))]
    filled, rests = dict(series), _at_rest(samples, sent, model)
    for name in guessed:
        values = states[:, model.state_names.index(name)]
        if name in rests:
            values = np.where(t <= rests[name], 0.0, values)
        spec = SignalSpec(f"/estimate.{name}", first.spec.clock)
        logged = t - round(float(np.median(first.t - first.log_times)))
        filled[name] = replace(first, spec=spec, t=t, values=values, log_times=logged)
    return filled


def _at_rest(samples: Sequence[Samples], sent: Sequence[Samples], model: Model) -> dict[str, int]:
    """Return until when the rates of measured states are zero [ns]: no robot moves on its own.

    That is until a command first changes, if all measured states stand still before it for a while.
    A smoother spreads the first jerk, where its model is off, back over the rest before it.
    """
    moved = [s.t[1:][np.diff(s.y) != 0] for s in sent]
    until = min((int(t[0]) for t in moved if len(t)), default=0)
    if not at_rest({one.name: one.leading_to(until) for one in samples}, ()):
        return {}
    own = {s.name for s in samples}
    return {rate: until for place, rate in rate_states(model).items() if place in own}


@dataclass(frozen=True)
class _Clock:
    """A time grid with rows every `step` seconds from `origin`, slightly wider than the samples."""

    origin: int  # [ns]
    step: float  # [s]
    rows: int

    @classmethod
    def of(cls, samples: Sequence[Samples], earliest: int, task: Task) -> _Clock:
        """Return the grid for the measured samples, not before the earliest sample of the log."""
        dt, every = task.dt, min(s.interval for s in samples)
        finest = int(np.clip(np.ceil(dt / every - 0.01), 1, FINEST))
        parts = (k for k in range(finest, 0, -1) if _makes(task.model, dt / k))
        step = dt / next(parts, 1)
        margin = round(dt * 1e9)  # a signal is known half an interval beyond its samples
        first, last = max(s.t[0] for s in samples), min(s.t[-1] for s in samples)
        origin = max(int(first) - margin, earliest)
        rows = int(np.ceil((int(last) + margin - origin) * 1e-9 / step)) + 1
        return cls(origin, step, max(rows, 0))

    def stamps(self, times: Array) -> Ints:
        return self.origin + np.round(times * 1e9).astype(np.int64)


def _makes(model: Model, step: float) -> bool:
    """Return whether the model, if it is a simulator, can make a step of this length [s]."""
    return abs(probe(model, step) - step) < EXACT * step


def _records(
    samples: Sequence[Samples], sent: Sequence[Samples], clock: _Clock, task: Task
) -> list[Record]:
    """Return the stretches of a log without long gaps, with every sample at the nearest row."""
    times: Array = np.arange(clock.rows, dtype=np.float64) * clock.step
    measured, known = np.full((len(times), task.model.n), np.nan), np.ones(len(times), bool)
    own = [task.model.state_names.index(s.name) for s in samples]
    for s, i in zip(samples, own, strict=True):
        t = (s.t - clock.origin) * 1e-9
        rows = np.unique(np.rint(t / clock.step).astype(int))
        rows = rows[(rows >= 0) & (rows < len(times))]
        measured[rows, i] = np.interp(times[rows], t, s.y)
        for k in np.flatnonzero(np.diff(t) > s.max_gap(task.dt)):
            known &= (times <= t[k]) | (times >= t[k + 1])
    at = np.unique(np.concatenate([s.t for s in sent]))
    commands = np.column_stack(
        [s.y[np.maximum(np.searchsorted(s.t, at, "right") - 1, 0)] for s in sent]
    )
    edges = np.flatnonzero(np.diff(np.r_[False, known, False].astype(int)))
    past, command_times = commands[0], (at - clock.origin) * 1e-9
    return [
        Record(times[a:b], measured[a:b], command_times, commands, past)
        for a, b in zip(edges[::2], edges[1::2], strict=True)
        if b - a >= FEWEST_ROWS and np.isfinite(measured[a:b, own]).any(axis=0).all()
    ]


def _sizes(samples: Sequence[Samples], task: Task) -> Array:
    """Estimate the size of states, (n,), from the changes of measured ones they cause in a step.

    It is 1 for measured states, and for states that no measured one depends on, but at most
    ANGLE / START_SPREAD for an angle that does not wrap: wheels hardly turn a car that stands.
    """
    model, n = task.model, task.model.n
    own = [model.state_names.index(s.name) for s in samples]
    first, last = max(s.t[0] for s in samples), min(s.t[-1] for s in samples)
    t = np.linspace(first, last, SIZED)
    x = np.zeros((SIZED, n))
    moved = np.empty(len(own))
    for k, s in enumerate(samples):
        x[:, own[k]] = np.interp(t, s.t, s.y)
        moved[k] = np.percentile(np.abs(np.interp(t + task.dt * 1e9, s.t, s.y) - x[:, own[k]]), 95)
    A = model.system.linearise(x, np.zeros((SIZED, model.m)), model.values, task.dt)[0]
    by = np.median(np.abs(A), axis=0)[own]  # (measured, n)
    tells = (by > np.finfo(float).eps) & (moved[:, None] > 0)
    sizes = np.where(tells, moved[:, None] / np.where(tells, by, 1.0), np.inf).min(axis=0)
    sizes[own] = 1.0
    sizes = np.where(np.isfinite(sizes), sizes, 1.0)
    for i, (name, unit) in enumerate(model.states.items()):
        if unit == "rad" and i not in own and name not in model.angles:
            sizes[i] = min(sizes[i], ANGLE / START_SPREAD)
    return sizes


def _smoothed(
    records: list[Record], table: EstimateTable, task: Task, sizes: Array
) -> tuple[Array, Array]:
    """Smooth records; return the times, (N,) [s], and the states, (N, n)."""
    model, late = task.model, task.latency
    known = np.array([table.measured.get(name, 1.0) for name in model.state_names])
    guessed = [name not in table.measured for name in model.state_names]
    records = [replace(record, start_std=START_SPREAD * sizes) for record in records]

    def fitted(records: list[Record]) -> NoiseStd:
        found = process_noise(model, _moving(records), known, latency=late, sizes=sizes)
        process = np.array(found.process)
        for name, std in table.process.items():
            process[model.state_names.index(name)] = std * np.sqrt(found.dt / task.dt)
        return NoiseStd(process, known, found.dt)

    noise = fitted(records)
    parts = [one for record in records for one in _overlapping(record)]
    if np.any(late) and np.any(records[0].past != task.past):
        # the log may begin with a run, which waited at its start
        first, core = parts[0]
        held = replace(first, past=task.past)
        std = np.where(guessed, WAITING_SPREAD, START_SPREAD) * sizes
        rivals = [first, held, replace(held, start=task.start, start_std=std)]
        likely = [one.loglik for one in smoothed(model, rivals, noise, latency=late)]
        if likeliest := int(np.argmax(np.nan_to_num(likely, nan=-np.inf))):
            records = [replace(one, past=task.past) for one in records]
            noise = fitted(records)
            parts = [one for record in records for one in _overlapping(record)]
            parts[0] = rivals[likeliest], core
    smooth = smoothed(model, [one for one, _ in parts], noise, latency=late)
    states = np.concatenate(
        [one.states[core] for one, (_, core) in zip(smooth, parts, strict=True)]
    )
    if not np.isfinite(states).all():
        raise refused("log.not_estimated", why=str(smooth[0].status))
    return np.concatenate([piece.times[core] for piece, core in parts]), states


def _complete(piece: Record, record: Record) -> bool:
    """Return whether every state that is measured in a record is measured in a piece of it."""
    seen, whole = (np.isfinite(one.measured).any(axis=0) for one in (piece, record))
    return bool((seen == whole).all())


def _overlapping(record: Record) -> Iterator[tuple[Record, slice]]:
    """Yield overlapping pieces of a record, each with the rows of it to keep."""
    h = float(record.times[1] - record.times[0])
    each, more = max(PIECE, round(PIECE_S / h)), max(OVERLAP, round(OVERLAP_S / h))
    rows = len(record.times)
    for first in range(0, rows, each):
        a, b = max(0, first - more), min(rows, first + each + more)
        piece = part(record, a, b - 1)
        if _complete(piece, record):
            yield piece, slice(first - a, min(first + each, rows) - a)


def _moving(records: Sequence[Record]) -> list[Record]:
    """Return the parts of records in which commands change, in pieces; everything if none does."""
    sent = records[0]
    changed = sent.command_times[1:][(np.diff(sent.commands, axis=0) != 0).any(axis=1)]
    h = float(records[0].times[1] - records[0].times[0])
    margin, span = max(MARGIN_S, h), max(PIECE_S, PIECE * h)
    first, last = (changed[0], changed[-1] + margin) if len(changed) else (-np.inf, np.inf)
    found = []
    for record in records:
        rows = np.flatnonzero((record.times >= first) & (record.times <= last))
        if len(rows) >= FEWEST_ROWS:
            found.append(part(record, int(rows[0]), int(rows[-1])))
    whole = found or records
    return [piece for record in whole for piece in cut(record, span) if _complete(piece, record)]
