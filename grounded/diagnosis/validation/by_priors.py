"""Values that the data show only in combination, while priors of parameters set each of them.

In a horizontal plane nothing moves differently if all torques, inertias and frictions are larger by
one factor. The standard deviation of a gain is then that of a declared inertia, and if a part of
the inertia is missing in the model, the gain is wrong by many of them. With G the information of
the data on the values of all claimed effects and on all uncertain parameters, these in units of
their priors, and P = diag(0, 1) that of the priors,

    C = (G + P)^-1                 variances with the priors
    sqrt((G^-1)_ii / C_ii)         how much wider value i is without them
    C_ij^2 / C_ii                  the part of its variance from the prior of parameter j

the last since C = C G C + C P C. A value that is at least ALONE times as wide without the priors
would stay where they put it even if one of them were wrong by as many standard deviations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from grounded.diagnosis.error_report import Combination
from grounded.diagnosis.hypotheses.leftover import filter_of
from grounded.diagnosis.levels import HALF, WELL
from grounded.diagnosis.likelihood.fitted import Fitted, calibrated
from grounded.diagnosis.likelihood.hypothesis import param_scale
from grounded.diagnosis.likelihood.intervals import fisher
from grounded.diagnosis.likelihood.linearise import base_columns
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.effects import ParamFamily
from grounded.filter import kalman
from grounded.frozen import Array

ALONE = 5.0  # times as wide without the priors: as many standard deviations may one be wrong
PART = 0.2  # part of the variance of a value that a prior has at least if the value rests on it

Key = tuple[str, str]  # of a value: effect and quantity, or "" and parameter


@dataclass(frozen=True, eq=False)
class ByPriors:
    """Which values only priors set, and their standard deviations under the whole priors."""

    combinations: tuple[Combination, ...] = ()
    std: Mapping[Key, float] = field(default_factory=dict)  # [unit of the value]


def by_priors(predictor: Predictor, fit: Fitted, worth: float = 1.0) -> ByPriors:
    """Return the values of a fit that the data show only in combination.

    Args:
        predictor: evaluates hypotheses on the data, with all uncertain parameters free.
        fit: the claim at its most likely values; its parameters may be free, or held.
        worth: what a nat is worth, see `intervals.standard_deviations`.

    Returns:
        Combinations with at least one claimed effect that is no parameter itself. Those of
        parameters alone are in `Identifiable`.
    """
    model, h = predictor.data.model, fit.hypothesis
    names = [model.param_names[i] for i in calibrated(predictor.data)]
    blamed = {e.site.target for e in h.effects if isinstance(e.family, ParamFamily)}
    kept = [i for i, name in enumerate(names) if name not in blamed]
    keys: list[Key] = [(e.name, q.name) for e in h.effects for q in e.free]
    k, own = len(keys), [not isinstance(e.family, ParamFamily) for e in h.effects for _ in e.free]
    if not (any(own) and kept):
        return ByPriors()
    rows = [*range(k), *(k + i for i in kept)]
    G = worth * information(predictor, fit)[np.ix_(rows, rows)]
    keys += [("", names[i]) for i in kept]
    shift = np.zeros(model.system.k) if h.shift is None else h.shift
    held = calibrated(predictor.data)[kept]
    unit = np.concatenate([np.ones(k), param_scale(model)[held]])
    value = np.concatenate([h.theta, (model.values + shift)[held]]) / unit
    C = _inverse(G + np.diag([0.0] * k + [1.0] * len(kept)))
    std = np.sqrt(np.diag(C))
    lone = (fisher(G) > ALONE * std) & (std > WELL * np.abs(value))
    parts = C[:, k:] ** 2 / np.maximum(np.diag(C), 1e-300)[:, None]
    parts[parts < PART] = 0.0
    rest = {  # of each such value, the parameters that it rests on
        i: {k + j for j in np.flatnonzero(parts[i]).tolist()}
        for i in np.flatnonzero(lone & (parts.sum(axis=1) > HALF)).tolist()
    }
    found = []
    for members in _joined(rest):
        if any(i < k and own[i] for i in members):
            pins = set.union(*(rest[i] for i in members))
            told = dict.fromkeys(keys[i][0] or keys[i][1] for i in members if i not in pins)
            priors = {keys[j][1]: float(unit[j]) for j in sorted(pins)}
            found.append(Combination(tuple(told), priors))
    said = {name for one in found for name in one.values}
    wide = {key: float(s * u) for key, s, u in zip(keys, std, unit, strict=True)}
    marked = {keys[i]: wide[keys[i]] for i in rest if (keys[i][0] or keys[i][1]) in said}
    return ByPriors(tuple(found), marked)


def information(predictor: Predictor, fit: Fitted) -> Array:
    """Return the data's information on values and uncertain parameters, (k + K, k + K).

    The k values of the effects come first; parameters are in units of their priors.
    """
    free = replace(fit, hypothesis=replace(fit.hypothesis, spread=1.0))
    columns, of_log = base_columns(predictor, free, whole=True)
    if not columns.shape[-1]:
        return np.zeros((0, 0))
    white = kalman.innovations(filter_of(predictor, fit), columns, of_log)[0]
    W = white.reshape(-1, columns.shape[-1])
    return np.asarray(np.nan_to_num(W.T @ W))


def _inverse(A: Array) -> Array:
    """Return the pseudo-inverse of a symmetric matrix whose rows may differ much in size."""
    scale = 1 / np.sqrt(np.maximum(np.diag(A), 1e-300))
    return np.asarray(np.linalg.pinv(A * np.outer(scale, scale), hermitian=True)) * np.outer(
        scale, scale
    )


def _joined(rest: Mapping[int, set[int]]) -> Sequence[list[int]]:
    """Return the values in groups that rest on the same parameters, directly or by others."""
    groups: list[tuple[set[int], set[int]]] = []
    for i, pins in rest.items():
        near = [g for g in groups if g[1] & pins]
        groups = [g for g in groups if g not in near]
        groups.append(({i}.union(*(g[0] for g in near)), pins.union(*(g[1] for g in near))))
    return [sorted(members) for members, _ in groups]
