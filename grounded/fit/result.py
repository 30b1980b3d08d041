"""The result of a fit: values with intervals, and a sentence that says how it ended.

The covariance of the unknowns is estimated in two ways:

    information I = W'W,            covariance I^-1                 (noise as modelled)
    sandwich    I^-1 (sum_b g_b g_b') I^-1,   g_b = W_b' eps_b      (blocks b of time)

The sandwich does not assume that innovations are independent within a block. The larger of the two
is reported. If I is zero in a direction, the data do not identify it, and the unknowns that take
part in it have an infinite standard deviation. An unknown at a bound is held there.
Source: White, Estimation, Inference and Specification Analysis (1994); Newey & West (1987).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from grounded.estimate import NoiseStd
from grounded.fit.point import Linear
from grounded.fit.prediction import PredictionError
from grounded.fit.search import SearchEnd, likelihood_interval, quiet
from grounded.fit.unknowns import Unknowns
from grounded.frozen import Array
from grounded.model import Model
from grounded.result import Result, document, listed


@dataclass(frozen=True, eq=False)
class FittedValue:
    """A fitted quantity with its 95 % interval; `std` is infinite if it is not identified.

    `only_with` names what was held because the data tell only combinations of it with this one: the
    interval holds if those values are right.
    """

    value: float
    std: float
    low: float
    high: float
    unit: str
    identified: bool
    start: float
    only_with: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, repr=False)
class Fit(Result):
    """The result of a fit.

    `params` holds the model's parameters and, if fitted, `latency`, `latency:<input>` or the
    latencies named in `fit_latency` [s].
    """

    params: Mapping[str, FittedValue]
    model: Model  # the model with the fitted values
    latency: Array  # (m,) [s]
    noise: NoiseStd
    loglik: float
    status: str  # converged, still rising, or why it stopped
    sentence: str
    before: PredictionError | None  # on held-out time; None if there was too little data for that
    after: PredictionError | None
    samples: int
    covariance: Array = field(repr=False)  # (k, k), in the order of params

    def __post_init__(self) -> None:
        object.__setattr__(self, "params", MappingProxyType(dict(self.params)))

    def beside(self, asked: Unknowns, tied: Mapping[str, Sequence[str]]) -> Fit:
        """Return the fit with the unknowns added that were held because they are unidentified.

        Args:
            asked: all unknowns.
            tied: of each held one, those that the data tell once it is held.
        """
        lost = [i for i, name in enumerate(asked.names) if name not in self.params]
        if not lost:
            return self
        params, covariance = dict(self.params), np.zeros((asked.k, asked.k))
        kept = np.delete(np.arange(asked.k), lost)
        covariance[np.ix_(kept, kept)] = self.covariance
        for i in lost:
            start, low, high = (float(a[i]) for a in (asked.start, asked.low, asked.high))
            params[asked.names[i]] = FittedValue(
                start, np.inf, low, high, asked.units[i], False, start
            )
        for held, others in tied.items():
            for name in others:
                both = (*params[name].only_with, held)
                params[name] = replace(params[name], only_with=both)
        alone = [asked.names[i] for i in lost if not tied.get(asked.names[i])]
        sentence = self.sentence
        if alone:
            sentence += f"; the data do not identify {', '.join(alone)}, held as before"
        for held in (name for name, others in tied.items() if others):
            sentence += (
                f"; the data tell only combinations of {listed([held, *tied[held]])}: {held} is "
                "held as before, and what is fitted of the others is right only if that is"
            )
        return replace(
            self,
            params={name: params[name] for name in asked.names},
            covariance=covariance,
            sentence=sentence,
        )

    def of_share(self, sentence: str) -> Fit:
        """Return the fit with a sentence added on which share of the trials it used; "": all."""
        return replace(self, sentence=f"{self.sentence}; {sentence}") if sentence else self

    @property
    def helps(self) -> bool:
        """Whether held-out time is predicted better by more than TIE.

        True if none was held out; False if nothing could be fitted.
        """
        return bool(np.isfinite(self.loglik)) and _change(self.before, self.after) < -TIE

    @property
    def at_bounds(self) -> tuple[str, ...]:
        """Names of the identified parameters that ended at a bound.

        Their intervals are cut there, and those of the others hold only with them there.
        """
        known = {n: e for n, e in self.params.items() if e.identified and n in self.model.params}
        return tuple(n for n, e in known.items() if self.model.params[n].at_bound(e.value))

    @property
    def worse(self) -> bool:
        """Whether held-out time is predicted worse than before by more than TIE."""
        return _change(self.before, self.after) > TIE

    def summary(self) -> str:
        """Return the status and the values with their standard deviations."""
        found = ", ".join(f"{name} {e.value:.4g} +- {e.std:.2g}" for name, e in self.params.items())
        return f"{self.status}: {found}"

    def to_json(self) -> dict[str, Any]:
        """Return the document of `grounded fit --json`; the command sets "applied"."""
        found = document(
            params={name: vars(e) for name, e in self.params.items()},
            status=self.status,
            sentence=self.sentence,
            samples=self.samples,
            at_bounds=list(self.at_bounds),
            applied=False,
        )
        for name, error in (("before", self.before), ("after", self.after)):
            if error is not None:
                found[f"prediction_error_{name}"] = document(
                    horizon_s=error.horizon_s,
                    one_step=dict(zip(error.names, error.one_step, strict=True)),
                    ahead=dict(zip(error.names, error.ahead, strict=True)),
                )
        return found


def unidentified(params: Mapping[str, FittedValue]) -> list[str]:
    """Return the names of the unknowns that the data do not tell."""
    return [name for name, e in params.items() if not e.identified]


def least_known(model: Model, found: Fit) -> str | None:
    """Return the unidentified unknown with the narrowest relative prior; None if there is none."""
    if not np.isfinite(found.loglik):
        return None

    def sure(name: str) -> float:
        param = model.params.get(name)
        return 0.0 if param is None else param.spread / max(abs(param.value), 1e-9)

    lost = unidentified(found.params)
    return min(lost, key=sure) if lost else None


def report(
    model: Model,
    unknowns: Unknowns,
    last: SearchEnd,
    before: PredictionError | None,
    after: PredictionError | None,
) -> Fit:
    """Build the `Fit` of a finished search.

    Args:
        model: the model with start values.
        unknowns: what was fitted.
        last: the end of the search.
        before: prediction error of the start model on held-out time; None if none was held out.
        after: prediction error of the model of the first search on held-out time.
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
        sentence=_sentence(unknowns, params, wide, last)
        + "; held-out time is predicted no better than before" * (_change(before, after) >= 0),
        before=before,
        after=after,
        samples=at.count,
        covariance=wide.covariance,
    )


