"""Do the trials agree? Every claimed value by trial, and what changed between two groups of trials.

At the values that are most likely on all trials, a group of runs has the score s and the
information G of its own, so that by itself it would have the value

    theta_g = theta - s_g / G_g,     standard deviation 1 / sqrt(G_g),

all other values as they are. That the groups share one value is tested by

    chi2 = sum_g s_g^2 / G_g - (sum_g s_g)^2 / sum_g G_g,    groups - 1 degrees of freedom.

A model that is not quite right makes more of it than chance, so trials disagree only where the
chance is small and the values are far apart. Between two groups that is the evidence of a change;
the greatest is taken first, and what it explains of the others is taken off them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.likelihood.data import Data
from grounded.diagnosis.likelihood.fitted import Fitted, calibrated
from grounded.diagnosis.likelihood.hypothesis import param_scale
from grounded.diagnosis.report import Agreement, Changed, Estimate, TrialValue
from grounded.frozen import Array

CHANCE = 1e-3  # of all trials sharing a value: below it they don't
APART = 0.05  # of the value, and of the standard deviation beyond chance
OFF = 3.0  # standard deviations of a trial that is off
GOES_WITH = 0.8  # correlation from which a value goes with a condition
CHANGE = 5.0  # nats
RIVALS = 8  # hypotheses of one and of two effects that are asked for a change too


@dataclass(frozen=True)
class _Value:
    """One free value: a column of the fit."""

    effect: str
    quantity: str
    unit: str
    value: float
    scale: float  # of the column: its own unit for each unit of the fit's
    column: int


def _values(fit: Fitted, data: Data, blamed: Sequence[str]) -> list[_Value]:
    """The claimed effects' free values, and the parameters that were calibrated or blamed."""
    found, at, h = [], 0, fit.hypothesis
    for effect, values in h.pairs:
        for q in effect.free:
            found.append(_Value(effect.name, q.name, q.unit, float(values[q.name]), 1.0, at))
            at += 1
    if h.shift is None or fit.gram.shape[-1] == at:
        return found
    sizes = param_scale(data.model)
    for k, i in enumerate(calibrated(data)):
        name = data.model.param_names[i]
        if f"parameter:{name}" in blamed:
            value = float(data.model.values[i] + h.shift[i])
            unit = data.model.params[name].unit
            found.append(_Value(f"parameter:{name}", name, unit, value, float(sizes[i]), at + k))
    return found


def _by_group(fit: Fitted, group: Any, count: int) -> tuple[Array, Array]:
    """Scores (g, C) and information (g, C, C) of groups of runs (B,)."""
    s = np.array([fit.score[group == g].sum(axis=0) for g in range(count)])
    G = np.array([fit.gram[group == g].sum(axis=0) for g in range(count)])
    return s, G


def by_trial(
    fit: Fitted, data: Data, blamed: Sequence[str]
) -> tuple[tuple[TrialValue, ...], tuple[Agreement, ...]]:
    """Every claimed value by trial, and whether the trials agree.

    Args:
        fit: the best hypothesis.
        data: its trials.
        blamed: parameters that the verdict names, `parameter:L`.
    """
    from scipy.special import chdtrc

    if data.count < 2:
        return (), ()
    rows: list[TrialValue] = []
    tests: list[Agreement] = []
    s, G = _by_group(fit, data.trial_of, data.count)
    for one in _values(fit, data, blamed):
        k = one.column
        some = np.flatnonzero(G[:, k, k] > 1e-9 * G[:, k, k].max())
        if len(some) < 2:
            continue
        score, info = s[some, k], G[some, k, k]
        own = -score / info
        mean = float((own * info).sum() / info.sum())
        chi2 = float((info * (own - mean) ** 2).sum())
        chance = float(chdtrc(len(some) - 1, chi2))
        beyond = np.sqrt(max(float((own - mean).var() - (1 / info).mean()), 0.0)) * one.scale
        differs = chance < CHANCE and beyond > APART * abs(one.value)
        std = one.scale / np.sqrt(info)
        for i, d, e in zip(some, one.scale * own, std, strict=True):
            far = differs and abs(d - one.scale * mean) > OFF * e
            name = data.ids[i] or f"#{i + 1}"
            rows.append(TrialValue(name, one.effect, one.quantity, one.value + d, e, not far))
        with_ = _goes_with(data, some, own) if differs else ""
        estimate = Estimate(one.value, float(beyond), unit=one.unit)
        tests.append(Agreement(one.effect, one.quantity, not differs, chance, estimate, with_))
    return tuple(rows), tuple(tests)


