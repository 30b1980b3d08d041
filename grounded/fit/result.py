"""What a fit found, each value with its interval, and the sentence that says how it ended."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from grounded.estimate import Noise
from grounded.fit.interval import Spread, inflation, spread
from grounded.fit.prediction import PredictionError
from grounded.fit.scan import likelihood_interval, quiet
from grounded.fit.search import Found
from grounded.fit.unknowns import Unknowns
from grounded.frozen import Array
from grounded.model import Model


@dataclass(frozen=True, eq=False)
class Estimate:
    """One fitted quantity with its 95 % interval; `std` is infinite where not identified."""

    value: float
    std: float
    low: float
    high: float
    unit: str
    identified: bool
    start: float


@dataclass(frozen=True, eq=False)
class Fit:
    """What a fit found.

    `params` holds the model's parameters and, if fitted, `latency` or `latency:<input>` [s].
    """

    params: Mapping[str, Estimate]
    model: Model  # with the fitted values
    latency: Array  # (m,) [s]
    noise: Noise
    loglik: float
    status: str  # converged, still rising, or why it stopped
    sentence: str
    before: PredictionError | None  # on held-out time; None: too little data to hold any out
    after: PredictionError | None
    samples: int
    covariance: Array = field(repr=False)  # (k, k), in the order of params

    def __post_init__(self) -> None:
        object.__setattr__(self, "params", MappingProxyType(dict(self.params)))


def report(
    model: Model,
    unknowns: Unknowns,
    last: Found,
    before: PredictionError | None,
    after: PredictionError | None,
) -> Fit:
    """A search's end as a `Fit`.

    Args:
        model: where it began.
        unknowns: what was fitted.
        last: where it ended.
        before: how well the model predicted held-out time, if any was held out.
        after: how well the model of the first search predicts it.
    """
    at = last.climb.at
    params, wide = _estimates(unknowns, last)
    p, latency = unknowns.unpack(at.theta)
    return Fit(
        params=params,
        model=model.with_values(dict(zip(model.param_names, p.tolist(), strict=True))),
        latency=latency,
        noise=last.noise,
        loglik=at.loglik,
        status=last.status,
        sentence=_sentence(unknowns, params, wide, last),
        before=before,
        after=after,
        samples=at.batch.count,
        covariance=wide.covariance,
    )


def _estimates(unknowns: Unknowns, found: Found) -> tuple[dict[str, Estimate], Spread]:
    at, scanned, worth = found.climb.at, np.zeros(unknowns.k, dtype=bool), 1.0
    if not np.isfinite(at.loglik):
        k = unknowns.k
        wide = Spread(np.full(k, np.inf), np.zeros((k, k)), ())
    else:
        scanned = quiet(found.data, found.climb.slopes) | found.thresholds
        smooth, scanned = ~scanned, scanned & np.isfinite(unknowns.scale)
        wide = spread(found.climb.slopes, smooth)
        worth = inflation(found.climb.slopes, smooth)
    params: dict[str, Estimate] = {}
    for i, name in enumerate(unknowns.names):
        value, std = float(at.theta[i]), float(wide.std[i])
        low, high = value - 1.96 * std, value + 1.96 * std
        if scanned[i]:
            low, high = likelihood_interval(found.data, found.noise, at, i, worth)
            std = (high - low) / (2 * 1.96)
        range_ = unknowns.high[i] - unknowns.low[i]
        std = np.inf if high - low >= range_ else std
        known = bool(np.isfinite(std) and std < range_ / np.sqrt(12))
        low, high = max(low, float(unknowns.low[i])), min(high, float(unknowns.high[i]))
        start = float(unknowns.start[i])
        params[name] = Estimate(value, std, low, high, unknowns.units[i], known, start)
    return params, wide


def _sentence(
    unknowns: Unknowns, params: Mapping[str, Estimate], wide: Spread, found: Found
) -> str:
    if not np.isfinite(found.climb.at.loglik):
        return f"nothing was fitted: {found.status}; check units, signs and start values"
    parts = [found.status]
    unknown = [name for name, estimate in params.items() if not estimate.identified]
    if unknown:
        parts.append("the data do not identify " + ", ".join(unknown))
    for group in wide.together:
        if len(group) > 1:
            names = ", ".join(unknowns.names[i] for i in group)
            parts.append(f"only a combination of {names} is identified")
    theta = found.climb.at.theta
    edge = np.isclose(theta, unknowns.low) | np.isclose(theta, unknowns.high)
    held = [unknowns.names[i] for i in np.flatnonzero(edge) if params[unknowns.names[i]].identified]
    if held:
        parts.append("at a bound: " + ", ".join(held))
    return "; ".join(parts)
