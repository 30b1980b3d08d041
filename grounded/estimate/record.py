"""Record: measured states and commands of a run, each with its own times; and batches of records.

    y_i = x(t_i) + v_i,          u_j(t) = command_j(t - latency_j)

A record may combine a camera at 30 Hz and a controller at 20 Hz: states are estimated at the
instants `times`, and the input over [t_i, t_i+1] is the mean of the held commands over
[t_i - latency, t_i+1 - latency]. On a common grid this equals the delay queue of
`grounded.compile.problem`, including fractions of a step. A lost sample is NaN, and so is a state
that nothing measures.

A filter is a recursion over time; it is fast if it runs over all trials at once. So records are
combined to a `RecordBatch`: time first, then trial, padded to the longest. Padding and lost samples
are not `seen`; steps in the padding are not `valid`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from grounded.checks import known, same_names, wrong
from grounded.frozen import Array, readonly
from grounded.model import Model
from grounded.trial import Trial

START_STD = 1.0  # prior standard deviation of an unmeasured first state, in its unit


@dataclass(frozen=True, eq=False)
class Record:
    """One run with n states and m inputs.

    Args:
        times: instants at which states are estimated, evenly spaced [s], (T + 1,).
        measured: measured states, NaN where nothing was measured, (T + 1, n).
        command_times: times at which commands were sent, ascending [s], (M,).
        commands: commands, each held from its time on, (M, m).
        past: command held before the first one, (m,); None for zero.
        start: prior mean of the first state, used for states without a measurement, (n,); None for
            zero.
        start_std: prior standard deviation of the first state, (n,); None for 1 in each unit.

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
    """Convert a trial to a record of the model's states, matched by name; NaN where it lacks one.

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
    sent = trial.inputs[:, order] if trial.steps else np.zeros((1, model.m))
    return Record(times, measured, times[: max(trial.steps, 1)], sent, past)


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
    return replace(record, times=record.times[rows], measured=record.measured[rows])


@dataclass(frozen=True, eq=False)
class RecordBatch:
    """B records of at most T steps of dt; n states, m inputs."""

    dt: float  # [s]
    y: Array  # (T + 1, B, n), zero where not seen
    seen: Any  # (T + 1, B, n) of bool
    u: Array  # (T, B, m) inputs as received
    valid: Any  # (T, B) of bool
    start: Array  # (B, n) mean of the first state
    start_var: Array  # (B, n) its variance, without the measurement noise
    sampled: Any  # (B, n) of bool: the start is a sample, and has its noise

    @property
    def count(self) -> int:
        """Number of samples in the likelihood."""
        return int(self.seen.sum())


def batch_of(records: Sequence[Record], latency: Array | None = None) -> RecordBatch:
    """Combine records of one step size to a batch.

    A measured state starts at its first sample, with that sample's noise; the sample is then not
    used a second time. If it was measured only later, it may have changed by as much as it varies.

    Args:
        records: at least one record.
        latency: latency of each input [s], (m,); None for zero.
    """
    (_, n), m, B = records[0].measured.shape, records[0].commands.shape[1], len(records)
    T, late = max(r.steps for r in records), np.zeros(m) if latency is None else latency
    y, u = np.full((T + 1, B, n), np.nan), np.zeros((T, B, m))
    start, var, sampled = np.zeros((B, n)), np.empty((B, n)), np.zeros((B, n), dtype=bool)
    for b, record in enumerate(records):
        y[: record.steps + 1, b], u[: record.steps, b] = record.measured, record.received(late)
        start[b] = 0.0 if record.start is None else record.start
        var[b] = np.square(START_STD if record.start_std is None else record.start_std)
        for i in range(n):
            known_at = np.flatnonzero(np.isfinite(record.measured[:, i]))
            if len(known_at):
                start[b, i], sampled[b, i] = record.measured[known_at[0], i], known_at[0] == 0
                spread = max(float(np.var(record.measured[known_at, i])), 1e-12)
                var[b, i] = 0.0 if sampled[b, i] else spread
    seen = np.isfinite(y)
    seen[0] = False
    valid = np.arange(T)[:, None] < np.array([r.steps for r in records])
    dt = round(float(records[0].times[1] - records[0].times[0]), 9) if T else 1.0
    return RecordBatch(dt, np.where(seen, y, 0.0), seen, u, valid, start, var, sampled)