TIE = 0.01  # relative change of held-out errors that is not significant


def _change(before: PredictionError | None, after: PredictionError | None) -> float:
    """Return the mean log ratio of errors, after over before, at the longest known horizon.

    It is minus infinity if nothing was held out, and infinity if predictions diverge.
    """
    if before is None or after is None:
        return -np.inf
    far = bool(np.isfinite(before.ahead).any())
    was, now = (before.ahead, after.ahead) if far else (before.one_step, after.one_step)
    told = np.isfinite(was) & (was > 0)
    if not told.any():
        return -np.inf
    if not np.isfinite(now[told]).all():
        return np.inf
    return float(np.log(np.maximum(now[told], 1e-300) / was[told]).mean())


def _estimates(unknowns: Unknowns, found: SearchEnd) -> tuple[dict[str, FittedValue], Uncertainty]:
    at, scanned, worth = found.climb.at, np.zeros(unknowns.k, dtype=bool), 1.0
    if not np.isfinite(at.loglik):
        k = unknowns.k
        wide = Uncertainty(np.full(k, np.inf), np.zeros((k, k)), ())
    else:
        scanned = quiet(found.data, found.climb.slopes) | found.thresholds
        smooth, scanned = ~scanned, scanned & np.isfinite(unknowns.scale)
        wide = beside_bounds(found.climb.slopes, smooth, unknowns, at.theta)
        worth = inflation(found.climb.slopes, smooth)
    params: dict[str, FittedValue] = {}
    for i, name in enumerate(unknowns.names):
        value, std = float(at.theta[i]), float(wide.std[i])
        low, high = value - 1.96 * std, value + 1.96 * std
        if scanned[i]:
            low, high = likelihood_interval(found.data, at, i, worth)
            std = (high - low) / (2 * 1.96)
        range_ = unknowns.high[i] - unknowns.low[i]
        std = np.inf if high - low >= range_ else std
        known = bool(np.isfinite(std) and std < range_ / FLAT)
        low, high = max(low, float(unknowns.low[i])), min(high, float(unknowns.high[i]))
        start = float(unknowns.start[i])
        params[name] = FittedValue(value, std, low, high, unknowns.units[i], known, start)
    return params, wide


def _sentence(
    unknowns: Unknowns, params: Mapping[str, FittedValue], wide: Uncertainty, found: SearchEnd
) -> str:
    if not np.isfinite(found.climb.at.loglik):
        return f"nothing was fitted: {found.status}; check units, signs and start values"
    parts = [found.status]
    unknown = unidentified(params)
    if unknown:
        parts.append("the data do not identify " + ", ".join(unknown))
    for group in wide.together:
        if len(group) > 1:
            names = ", ".join(unknowns.names[i] for i in group)
            parts.append(f"only a combination of {names} is identified")
    edge = _edge(unknowns, found.climb.at.theta)
    held = [unknowns.names[i] for i in np.flatnonzero(edge) if params[unknowns.names[i]].identified]
    if held:
        parts.append("at a bound: " + ", ".join(held))
    return "; ".join(parts)


