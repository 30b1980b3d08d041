"""Prediction errors of a model: one step and a second ahead, open loop.

Every window starts from the smoothed state, not from a raw sample, whose noise would count as an
error of the model. The inputs are the recorded ones with the model's delay. Errors are relative to
the raw samples, so measurement noise is the floor of both errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grounded.estimate import Measurement, NoiseStd, Record, noise_of, of_states
from grounded.estimate.extended import filter_batch, smooth
from grounded.estimate.record import RecordBatch, batch_of, records_of
from grounded.estimate.steps import ModelSteps
from grounded.frozen import Array
from grounded.model import Model
from grounded.trial import Trial

STARTS = 4000  # most windows; more would not change the result


@dataclass(frozen=True, eq=False)
class PredictionError:
    """Root mean square errors per channel; NaN for a channel never seen at a window's end."""

    names: tuple[str, ...]
    one_step: Array  # (ny,) in the channels' units
    ahead: Array  # (ny,) after `horizon_s`
    horizon_s: float  # [s]
    windows: int  # number of windows of `horizon_s`; 0 if no trial is long enough


def prediction_error(
    model: Model,
    trials: Sequence[Trial | Record],
    horizon_s: float = 1.0,
    *,
    latency: Array | None = None,
    measurement: Measurement | None = None,
    noise: NoiseStd | None = None,
) -> PredictionError:
    """Return the open-loop prediction errors of a model on trials, one step and `horizon_s` ahead.

    Args:
        model: n states, m inputs.
        trials: real trials, or records.
        horizon_s: prediction horizon [s].
        latency: transport delay of each input [s], (m,); None for zero.
        measurement: what the records measure; None for the states.
        noise: noise of this model on these trials, used to smooth the start states; None to
            estimate it.

    Raises:
        GroundedError: if a trial does not match the model.
    """
    measurement = of_states(model) if measurement is None else measurement
    delay = np.zeros(model.m) if latency is None else np.asarray(latency, float)
    records = records_of(model, trials)
    if noise is None:
        options = {"latency": delay, "measurement": measurement}
        noise = noise_of(model, records, **options).noise  # type: ignore[arg-type]
    batch = batch_of(records, measurement, model.n, delay)
    filtered = filter_batch(
        batch, measurement, noise, ModelSteps(model.system, model.values, batch)
    )
    x = smooth(filtered).x if np.isfinite(filtered.loglik) else filtered.x
    steps = max(1, round(horizon_s / noise.dt))
    one, ahead, windows = _windows(model, batch, measurement, x, steps)
    return PredictionError(measurement.names, one, ahead, steps * noise.dt, windows)


def _windows(
    model: Model, batch: RecordBatch, measurement: Measurement, x: Array, steps: int
) -> tuple[Array, Array, int]:
    """Return the rms errors after one step and after `steps`, and the number of windows."""
    first, trial = np.nonzero(batch.valid)
    error = _error(model, batch, measurement, x, first, trial, 1)
    one = rms(error)
    whole = first + steps <= batch.lengths[trial]
    first, trial = first[whole], trial[whole]
    if len(first) == 0:
        return one, np.full(measurement.ny, np.nan), 0
    every = max(1, len(first) // STARTS)
    first, trial = first[::every], trial[::every]
    return one, rms(_error(model, batch, measurement, x, first, trial, steps)), len(first)


def _error(
    model: Model,
    batch: RecordBatch,
    measurement: Measurement,
    x: Array,
    first: NDArray[np.int64],
    trial: NDArray[np.int64],
    steps: int,
) -> Array:
    """Return the errors (windows, ny) after `steps`; NaN for lost samples."""
    state = x[first, trial]
    with np.errstate(all="ignore"):
        for i in range(steps):
            u, h = batch.u[first + i, trial], batch.dt[first + i, trial]
            after = np.empty_like(state)
            for size in np.unique(np.round(h, 9)):
                rows = np.abs(h - size) < 1e-9
                after[rows] = model.system.step(state[rows], u[rows], model.values, float(size))
            state = after
        e = measurement.innovation(batch.y[first + steps, trial], measurement.function(state))
    return np.where(batch.seen[first + steps, trial], e, np.nan)


def rms(error: Array) -> Array:
    """Return the rms along the first axis, NaN for a channel without a known error."""
    count = np.sum(~np.isnan(error), axis=0)
    total = np.nansum(error**2, axis=0)
    return np.asarray(np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan))
