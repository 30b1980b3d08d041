"""Records side by side: time first, then trial, padded to the longest, gaps marked.

A filter is a recursion over time; running it over all trials at once is what makes it fast in
NumPy. Padding and lost samples are rows that are not `seen`, steps that are not `valid`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from grounded.errors import GroundedError
from grounded.estimate.measurement import Measurement
from grounded.estimate.record import Record
from grounded.frozen import Array

START_STD = 1.0  # of a first state that nothing measures, in its unit


@dataclass(frozen=True, eq=False)
class Batch:
    """B records of at most T steps; n states, m inputs, ny channels."""

    y: Array  # (T + 1, B, ny), zero where not seen
    seen: NDArray[np.bool_]  # (T + 1, B, ny)
    u: Array  # (T, B, m) as received
    u_latency: Array  # (T, B, m) derivative of u by the input's latency
    dt: Array  # (T, B) [s]
    valid: NDArray[np.bool_]  # (T, B)
    lengths: NDArray[np.int64]  # (B,) steps of each record
    start: Array  # (B, n)
    start_var: Array  # (B, n) without the measurement noise
    start_channel: NDArray[np.int64]  # (B, n) the channel whose noise the start has; -1: none

    @cached_property
    def whole(self) -> bool:
        """Every channel seen at every row but the first."""
        return bool(self.seen[1:].all())

    @cached_property
    def count(self) -> int:
        """Samples that enter the likelihood."""
        return int(self.seen.sum())

    @cached_property
    def steps_of(self) -> tuple[tuple[float, NDArray[np.bool_] | None], ...]:
        """Step sizes in use, each with its steps (T, B); None: all of them."""
        sizes = np.unique(np.round(self.dt[self.valid], 9))
        if len(sizes) == 1:
            return ((float(sizes[0]), None),)
        return tuple((float(h), np.abs(self.dt - h) < 1e-9) for h in sizes)


def batch_of(records: Sequence[Record], measurement: Measurement, n: int, latency: Array) -> Batch:
    """Records side by side.

    Args:
        records: at least one.
        measurement: what `Record.measured` measures.
        n: number of states.
        latency: of each input [s], (m,).

    Raises:
        GroundedError: if a record has another number of channels than the measurement.
    """
    B, T, ny = len(records), max(r.steps for r in records), measurement.ny
    m = records[0].commands.shape[1]
    y, seen = np.zeros((T + 1, B, ny)), np.zeros((T + 1, B, ny), dtype=bool)
    u, slope, dt = np.zeros((T, B, m)), np.zeros((T, B, m)), np.zeros((T, B))
    starts = []
    for b, record in enumerate(records):
        if record.measured.shape[1] != ny:
            raise GroundedError(
                f"the measurement has {ny} channels ({', '.join(measurement.names)}), a record "
                f"has {record.measured.shape[1]}"
            )
        t = record.steps
        seen[: t + 1, b] = np.isfinite(record.measured)
        y[: t + 1, b] = np.where(seen[: t + 1, b], record.measured, 0.0)
        u[:t, b], slope[:t, b] = record.received(latency)
        dt[:t, b] = np.diff(record.times)
        starts.append(_start(record, measurement, n))
        seen[0, b, starts[-1][2][starts[-1][2] >= 0]] = False
    start, var, channel = (np.array(column) for column in zip(*starts, strict=True))
    lengths = np.array([r.steps for r in records])
    valid = np.arange(T)[:, None] < lengths
    return Batch(y, seen, u, slope, dt, valid, lengths, start, var, channel)


def _start(
    record: Record, measurement: Measurement, n: int
) -> tuple[Array, Array, NDArray[np.int64]]:
    """Mean (n,), variance beside the measurement noise (n,) and channel (n,) of the first state.

    A state that is measured starts at its first sample, with that sample's noise; the sample is
    then not used a second time.
    """
    mean = np.zeros(n) if record.start is None else np.array(record.start)
    given = np.full(n, START_STD) if record.start_std is None else np.array(record.start_std)
    var, channel = given**2, np.full(n, -1)
    for c, i in enumerate(measurement.states):
        finite = np.flatnonzero(np.isfinite(record.measured[:, c]))
        if i < 0 or len(finite) == 0:
            continue
        mean[i] = record.measured[finite[0], c]
        if finite[0] == 0:
            channel[i], var[i] = c, 0.0
        else:  # first seen later: it may have moved as far as it ever does in this record
            var[i] = max(float(np.var(record.measured[finite, c])), 1e-12)
    return mean, var, channel
