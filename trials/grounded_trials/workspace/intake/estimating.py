"""States that no sensor gives: the smoother of `grounded.estimate`, along a whole log.

    [estimate]
    measured = { x = 0.002, y = 0.002, psi = 0.005 }   # standard deviation of each measured state
    process = { v = 0.05 }                             # optional, a control step; else estimated

The measured states are filtered forth and back through the model that plans, the crude one with all
effects that were adopted, on a clock about as fine as
they were sampled. Its process noise is estimated from the same log by maximum likelihood, where
commands change: what the model gets wrong shows in motion, not while the robot waits. All of a log
is smoothed before a run is sought in it or cut out of it, since what comes before the start of a
run and after its end says how fast the robot was there.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.effects.places import probe
from grounded.errors import GroundedError
from grounded.estimate.record import Record
from grounded.frozen import Array
from grounded.model import Model
from grounded.task import Task
from grounded_trials.formats.messages import Ints
from grounded_trials.logs.samples import Samples, check_overlap, tidy
from grounded_trials.logs.signals import Series, SignalSpec
from grounded_trials.toml_table import Table

FINEST = 8  # rows of the smoother in a control step
PIECE_S = 5.0  # of the log are filtered in step with others: half an hour costs little more
OVERLAP_S = 1.5  # by which they know of each other
LEAST = 3  # rows that can be smoothed
MARGIN_S = 0.5  # of motion after the last change of a command
WIDE = 10.0  # times as large as a state gets in a log: what is known of its first value
EXACT = 1e-3  # of a step of the smoother: it is a whole multiple of a simulator's own
SIZED = 256  # moments at which that is asked


@dataclass(frozen=True)
class EstimateTable:
    """[estimate]: which states are measured, and how well."""

    measured: dict[str, float]
    process: dict[str, float]


def read_estimate(table: Table, model: Model) -> EstimateTable:
    """The checked [estimate] table, what is measured in the model's order.

    Raises:
        GroundedError: for an unknown state, or a standard deviation that is not positive.
    """
    measured = table.numbers("measured", model.state_names)
    process = table.numbers("process", model.state_names)
    table.finish()
    for kind, values in (("measured", measured), ("process", process)):
        for name, std in values.items():
            if std <= 0:
                raise table.error(f"{kind}.{name}", f"must be a positive deviation, found {std:g}")
    if not measured:
        raise table.error("measured", "names no state; give { x = 0.002, ... }")
    ordered = {name: measured[name] for name in model.state_names if name in measured}
    return EstimateTable(ordered, process)


def with_estimates(
    series: Mapping[str, Series],
    table: EstimateTable,
    task: Task,
    asked: Sequence[str] | None = None,
) -> dict[str, Series]:
    """A log's signals, and beside them those of the states that nothing measures.

    Args:
        series: the samples of every measured state and every input, in any order.
        table: which are measured, and how well.
        task: with the model, its latency and the control step.
        asked: states to estimate; None: all of the model's. Memories of effects are no signals.

    Raises:
        GroundedError: for samples that can't be used, or where the smoother fails.
    """
    model = task.model
    guessed = [name for name in asked or model.state_names if name not in table.measured]
    if not guessed:
        return dict(series)
    samples = [tidy(n, series[n], unwrap=n in model.angles) for n in table.measured]
    sent = [tidy(name, series[name], unwrap=False) for name in model.input_names]
    check_overlap(samples, sent)
    clock = _Clock.of(samples, min(int(s.t[0]) for s in (*samples, *sent)), task)
    records = _records(samples, sent, clock, task.dt)
    if not records:
        return dict(series)
    times, states = _smoothed(records, table, task, _sizes(samples, task))
    t, first = clock.stamps(times), series[next(iter(table.measured))]
    found = dict(series)
    for name in guessed:
        values = states[:, model.state_names.index(name)]
        spec = SignalSpec(f"/estimate.{name}", first.spec.clock)
        logged = t - round(float(np.median(first.t - first.log_times)))
        found[name] = replace(first, spec=spec, t=t, values=values, log_times=logged)
    return found


@dataclass(frozen=True)
class _Clock:
    """Rows every `step` seconds from `origin`, a little beyond the samples on both sides."""

    origin: int  # [ns]
    step: float  # [s]
    rows: int

    @classmethod
    def of(cls, samples: Sequence[Samples], earliest: int, task: Task) -> _Clock:
        """Of the measured samples, not before the earliest of all: a log's time begins there."""
        dt, every = task.dt, min(s.interval for s in samples)
        finest = int(np.clip(np.ceil(dt / every - 0.01), 1, FINEST))
        parts = (k for k in range(finest, 0, -1) if _makes(task.model, dt / k))
        step = dt / next(parts, 1)
        margin = round(dt * 1e9)  # half an interval beyond its samples a signal is still known
        first, last = max(s.t[0] for s in samples), min(s.t[-1] for s in samples)
        origin = max(int(first) - margin, earliest)
        rows = int(np.ceil((int(last) + margin - origin) * 1e-9 / step)) + 1
        return cls(origin, step, max(rows, 0))

    def stamps(self, times: Array) -> Ints:
        return self.origin + np.round(times * 1e9).astype(np.int64)


