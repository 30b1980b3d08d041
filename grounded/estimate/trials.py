"""The front door for stored trials: a model and trials in, states with their certainty out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from grounded.errors import GroundedError
from grounded.estimate.batch import Batch, batch_of
from grounded.estimate.filter import run
from grounded.estimate.filtered import Filtered
from grounded.estimate.likelihood import NoiseEstimate, noise_of_records
from grounded.estimate.measurement import Measurement, Noise, of_states
from grounded.estimate.record import Record, records_of
from grounded.estimate.smoother import smooth
from grounded.estimate.steps import ModelSteps
from grounded.frozen import Array
from grounded.model import Model
from grounded.trial import Trial


@dataclass(frozen=True, eq=False)
class Estimated:
    """States of one trial as a filter or a smoother sees them.

    Innovations are those of the filter in both cases: NaN where nothing was measured.
    """

    times: Array  # (T + 1,) [s]
    states: Array  # (T + 1, n)
    covariance: Array  # (T + 1, n, n)
    innovations: Array  # (T + 1, ny)
    innovation_covariance: Array  # (T + 1, ny, ny)
    loglik: float  # of this trial's innovations
    status: str

    @property
    def std(self) -> Array:
        """Standard deviations (T + 1, n)."""
        diagonal = np.diagonal(self.covariance, axis1=-2, axis2=-1)
        return np.asarray(np.sqrt(np.maximum(diagonal, 0.0)))


def filter_trials(
    model: Model,
    trials: Sequence[Trial | Record],
    noise: Noise,
    *,
    latency: Array | None = None,
    measurement: Measurement | None = None,
) -> list[Estimated]:
    """The extended Kalman filter along each trial: what was known at each instant.

    Args:
        model: n states, m inputs.
        trials: real trials, or records with clocks of their own.
        noise: see `noise_of`.
        latency: transport delay of each input [s], (m,); None: zero.
        measurement: what the records measure; None: the states as they are.

    Raises:
        GroundedError: if a trial does not fit the model or the measurement.
    """
    records, batch, filtered, measurement = _passed(model, trials, noise, latency, measurement)
    return _estimates(records, batch, filtered, filtered.x, filtered.P)


def smooth_trials(
    model: Model,
    trials: Sequence[Trial | Record],
    noise: Noise,
    *,
    latency: Array | None = None,
    measurement: Measurement | None = None,
) -> list[Estimated]:
    """The smoother along each trial: what is known afterwards. Arguments as `filter_trials`."""
    records, batch, filtered, measurement = _passed(model, trials, noise, latency, measurement)
    if not np.isfinite(filtered.loglik):
        return _estimates(records, batch, filtered, filtered.x, filtered.P)
    back = smooth(filtered, batch)
    return _estimates(records, batch, filtered, back.x, back.P)


def noise_of(
    model: Model,
    trials: Sequence[Trial | Record],
    *,
    latency: Array | None = None,
    measurement: Measurement | None = None,
    rng: np.random.Generator | None = None,
) -> NoiseEstimate:
    """Process and measurement noise of a model on trials, by maximum likelihood.

    What the model gets wrong counts as process noise here: fit the model first, or take it as a
    measure of the model. Of more than 8,000 samples a draw of whole trials is used (`rng`).
    Arguments as `filter_trials`.

    Raises:
        GroundedError: if a trial does not fit the model, or no trial has two samples.
    """
    measurement = of_states(model) if measurement is None else measurement
    records = records_of(model, trials)
    if max(r.steps for r in records) < 2:
        raise GroundedError("noise can't be estimated: no trial has more than two samples")
    delay = np.zeros(model.m) if latency is None else np.asarray(latency, float)
    return noise_of_records(model.system, model.values, records, measurement, delay, rng)


def _passed(
    model: Model,
    trials: Sequence[Trial | Record],
    noise: Noise,
    latency: Array | None,
    measurement: Measurement | None,
) -> tuple[list[Record], Batch, Filtered, Measurement]:
    measurement = of_states(model) if measurement is None else measurement
    if len(noise.process) != model.n or len(noise.measurement) != measurement.ny:
        raise GroundedError(
            f"noise for {model.n} states and {measurement.ny} channels is needed, got "
            f"{len(noise.process)} and {len(noise.measurement)}"
        )
    records = records_of(model, trials)
    delay = np.zeros(model.m) if latency is None else np.asarray(latency, float)
    batch = batch_of(records, measurement, model.n, delay)
    steps = ModelSteps(model.system, model.values, batch)
    return records, batch, run(batch, measurement, noise, steps), measurement


def _estimates(
    records: list[Record], batch: Batch, filtered: Filtered, x: Array, P: Array
) -> list[Estimated]:
    found = []
    for b, record in enumerate(records):
        rows = slice(0, record.steps + 1)
        seen, C = batch.seen[rows, b], filtered.C[rows, b]
        log_det = np.log(np.maximum(np.diagonal(C, axis1=-2, axis2=-1), 1e-300))
        loglik = -0.5 * float(np.sum(filtered.eps[rows, b] ** 2)) + float(log_det[seen].sum())
        loglik -= 0.5 * np.log(2 * np.pi) * int(seen.sum())
        with np.errstate(all="ignore"):
            try:
                S = np.linalg.inv(C.transpose(0, 2, 1) @ C)
            except np.linalg.LinAlgError:
                S = np.full_like(C, np.nan)
        e = np.where(seen, filtered.e[rows, b], np.nan)
        status = filtered.status
        if not np.isfinite(filtered.loglik):
            loglik = -np.inf
        found.append(
            Estimated(record.times, x[rows, b], P[rows, b], e, np.asarray(S), loglik, status)
        )
    return found
