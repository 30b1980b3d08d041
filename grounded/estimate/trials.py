"""Estimate states and noise from stored trials: the public functions of this package."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from grounded.checks import of_shape, refused
from grounded.estimate.extended import Filtered, filter_batch, smooth
from grounded.estimate.likelihood import NoiseEstimate, enough, first_noise, maximum_likelihood
from grounded.estimate.measurement import Measurement, NoiseStd, of_states
from grounded.estimate.record import Record, RecordBatch, batch_of, records_of
from grounded.estimate.steps import ModelSteps
from grounded.frozen import Array
from grounded.model import Model
from grounded.trial import Trial


@dataclass(frozen=True, eq=False)
class Estimated:
    """Estimated states of one trial, by the filter or the smoother.

    Innovations are the filter's in both cases; NaN where nothing was measured.
    """

    times: Array  # (T + 1,) [s]
    states: Array  # (T + 1, n)
    covariance: Array  # (T + 1, n, n)
    innovations: Array  # (T + 1, ny)
    innovation_covariance: Array  # (T + 1, ny, ny)
    loglik: float  # log-likelihood of this trial's innovations
    status: str

    @property
    def std(self) -> Array:
        """Standard deviations (T + 1, n)."""
        diagonal = np.diagonal(self.covariance, axis1=-2, axis2=-1)
        return np.asarray(np.sqrt(np.maximum(diagonal, 0.0)))


def smooth_trials(
    model: Model,
    trials: Sequence[Trial | Record],
    noise: NoiseStd,
    *,
    latency: Array | None = None,
    measurement: Measurement | None = None,
    forward: bool = False,
) -> list[Estimated]:
    """Estimate the states of each trial with the smoother, from all of its measurements.

    For a state that no channel measures, the middle of the disturbance at each instant is returned,
    so that a rate is consistent with its integral (`grounded.estimate.extended.smooth`).

    Args:
        model: n states, m inputs.
        trials: real trials, or records with separate times of measurements and commands.
        noise: process and measurement noise, see `noise_of`.
        latency: transport delay of each input [s], (m,); None for zero.
        measurement: what the records measure; None for the states themselves.
        forward: use the extended Kalman filter alone, so that each estimate depends only on
            measurements up to its time.

    Raises:
        GroundedError: if a trial does not match the model or the measurement.
    """
    measurement = of_states(model) if measurement is None else measurement
    of_shape("process noise", noise.process, (model.n,))
    of_shape("measurement noise", noise.measurement, (measurement.ny,))
    records = records_of(model, trials)
    delay = np.zeros(model.m) if latency is None else np.asarray(latency, float)
    batch = batch_of(records, measurement, model.n, delay)
    steps = ModelSteps(model.system, model.values, batch)
    filtered = filter_batch(batch, measurement, noise, steps)
    if forward or not np.isfinite(filtered.loglik):
        return _estimates(records, batch, filtered, filtered.x, filtered.gains.posterior)
    back = smooth(filtered)
    return _estimates(records, batch, filtered, back.x, back.P)


def noise_of(
    model: Model,
    trials: Sequence[Trial | Record],
    *,
    latency: Array | None = None,
    measurement: Measurement | None = None,
    known: Array | None = None,
    sizes: Array | float = 1.0,
    rng: np.random.Generator | None = None,
) -> NoiseEstimate:
    """Estimate process and measurement noise of a model on trials, by maximum likelihood.

    Errors of the model count as process noise: fit the model first, or use the process noise as a
    measure of its error.

    Args:
        model: n states, m inputs.
        trials: real trials, or records.
        latency: transport delay of each input [s], (m,); None for zero.
        measurement: what the records measure; None for the states themselves.
        known: known measurement noise, (ny,); None to estimate it.
        sizes: typical magnitude of the states that nothing measures, (n,) or one number.
        rng: selects whole trials if there are more than 8,000 samples.

    Raises:
        GroundedError: if a trial does not match the model, or no trial has more than two samples.
    """
    measurement = of_states(model) if measurement is None else measurement
    records = records_of(model, trials)
    if max(r.steps for r in records) < 2:
        raise refused("given.short", what="noise", needs=2)
    delay = np.zeros(model.m) if latency is None else np.asarray(latency, float)
    batch = batch_of(enough(records, rng), measurement, model.n, delay)
    start = first_noise(batch, measurement, sizes)
    if known is not None:
        start = NoiseStd(start.process, known, start.dt)
    held = known is not None
    return maximum_likelihood(model.system, model.values, batch, measurement, start, held=held)


def _estimates(
    records: list[Record], batch: RecordBatch, filtered: Filtered, x: Array, P: Array
) -> list[Estimated]:
    found, g = [], filtered.gains
    assert g.P is not None
    with np.errstate(all="ignore"):  # a filter that diverged says so in its status
        S = g.measured @ g.P @ g.measured.swapaxes(-1, -2)
    np.einsum("...ii->...i", S)[:] += g.system.R[1:]
    for b, record in enumerate(records):
        rows = slice(0, record.steps + 1)
        seen, weight = batch.seen[rows, b], np.maximum(g.weight[rows, b], 1e-300)
        loglik = -0.5 * float(np.sum(filtered.eps[rows, b] ** 2)) + float(
            np.log(weight[seen]).sum()
        )
        loglik -= 0.5 * np.log(2 * np.pi) * int(seen.sum())
        e = np.where(seen, filtered.e[rows, b], np.nan)
        status = filtered.status
        if not np.isfinite(filtered.loglik):
            loglik = -np.inf
        found.append(Estimated(record.times, x[rows, b], P[rows, b], e, S[rows, b], loglik, status))
    return found