def _goes_with(data: Data, some: Any, own: Array) -> str:
    """What a value that differs rises or falls with: the trials' order, a signal's mean."""
    if len(some) < 5:
        return ""
    edges = np.cumsum([0, *(data.lengths + 1)])
    means = {"the order of the trials": np.arange(len(some), dtype=float)}
    for i, name in enumerate(data.model.state_names):
        if i not in data.hidden:
            parts = [data.filled[edges[t] : edges[t + 1], i] for t in some]
            means[f"the mean {name}"] = np.array([x.mean() for x in parts])
    for j, name in enumerate(data.model.input_names):
        used = [data.commands[t, : data.lengths[t], j] for t in some]
        means[f"the mean {name}"] = np.array([x.mean() for x in used])
    ties = {n: float(np.corrcoef(x, own)[0, 1]) for n, x in means.items() if np.ptp(x) > 0}
    best = max(ties, key=lambda n: abs(ties[n]), default="")
    if not best or abs(ties[best]) < GOES_WITH:
        return ""
    return f"{'rises' if ties[best] > 0 else 'falls'} with {best}"


def changed(search: HypothesisSearch, best: Fitted, first: Sequence[bool]) -> tuple[Changed, ...]:
    """What differs between two groups of trials, the greatest evidence first.

    What one group alone has may be too little for all trials together: so every hypothesis that
    was weighed is asked, and the one counts that is likeliest with its changes.

    Args:
        search: of the data of all trials.
        best: the hypothesis that was chosen.
        first: which trials are of the first group (S,).
    """
    fits = [best, search.best_null()]
    fits += [fit for size in (1, 2) for fit in search.of_size(size)[:RIVALS]]
    found = [_changes(fit, search.data, first) for fit in fits]
    worth = [
        search.score(fit) + sum(one.evidence - CHANGE for one in some)
        for fit, some in zip(fits, found, strict=True)
    ]
    return found[int(np.nanargmax(worth))]


def _changes(fit: Fitted, data: Data, first: Sequence[bool]) -> tuple[Changed, ...]:
    """The same of one hypothesis."""
    from scipy.special import chdtrc

    s, G = _by_group(fit, np.where(np.asarray(first)[data.trial_of], 0, 1), 2)
    every = [f"parameter:{name}" for name in data.model.param_names]
    values, found = {v.column: v for v in _values(fit, data, every)}, []
    taken: list[int] = []
    while len(taken) < len(values):
        left = _unexplained(s, G, taken)
        k = max((c for c in values if c not in taken), key=lambda c: float(left[c]))
        if not left[k] > 2 * CHANGE:
            break
        one, taken = values[k], [*taken, k]
        own = [np.linalg.pinv(G[g][np.ix_(taken, taken)], hermitian=True) for g in (0, 1)]
        a, b = (
            Estimate(
                one.value - one.scale * float((own[g] @ s[g][taken])[-1]),
                one.scale * float(np.sqrt(own[g][-1, -1])),
                unit=one.unit,
            )
            for g in (0, 1)
        )
        evidence, chance = 0.5 * float(left[k]), float(chdtrc(1, left[k]))
        found.append(Changed(one.effect, one.quantity, a, b, evidence, chance))
    return tuple(found)


def _unexplained(s: Array, G: Array, taken: Sequence[int]) -> Array:
    """Chi-squared (C,) of each column's difference, beside columns that differ already."""
    total = np.zeros(s.shape[1])
    for score, info in zip(s, G, strict=True):
        rest, own = score.copy(), np.diag(info).copy()
        if taken:
            inside = np.linalg.pinv(info[np.ix_(taken, taken)], hermitian=True)
            cross = info[:, taken] @ inside
            rest = score - cross @ score[taken]
            own = own - np.einsum("ij,ij->i", cross, info[:, taken])
        total += rest**2 / np.maximum(own, 1e-12 * np.maximum(np.diag(info), 1e-300))
    return np.asarray(total)
