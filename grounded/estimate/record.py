"""Record: measurements and commands of a run, each with its own times; and batches of records.

    y_i = H x(t_i) + v_i,          u_j(t) = command_j(t - latency_j)

A record may combine a camera at 30 Hz and a controller at 20 Hz: states are estimated at the
instants `times`, and the input over [t_i, t_i+1] is the mean of the held commands over
[t_i - latency, t_i+1 - latency]. On a common grid this equals the delay queue of
`grounded.compile.problem`, including fractions of a step. A lost sample is NaN.

A filter is a recursion over time; it is fast if it runs over all trials at once. So records are
combined to a `RecordBatch`: time first, then trial, padded to the longest. Padding and lost samples
are not `seen`; steps in the padding are not `valid`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from grounded.checks import known, list_of, of_shape, refused, same_names, wrong
from grounded.estimate.measurement import Measurement
from grounded.frozen import Array, readonly
from grounded.model import Model
from grounded.trial import Trial


@dataclass(frozen=True, eq=False)
class Record:
    """One run with ny measured channels, m inputs and n states.

    Args:
        times: instants at which states are estimated, ascending [s], (T + 1,).
        measured: measurements y, NaN where nothing was measured, (T + 1, ny).
        command_times: times at which commands were sent, ascending [s], (M,).
        commands: commands, each held from its time on, (M, m).
        past: command held before the first one, (m,); None for zero.
        start: prior mean of the first state, used for states that no channel measures, (n,); or of
            the state at each time, (T + 1, n), so that parts of the record have one too; None for
            zero.
        start_std: prior standard deviation of the first state, (n,), or of the state at each time,
            (T + 1, n); None for 1 in each unit.
        id: id of the trial it came from.

    Raises:
        GroundedError: if the shapes do not match or times do not ascend.
    """

    times: Array
    measured: Array
    command_times: Array
    commands: Array
    past: Array | None = None
    start: Array | None = None
    start_std: Array | None = None
    id: str = ""

    def __post_init__(self) -> None:
        for name in ("times", "measured", "command_times", "commands"):
            object.__setattr__(self, name, readonly(getattr(self, name)))
        past = np.zeros(self.commands.shape[-1]) if self.past is None else self.past
        object.__setattr__(self, "past", readonly(past))
        for times, rows, what in (
            (self.times, self.measured, "measured"),
            (self.command_times, self.commands, "commands"),
        ):
            if times.ndim != 1 or rows.ndim != 2 or len(times) != len(rows) or not len(times):
                raise wrong(f"{what} of a record", rows.shape, shape=f"({len(times)}, m)")
            if not (np.diff(times) > 0).all():
                raise wrong(f"times of {what}", must="ascending")
        if not np.isfinite(self.commands).all():
            object.__setattr__(self, "commands", _held(self.commands, np.asarray(self.past)))

    @property
    def steps(self) -> int:
        """T, the number of steps."""
        return len(self.times) - 1

    def received(self, latency: Array) -> Array:
        """Return the inputs received over each step, (T, m).

        Args:
            latency: latency of each input [s], (m,).
        """
        total = [self._integral(self.times - late, j) for j, late in enumerate(latency)]
        return np.diff(np.stack(total, axis=1), axis=0) / np.diff(self.times)[:, None]

    def _integral(self, t: Array, j: int) -> Array:
        """Return the integral of command j from the first command to t."""
        past = np.asarray(self.past)
        knots, values = self.command_times, np.append(past[j], self.commands[:, j])
        total = np.append(0.0, np.cumsum(values[1:-1] * np.diff(knots)))
        index = np.searchsorted(knots, t, side="right")
        at = np.maximum(index - 1, 0)
        return np.asarray(total[at] + values[index] * (t - knots[at]))


def _held(commands: Array, past: Array) -> Array:
    """Replace lost samples of commands by the previous ones."""
    whole = np.vstack([past, commands])
    bad = ~np.isfinite(whole)
    row = np.where(bad, 0, np.arange(len(whole))[:, None])
    held = np.take_along_axis(whole, np.maximum.accumulate(row, axis=0), axis=0)[1:]
    return np.asarray(readonly(held))


def record_of(model: Model, trial: Trial) -> Record:
    """Convert a trial to a record that measures the model's states.

    States are matched by name; states that the trial lacks are NaN, that is, not measured.

    Raises:
        GroundedError: if the trial lacks an input of the model or has none of its states.
    """
    for name in model.input_names:
        known("input", [name], trial.input_names, "the trial")
    if not set(model.state_names) & set(trial.state_names):
        same_names("the trial", "states", trial.state_names, model.state_names)
    measured = np.full((len(trial.states), model.n), np.nan)
    for i, name in enumerate(model.state_names):
        if name in trial.state_names:
            measured[:, i] = trial.states[:, trial.state_names.index(name)]
    measured[~np.isfinite(measured)] = np.nan
    order = [trial.input_names.index(name) for name in model.input_names]
    times = np.arange(len(trial.states), dtype=float) * trial.dt
    past = None if trial.start_inputs is None else trial.start_inputs[order]
    return Record(
        times=times,
        measured=measured,
        command_times=times[: max(trial.steps, 1)],
        commands=trial.inputs[:, order] if trial.steps else np.zeros((1, model.m)),
        past=past,
        id=trial.id,
    )


def cut(record: Record, seconds: float) -> list[Record]:
    """Cut a record into pieces of about `seconds`, each with its own unknown start state.

    Filters run over many pieces at once, so half an hour takes little longer than a minute.
    """
    span = record.times[-1] - record.times[0]
    pieces = max(1, round(span / seconds))
    edges = np.linspace(0, record.steps, pieces + 1).round().astype(int)
    return [part(record, int(a), int(b)) for a, b in pairwise(edges)]


def part(record: Record, first: int, last: int) -> Record:
    """Return rows first .. last of a record with all commands (latency needs earlier ones)."""
    rows = slice(first, last + 1)
    start, std = record.start, record.start_std
    if std is not None and std.ndim == 2:
        std = std[rows]
    elif first > 0 and start is not None and start.ndim == 1:
        std = None  # it was that of a start that is not this part's
    if start is not None and start.ndim == 2:
        start = start[rows]
    elif first > 0:
        start = None
    times, measured = record.times[rows], record.measured[rows]
    return replace(record, times=times, measured=measured, start=start, start_std=std)


def records_of(model: Model, trials: Sequence[Trial | Record]) -> list[Record]:
    """Convert trials to records; records are kept.

    Raises:
        GroundedError: if there are none, or one does not match the model.
    """
    given = [trials] if isinstance(trials, Trial | Record) else trials
    trials = list_of(given, (Trial, Record), "trials")
    records = [t if isinstance(t, Record) else record_of(model, t) for t in trials]
    if not records:
        raise refused("search.no_trial")
    for record in records:
        of_shape("commands of a record", record.commands, (len(record.commands), model.m))
    return records


START_STD = 1.0  # prior standard deviation of an unmeasured first state, in its unit


@dataclass(frozen=True, eq=False)
class RecordBatch:
    """B records of at most T steps; n states, m inputs, ny channels."""

    y: Array  # (T + 1, B, ny), zero where not seen
    seen: NDArray[np.bool_]  # (T + 1, B, ny)
    u: Array  # (T, B, m) inputs as received
    dt: Array  # (T, B) [s]
    valid: NDArray[np.bool_]  # (T, B)
    lengths: NDArray[np.int64]  # (B,) steps of each record
    start: Array  # (B, n) mean of the first state
    start_var: Array  # (B, n) its variance, without the measurement noise
    start_channel: NDArray[np.int64]  # (B, n) channel that measured the start; -1 for none

    @cached_property
    def count(self) -> int:
        """Number of samples in the likelihood."""
        return int(self.seen.sum())

    @cached_property
    def steps_of(self) -> tuple[tuple[float, NDArray[np.bool_] | None], ...]:
        """Step sizes in use [s], each with a mask of its steps (T, B); None for all steps."""
        sizes = np.unique(np.round(self.dt[self.valid], 9))
        if len(sizes) == 1:
            return ((float(sizes[0]), None),)
        return tuple((float(h), np.abs(self.dt - h) < 1e-9) for h in sizes)


def batch_of(
    records: Sequence[Record], measurement: Measurement, n: int, latency: Array
) -> RecordBatch:
    """Combine records to a batch.

    Args:
        records: at least one record.
        measurement: what `Record.measured` measures.
        n: number of states.
        latency: latency of each input [s], (m,).

    Raises:
        GroundedError: if a record has another number of channels than the measurement.
    """
    B, T, ny = len(records), max(r.steps for r in records), measurement.ny
    m = records[0].commands.shape[1]
    y, seen = np.zeros((T + 1, B, ny)), np.zeros((T + 1, B, ny), dtype=bool)
    u, dt = np.zeros((T, B, m)), np.zeros((T, B))
    starts = []
    for b, record in enumerate(records):
        of_shape("measurements of a record", record.measured, (len(record.measured), ny))
        t = record.steps
        seen[: t + 1, b] = np.isfinite(record.measured)
        y[: t + 1, b] = np.where(seen[: t + 1, b], record.measured, 0.0)
        u[:t, b] = record.received(latency)
        dt[:t, b] = np.diff(record.times)
        starts.append(_start(record, measurement, n))
        seen[0, b, starts[-1][2][starts[-1][2] >= 0]] = False
    start, var, channel = (np.array(column) for column in zip(*starts, strict=True))
    lengths = np.array([r.steps for r in records])
    valid = np.arange(T)[:, None] < lengths
    return RecordBatch(y, seen, u, dt, valid, lengths, start, var, channel)


def _start(
    record: Record, measurement: Measurement, n: int
) -> tuple[Array, Array, NDArray[np.int64]]:
    """Return mean (n,), variance without measurement noise (n,) and channel (n,) of the start.

    A measured state starts at its first sample, with that sample's noise; the sample is then not
    used a second time.
    """
    mean = np.zeros(n) if record.start is None else np.array(np.atleast_2d(record.start)[0])
    std = np.full(n, START_STD) if record.start_std is None else record.start_std
    given = np.array(np.atleast_2d(std)[0])
    var, channel = given**2, np.full(n, -1)
    for c, i in enumerate(measurement.states):
        finite = np.flatnonzero(np.isfinite(record.measured[:, c]))
        if len(finite) == 0:
            continue
        mean[i] = record.measured[finite[0], c]
        if finite[0] == 0:
            channel[i], var[i] = c, 0.0
        else:  # measured only later: it may have changed by as much as it varies in this record
            var[i] = max(float(np.var(record.measured[finite, c])), 1e-12)
    return mean, var, channel
