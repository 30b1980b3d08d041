"""What the data determine: of each parameter and value, how much, and what only priors set.

With G the information of the data on the values of all effects and on all uncertain parameters,
these in units of their priors, and P = diag(0, 1) that of the priors,

    C = (G + P)^-1                 variances with the priors
    sqrt((G^-1)_ii / C_ii)         how much wider value i is without them
    C_ij^2 / C_ii                  the part of its variance from the prior of parameter j

the last since C = C G C + C P C. The verdict on a parameter is what the data leave of its prior
standard deviation, sqrt(C_jj). A value *rests on* parameters whose priors make most of its
variance: in a horizontal plane nothing moves differently if all torques, inertias and frictions are
larger by one factor. The standard deviation of a gain is then that of a declared inertia, and if a
part of the inertia is missing in the model, the gain is wrong by many of them. A value that is at
least ALONE times as wide without the priors would stay where they put it even if one of them were
wrong by as many standard deviations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from grounded.diagnosis.error_report import Combination, Identifiable
from grounded.diagnosis.hypotheses.leftover import filter_of
from grounded.diagnosis.levels import HALF, WELL
from grounded.diagnosis.likelihood.data import Data
from grounded.diagnosis.likelihood.fitted import Fitted, calibrated
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.intervals import fisher
from grounded.diagnosis.likelihood.linearise import base_columns
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.parts import Estimate
from grounded.filter import kalman
from grounded.frozen import Array
from grounded.model import Model

WEAK, UNKNOWN = 0.2, 0.6  # remaining fraction of a parameter's prior standard deviation
ALONE = 5.0  # times as wide without the priors: as many standard deviations may one be wrong
PRIOR_SHARE = 0.2  # of a value's variance, from which on it rests on a prior
QUIETER = 100.0  # factor by which effects may still reduce the noise variance

Key = tuple[str, str]  # of a value: effect and quantity, or "" and parameter


class Value(NamedTuple):
    """A free value of a hypothesis, which is a column of its information."""

    effect: str  # "" for a parameter of the model
    quantity: str  # or the parameter
    unit: str
    value: float
    scale: float = 1.0  # units of the value per unit of the column

    @property
    def key(self) -> Key:
        """The effect and the quantity."""
        return self.effect, self.quantity


def values_of(h: Hypothesis, data: Data) -> list[Value]:
    """Return the free values of a hypothesis in the order of its columns, parameters last."""
    found = [
        Value(effect.name, q.name, q.unit, float(values[q.name]))
        for effect, values in h.pairs
        for q in effect.free
    ]
    model, sizes = data.model, data.model.spreads
    now = model.values + (0.0 if h.shift is None else h.shift)
    for i in calibrated(data) if h.spread > 0 else ():
        name = model.param_names[i]
        unit = model.params[name].unit
        found.append(Value("", name, unit, float(now[i]), float(sizes[i])))
    return found


@dataclass(frozen=True, eq=False)
class Identified:
    """What the data determine beside a hypothesis.

    Attributes:
        parameters: each uncertain parameter.
        combinations: values that show only in combination, with at least one claimed effect that is
            no parameter itself.
        std: standard deviations of these under the whole priors [unit of the value].
    """

    parameters: tuple[Identifiable, ...] = ()
    combinations: tuple[Combination, ...] = ()
    std: Mapping[Key, float] = field(default_factory=dict)


def identified(
    predictor: Predictor,
    fit: Fitted,
    known: Mapping[str, Estimate] | None = None,
    *,
    held_out: bool = True,
) -> Identified:
    """Return how well the trials identify each uncertain parameter, and what only priors set.

    If a calibrated value states a larger standard deviation than the information, it is used.

    Parameters that are not identifiable one by one may be so together, if all others are as
    calibrated.

    Args:
        predictor: evaluates hypotheses, with all uncertain parameters free.
        fit: the hypothesis beside which they are identified, and its noise; its parameters may be
            free, or held.
        known: the parameters that were calibrated; the others were held at their values.
        held_out: whether predictions were held out. If not, what is not identifiable alone is not
            adopted jointly.
    """
    model, known = predictor.data.model, known or {}
    G, values = _information(predictor, fit)
    names = [one.quantity for one in values if not one.effect]
    if not names:
        return Identified()
    k, keys = len(values) - len(names), [one.key for one in values]
    C = _inverse(G + np.diag([float(not one.effect) for one in values]))
    unit, value = np.array([(one.scale, one.value) for one in values]).T
    priors, std = unit[k:], np.sqrt(np.diag(C))
    parts = C[:, k:] ** 2 / np.maximum(np.diag(C), 1e-300)[:, None]
    parts[parts < PRIOR_SHARE] = 0.0
    rests = parts.sum(axis=1) > HALF

    # values that stand where the priors put them, in groups
    lone = rests & (fisher(G) > ALONE * std) & (std * unit > WELL * np.abs(value))
    pins = {
        i: {k + j for j in np.flatnonzero(parts[i]).tolist()} for i in np.flatnonzero(lone).tolist()
    }
    found, wide = [], dict[Key, float]()
    for members in _joined(pins):
        if any(i < k for i in members):
            on = set.union(*(pins[i] for i in members))
            told = dict.fromkeys(keys[i][0] or keys[i][1] for i in members if i not in on)
            found.append(Combination(tuple(told), {keys[j][1]: float(unit[j]) for j in sorted(on)}))
            wide |= {keys[i]: float(std[i] * unit[i]) for i in members}
    joint = {name for one in found for name in (*one.values, *one.rests_on)} & known.keys()

    # each parameter: alone, with the others, and what it is given by
    cov, rows = C[k:, k:], list[Identifiable]()
    precision = np.linalg.inv(cov)
    for i, name in enumerate(names):
        stated = known[name].std if name in known else 0.0
        share = max(float(std[k + i]), min(stated / priors[i], 1.0))
        given = {}
        if name in known and known[name].value and rests[k + i]:
            for j in np.flatnonzero(parts[k + i]):
                if names[j] not in known:
                    size = model.params[names[j]].value / known[name].value
                    slope = cov[i, j] / cov[j, j] * priors[i] / priors[j]
                    given[names[j]] = float(slope * size)
        alone = _verdict(share)
        lost = alone == "not identifiable"
        together = _verdict(float(precision[i, i] ** -0.5)) != "not identifiable"
        also = (name in joint or (together and lost and name in known)) and (held_out or not lost)
        rows.append(Identifiable(name, alone, float(priors[i]), share, given, also))
    return Identified(tuple(rows), tuple(found), wide)


def held(predictor: Predictor, fit: Fitted, less_noise: float = QUIETER) -> Model:
    """Return the model with parameters held constant that can't be identified even with less noise.

    If only a combination of several is identifiable (a mass and a gain), the one with the widest
    relative prior stays free.

    Args:
        predictor: evaluates hypotheses on the data.
        fit: the hypothesis beside which they are identified, and its noise.
        less_noise: factor by which the variance of the noise may still fall.
    """
    model = predictor.data.model
    G, values = _information(predictor, fit)
    own = [i for i, one in enumerate(values) if one.effect]
    free = [i for i, one in enumerate(values) if not one.effect]
    names = {i: values[i].quantity for i in free}
    sure = {i: values[i].scale / max(abs(model.params[names[i]].value), 1e-9) for i in free}
    while free:
        some, prior = [*own, *free], np.diag([0.0] * len(own) + [1.0] * len(free))
        left = np.sqrt(np.diag(_inverse(less_noise * G[np.ix_(some, some)] + prior)))[len(own) :]
        lost = [i for i, share in zip(free, left, strict=True) if share > UNKNOWN]
        if not lost:
            break
        free.remove(min(lost, key=lambda i: sure[i]))
    return model.holding({name for i, name in names.items() if i not in free})


def _information(predictor: Predictor, fit: Fitted) -> tuple[Array, list[Value]]:
    """Return the data's information on values and uncertain parameters, and these.

    The values of the effects come first, without those that are parameters themselves; parameters
    are in units of their priors.
    """
    free = replace(fit, hypothesis=replace(fit.hypothesis, spread=1.0))
    columns, of_log = base_columns(predictor, free, whole=True)
    if not columns.shape[-1]:
        return np.zeros((0, 0)), []
    white = kalman.innovations(filter_of(predictor, fit), columns, of_log)[0]
    values = values_of(free.hypothesis, predictor.data)
    own = [i for i, one in enumerate(values) if not one.effect.startswith("parameter:")]
    W = np.nan_to_num(white.reshape(-1, columns.shape[-1]))[:, own]
    return np.asarray(W.T @ W), [values[i] for i in own]


def _inverse(A: Array) -> Array:
    """Return the pseudo-inverse of a symmetric matrix whose rows may differ much in size."""
    scale = 1 / np.sqrt(np.maximum(np.diag(A), 1e-300))
    return np.asarray(np.linalg.pinv(A * np.outer(scale, scale), hermitian=True)) * np.outer(
        scale, scale
    )


def _joined(pins: Mapping[int, set[int]]) -> Sequence[list[int]]:
    """Return the values in groups that rest on the same parameters, directly or by others."""
    groups: list[tuple[set[int], set[int]]] = []
    for i, own in pins.items():
        near = [g for g in groups if g[1] & own]
        groups = [g for g in groups if g not in near]
        groups.append(({i}.union(*(g[0] for g in near)), own.union(*(g[1] for g in near))))
    return [sorted(members) for members, _ in groups]


def _verdict(left: float) -> str:
    if left > UNKNOWN:
        return "not identifiable"
    return "weak" if left > WEAK else "identifiable"