def _edge(unknowns: Unknowns, theta: Array) -> NDArray[np.bool_]:
    """Return which unknowns (k,) ended at a bound."""
    return np.asarray(np.isclose(theta, unknowns.low) | np.isclose(theta, unknowns.high))


FLAT = np.sqrt(12)  # width of a uniform distribution in standard deviations
NULL = 1e-10  # eigenvalue, relative to the largest of the scaled information, that counts as zero
LOADING = 0.05  # component of a null direction above which an unknown takes part in it


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Standard deviations (k,), infinite if not identified, and groups of tied unknowns."""

    std: Array
    covariance: Array  # (k, k) of the identified ones; zero rows elsewhere
    together: tuple[tuple[int, ...], ...]  # groups of which only a combination is identified


def beside_bounds(
    slopes: Linear, free: NDArray[np.bool_], unknowns: Unknowns, theta: Array
) -> Uncertainty:
    """Return the uncertainty if some unknowns ended at a bound.

    Those at a bound are held for the uncertainty of the others; an unknown that is only tied with
    one of them thus counts as identified. Their own uncertainty is computed with the others free,
    or, if the others could compensate for it, with them held.

    Args:
        slopes: derivatives at the end of a climb.
        free: unknowns that the derivatives apply to, (k,).
        unknowns: the unknowns with their bounds.
        theta: values at the end of the climb, (k,).
    """
    edge, most = _edge(unknowns, theta), (unknowns.high - unknowns.low) / FLAT
    found = uncertainty(slopes, free & ~edge)
    std, covariance = found.std.copy(), found.covariance.copy()
    for i in np.flatnonzero(free & edge & (np.diag(slopes.N) > 0)):
        alone = np.arange(len(free)) == i
        both = uncertainty(slopes, free & (~edge | alone)).std[i]
        std[i] = both if both < most[i] else uncertainty(slopes, alone).std[i]
        covariance[i, i] = std[i] ** 2
    return replace(found, std=std, covariance=covariance)


def uncertainty(slopes: Linear, free: NDArray[np.bool_]) -> Uncertainty:
    """Return the standard deviations at the end of a climb.

    Args:
        slopes: derivatives there.
        free: unknowns that the derivatives apply to, (k,); the others get an infinite std.
    """
    N = slopes.N
    k = len(N)
    use = np.flatnonzero(free & (np.diag(N) > 0))
    std, covariance = np.full(k, np.inf), np.zeros((k, k))
    if len(use) == 0:
        return Uncertainty(std, covariance, ())
    scale = 1 / np.sqrt(np.diag(N)[use])
    values, vectors = np.linalg.eigh(N[np.ix_(use, use)] * np.outer(scale, scale))
    null = values < NULL * values[-1]
    together = [
        tuple(int(i) for i in use[np.abs(vectors[:, j]) > LOADING]) for j in np.flatnonzero(null)
    ]
    lost = {i for group in together for i in group}
    said = ~null
    inverse = (vectors[:, said] / values[said]) @ vectors[:, said].T * np.outer(scale, scale)
    inside = _larger(inverse, _meat(slopes, use))
    covariance[np.ix_(use, use)] = inside
    std[use] = np.sqrt(np.maximum(np.diag(inside), 0.0))
    for i in lost:
        std[i] = np.inf
        covariance[i, :] = covariance[:, i] = 0.0
    return Uncertainty(std, covariance, tuple(together))


def inflation(slopes: Linear, free: NDArray[np.bool_]) -> float:
    """Return the factor by which log-likelihood differences are too large, >= 1.

    It is the mean ratio of sandwich to information. If innovations are correlated (quantised
    encoders, effects that the model lacks), log-likelihoods differ by more than they should, and
    the drop that defines an interval must be larger (Kent, Biometrika 69, 1982).
    """
    use = np.flatnonzero(free & (np.diag(slopes.N) > 0))
    if len(use) == 0:
        return 1.0
    N = slopes.N[np.ix_(use, use)]
    inverse = np.linalg.pinv(N, rcond=NULL, hermitian=True)
    each = float(np.trace(inverse @ _meat(slopes, use))) / int(np.linalg.matrix_rank(N))
    return max(1.0, each)


def _meat(slopes: Linear, use: NDArray[np.int64]) -> Array:
    """Return the sum over blocks of g_b g_b', with the correction for few blocks."""
    count, scores = len(slopes.scores), slopes.scores[:, use]
    return np.asarray(scores.T @ scores * count / max(count - 1, 1))


def _larger(inverse: Array, meat: Array) -> Array:
    """Return the modelled covariance, widened for each unknown to the sandwich's variance."""
    robust = inverse @ meat @ inverse
    ratio = np.diag(robust) / np.maximum(np.diag(inverse), 1e-300)
    widen = np.sqrt(np.maximum(ratio, 1.0))
    return np.asarray(inverse * np.outer(widen, widen))
