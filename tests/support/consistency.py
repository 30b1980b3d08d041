"""Check whether a filter's covariances are right, on simulated trials with known states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from grounded.estimate import Estimated
from grounded.frozen import Array


@dataclass(frozen=True, eq=False)
class Consistency:
    """Means with the bands in which 95 % of consistent filters lie; NaN if unknown."""

    nis: float
    nis_band: tuple[float, float]
    lag_one: float
    lag_one_band: tuple[float, float]
    nees: float
    nees_band: tuple[float, float]

    @property
    def consistent(self) -> bool:
        """Whether every known mean lies in its band."""
        bands = (self.nis_band, self.lag_one_band, self.nees_band)
        pairs = zip((self.nis, self.lag_one, self.nees), bands, strict=True)
        return all(low <= value <= high for value, (low, high) in pairs if np.isfinite(value))


def consistency(
    estimated: Sequence[Estimated],
    truth: Sequence[Array] | None = None,
    states: Sequence[int] | None = None,
) -> Consistency:
    """Compute the consistency of filtered trials. Args: estimated."""
    squares, count, products, pairs = 0.0, 0, 0.0, 0
    for trial in estimated:
        eps = trial.innovations
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