def _makes(model: Model, step: float) -> bool:
    """Whether the model's simulator, if it is one, can make a step so long [s]."""
    return abs(probe(model, step) - step) < EXACT * step


def _records(
    samples: Sequence[Samples], sent: Sequence[Samples], clock: _Clock, dt: float
) -> list[Record]:
    """The stretches of a log in which nothing is lost for long, every sample at the nearest row."""
    times: Array = np.arange(clock.rows, dtype=np.float64) * clock.step
    measured, known = np.full((len(times), len(samples)), np.nan), np.ones(len(times), bool)
    for column, s in zip(measured.T, samples, strict=True):
        t = (s.t - clock.origin) * 1e-9
        rows = np.unique(np.rint(t / clock.step).astype(int))
        rows = rows[(rows >= 0) & (rows < len(times))]
        column[rows] = np.interp(times[rows], t, s.y)
        for k in np.flatnonzero(np.diff(t) > s.max_gap(dt)):
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
        if b - a >= LEAST and np.isfinite(measured[a:b]).any(axis=0).all()
    ]


def _sizes(samples: Sequence[Samples], task: Task) -> Array:
    """About how large states get, (n,): as what they make of measured ones in a step; else 1."""
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
    return np.where(np.isfinite(sizes), sizes, 1.0)


def _smoothed(
    records: list[Record], table: EstimateTable, task: Task, sizes: Array
) -> tuple[Array, Array]:
    """When states are known, (N,) [s], and the states, (N, n)."""
    from grounded.estimate import NoiseStd, noise_of, of_states, smooth_trials

    model, known = task.model, np.array(list(table.measured.values()))
    measurement = of_states(model, list(table.measured))
    options = {"latency": task.latency, "measurement": measurement}
    records = [replace(record, start_std=WIDE * sizes) for record in records]
    found = noise_of(model, _moving(records), known=known, sizes=sizes, **options)  # type: ignore[arg-type]
    process = np.array(found.noise.process)
    for name, std in table.process.items():
        process[model.state_names.index(name)] = std * np.sqrt(found.noise.dt / task.dt)
    noise = NoiseStd(process=process, measurement=known, dt=found.noise.dt)
    parts = [one for record in records for one in _overlapping(record)]
    smooth = smooth_trials(model, [one for one, _ in parts], noise, **options)  # type: ignore[arg-type]
    kept = [one.states[core] for one, (_, core) in zip(smooth, parts, strict=True)]
    states = np.concatenate(kept)
    if not np.isfinite(states).all():
        raise GroundedError(
            f"the smoother finds no finite states for this log ({smooth[0].status}): the "
            "model is too far off to tell what was not measured; check its units and the [log] "
            "mapping"
        )
    return np.concatenate([one.times[core] for one, core in parts]), states


def _overlapping(record: Record) -> Iterator[tuple[Record, slice]]:
    """Pieces that begin before what is kept of them and end after it, and the rows to keep."""
    from grounded.estimate.record import part

    h = float(record.times[1] - record.times[0])
    each, more, rows = max(1, round(PIECE_S / h)), round(OVERLAP_S / h), len(record.times)
    for first in range(0, rows, each):
        a, b = max(0, first - more), min(rows, first + each + more)
        piece = part(record, a, b - 1)
        if np.isfinite(piece.measured).any(axis=0).all():
            yield piece, slice(first - a, min(first + each, rows) - a)


def _moving(records: Sequence[Record]) -> list[Record]:
    """The parts of records in which commands change, in pieces; all of it where none does."""
    from grounded.estimate.record import cut, part

    sent = records[0]
    changed = sent.command_times[1:][(np.diff(sent.commands, axis=0) != 0).any(axis=1)]
    first, last = (changed[0], changed[-1] + MARGIN_S) if len(changed) else (-np.inf, np.inf)
    found = []
    for record in records:
        rows = np.flatnonzero((record.times >= first) & (record.times <= last))
        if len(rows) >= LEAST:
            found.append(part(record, int(rows[0]), int(rows[-1])))
    pieces = [piece for record in found or records for piece in cut(record, PIECE_S)]
    return [piece for piece in pieces if np.isfinite(piece.measured).any(axis=0).all()]
