"""The front door for stored trials: a model and trials in, states with their certainty out.

`consistency` says whether what the filter claims is true:

    NIS   e_t' S_t^-1 e_t / ny         mean 1 if the innovations are as large as claimed
    NEES  (x - xhat)' P^-1 (x - xhat) / n    mean 1 if the states are as uncertain as claimed
    whiteness   correlation of neighbouring whitened innovations, 0 if nothing predictable is left

Each mean is compared with the 95 % band that independent draws would give (chi squared; Bar-Shalom,
Li & Kirubarajan 2001, ch. 5). States within a trial are correlated, so NEES is judged by trials.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from grounded.errors import GroundedError
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
    noise: NoiseStd,
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
    return _estimates(records, batch, filtered, filtered.x, filtered.gains.posterior)


def smooth_trials(
    model: Model,
    trials: Sequence[Trial | Record],
    noise: NoiseStd,
    *,
    latency: Array | None = None,
    measurement: Measurement | None = None,
) -> list[Estimated]:
    """The smoother along each trial: what is known afterwards. Arguments as `filter_trials`."""
    records, batch, filtered, measurement = _passed(model, trials, noise, latency, measurement)
    if not np.isfinite(filtered.loglik):
        return _estimates(records, batch, filtered, filtered.x, filtered.gains.posterior)
    back = smooth(filtered)
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
    batch = batch_of(enough(records, rng), measurement, model.n, delay)
    start = first_noise(batch, measurement)
    return maximum_likelihood(model.system, model.values, batch, measurement, start)


def _passed(
    model: Model,
    trials: Sequence[Trial | Record],
    noise: NoiseStd,
    latency: Array | None,
    measurement: Measurement | None,
) -> tuple[list[Record], RecordBatch, Filtered, Measurement]:
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
    return records, batch, filter_batch(batch, measurement, noise, steps), measurement


def _estimates(
    records: list[Record], batch: RecordBatch, filtered: Filtered, x: Array, P: Array
) -> list[Estimated]:
    found, g = [], filtered.gains
    assert g.P is not None
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


@dataclass(frozen=True, eq=False)
class Consistency:
    """Means with the bands in which 95 % of consistent filters lie; NaN where not known."""

    nis: float
    nis_band: tuple[float, float]
    lag_one: float
    lag_one_band: tuple[float, float]
    nees: float
    nees_band: tuple[float, float]

    @property
    def consistent(self) -> bool:
        """All that is known lies in its band."""
        bands = (self.nis_band, self.lag_one_band, self.nees_band)
        pairs = zip((self.nis, self.lag_one, self.nees), bands, strict=True)
        return all(low <= value <= high for value, (low, high) in pairs if np.isfinite(value))


def consistency(
    estimated: Sequence[Estimated],
    truth: Sequence[Array] | None = None,
    states: Sequence[int] | None = None,
) -> Consistency:
    """Judges filtered trials.

    Args:
        estimated: from `filter_trials` (NEES also from `smooth_trials`).
        truth: the true states of each trial, (T + 1, n), where a simulation knows them.
        states: index of the states that NEES judges; None: all.
    """
    squares, count, products, pairs = 0.0, 0, 0.0, 0
    for trial in estimated:
        eps = _whitened(trial)
        seen = np.isfinite(eps)
        squares, count = squares + float(np.nansum(eps**2)), count + int(seen.sum())
        both = seen[1:] & seen[:-1]
        products += float(np.sum((eps[1:] * eps[:-1])[both]))
        pairs += int(both.sum())
    nees, nees_band = np.nan, (np.nan, np.nan)
    if truth is not None:
        nees, nees_band = _nees(estimated, truth, states)
    width = 1.96 / np.sqrt(max(pairs, 1))
    return Consistency(
        nis=squares / max(count, 1),
        nis_band=_band(count),
        lag_one=products / pairs if pairs else np.nan,
        lag_one_band=(-width, width),
        nees=nees,
        nees_band=nees_band,
    )


def _whitened(trial: Estimated) -> Array:
    C = np.linalg.inv(np.linalg.cholesky(trial.innovation_covariance))
    seen = np.isfinite(trial.innovations)
    eps = (C @ np.where(seen, trial.innovations, 0.0)[..., None])[..., 0]
    return np.where(seen, eps, np.nan)


def _band(count: int) -> tuple[float, float]:
    if count == 0:
        return (np.nan, np.nan)
    from scipy.stats import chi2

    low, high = chi2.ppf([0.025, 0.975], count) / count
    return (float(low), float(high))


def _nees(
    estimated: Sequence[Estimated], truth: Sequence[Array], states: Sequence[int] | None
) -> tuple[float, tuple[float, float]]:
    means = []
    for trial, x in zip(estimated, truth, strict=True):
        pick = np.arange(x.shape[1]) if states is None else np.array(states)
        error = (trial.states - x)[1:, pick]
        P = trial.covariance[1:][:, pick][:, :, pick]
        weighted = np.linalg.solve(P, error[..., None])[..., 0]
        means.append(float(np.mean(np.sum(error * weighted, axis=1))) / len(pick))
    if len(means) < 2:
        return float(np.mean(means)), (-np.inf, np.inf)
    from scipy.stats import t

    quantile = float(t.ppf(0.975, len(means) - 1))
    width = quantile * float(np.std(means, ddof=1)) / np.sqrt(len(means))
    return float(np.mean(means)), (1 - width, 1 + width)
