"""Agreement between trials: every claimed value by trial, and changes between groups of trials.

At the values most likely on all trials, each group g of runs has its own score s_g and information
G_g. With all other values held, the group alone would give the value

    theta_g = theta - s_g / G_g,     standard deviation 1 / sqrt(G_g).

The hypothesis that all groups share one value is tested by

    chi2 = sum_g s_g^2 / G_g - (sum_g s_g)^2 / sum_g G_g,    groups - 1 degrees of freedom.

An imperfect model increases chi2 beyond chance, so trials are said to disagree only if the p-value
is small and the values are far apart.

Between two groups, the difference of their values relative to its standard error is the evidence of
a change. The standard error is at least that of the jackknife over trials (Efron & Stein, "The
jackknife estimate of variance", Annals of Statistics 9, 1981). Changes are found by forward
selection, the largest first, each given those before.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.levels import CHANCE, MANY, PICKED, SHOWS
from grounded.diagnosis.likelihood.data import Data
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.parts import Agreement, Changed, Estimate, TrialValue
from grounded.diagnosis.validation.choose import jackknife
from grounded.diagnosis.validation.identifiable import Value, values_of
from grounded.frozen import Array

RIVALS = 8  # hypotheses of one, and of two effects, that are also tested for changes


def _values(fit: Fitted, data: Data, blamed: Sequence[str]) -> dict[int, Value]:
    """Return the free values of effects, and the blamed parameters of a calibration, by column."""
    found = enumerate(values_of(fit.hypothesis, data)[: fit.gram.shape[-1]])
    named = {k: one._replace(effect=one.effect or f"parameter:{one.quantity}") for k, one in found}
    effects = fit.hypothesis.names
    return {k: one for k, one in named.items() if one.effect in (*effects, *blamed)}


def by_trial(
    fit: Fitted, data: Data, blamed: Sequence[str]
) -> tuple[tuple[TrialValue, ...], tuple[Agreement, ...]]:
    """Return every claimed value by trial, and tests of whether the trials agree.

    Args:
        fit: the best hypothesis.
        data: its trials.
        blamed: parameters named by the verdict, such as `parameter:L`.
    """
    from scipy.special import chdtrc

    if data.count < 2:
        return (), ()
    rows: list[TrialValue] = []
    tests: list[Agreement] = []
    each = [data.trial_of == trial for trial in range(data.count)]
    s, G = (np.array([own[k].sum(axis=0) for k in each]) for own in (fit.score, fit.gram))
    for k, one in _values(fit, data, blamed).items():
        some = np.flatnonzero(G[:, k, k] > 1e-9 * G[:, k, k].max())
        if len(some) < 2:
            continue
        score, info = s[some, k], G[some, k, k]
        own = -score / info
        mean = float((own * info).sum() / info.sum())
        chi2 = float((info * (own - mean) ** 2).sum())
        chance = float(chdtrc(len(some) - 1, chi2))
        beyond = np.sqrt(max(float((own - mean).var() - (1 / info).mean()), 0.0)) * one.scale
        differs = chance < CHANCE and beyond > SHOWS * abs(one.value)
        std = one.scale / np.sqrt(info)
        for i, d, e in zip(some, one.scale * own, std, strict=True):
            far = differs and abs(d - one.scale * mean) > MANY * e
            name = data.ids[i] or f"#{i + 1}"
            rows.append(TrialValue(name, one.effect, one.quantity, one.value + d, e, not far))
        estimate = Estimate(one.value, float(beyond), unit=one.unit)
        tests.append(Agreement(one.effect, one.quantity, not differs, chance, estimate))
    return tuple(rows), tuple(tests)


def compared(search: HypothesisSearch, best: Fitted, first: Sequence[bool]) -> tuple[Changed, ...]:
    """Return what differs between two groups of trials, largest evidence first.

    An effect of one group alone may be too weak to be claimed on all trials. So the likeliest
    hypotheses are tested for changes, too, and the one that is likeliest with its changes counts.

    Args:
        search: the search on the data of all trials.
        best: the hypothesis that was chosen.
        first: mask of the trials of the first group (S,).
    """
    fits = [best, search.best_null()]
    fits += [fit for size in (1, 2) for fit in search.of_size(size)[:RIVALS]]
    found = [_compared(fit, search.data, first) for fit in fits]
    worth = [
        search.score(fit) + sum(one.evidence - PICKED for one in some)
        for fit, some in zip(fits, found, strict=True)
    ]
    return found[int(np.nanargmax(worth))]


def _compared(fit: Fitted, data: Data, first: Sequence[bool]) -> tuple[Changed, ...]:
    """Compare two groups under one hypothesis."""
    from scipy.special import chdtrc

    group = np.where(np.asarray(first)[data.trial_of], 0, 1)
    units = _units(data.trial_of, group)
    every = [f"parameter:{name}" for name in data.model.param_names]
    values, taken = _values(fit, data, every), list[int]()
    while left := {
        c: one
        for c in values.keys() - {*taken}
        if (one := _difference(fit, group, taken, c, units)).evidence > PICKED
    }:
        taken.append(max(left, key=lambda c: left[c].evidence))
    told = {k: _difference(fit, group, [c for c in taken if c != k], k, units) for k in taken}

    def row(k: int) -> Changed:
        one, seen = values[k], told[k]
        a, b = (
            Estimate(one.value + one.scale * shift, one.scale * std, unit=one.unit)
            for shift, std in zip(seen.shifts, seen.stds, strict=True)
        )
        chance = float(chdtrc(1, 2 * seen.evidence))
        return Changed(one.effect, one.quantity, a, b, seen.evidence, chance)

    return tuple(map(row, taken))


def _units(trial_of: Array, group: Array) -> Array:
    """Return the jackknife unit of each run, (B,): its trial, or itself if a group has only one."""
    alone = [len(np.unique(trial_of[group == g])) < 2 for g in (0, 1)]
    return np.asarray(np.arange(len(trial_of)) if any(alone) else trial_of, float)


class _Difference(NamedTuple):
    """The difference of one column between the groups, given those that differ already."""

    shifts: Array  # (2,) from the common value
    stds: Array  # (2,)
    evidence: float  # half of a chi-squared with one degree of freedom [nats]


def _difference(
    fit: Fitted, group: Array, taken: Sequence[int], k: int, units: Array
) -> _Difference:
    """Return a column's value in each group, with at least the jackknife's standard error."""
    columns = [*taken, k]
    shifts, stds = np.zeros(2), np.full(2, np.inf)
    for g in (0, 1):
        names, own = np.unique(units[group == g], return_inverse=True)
        G, s = (np.zeros((len(names), *[len(columns)] * d)) for d in (2, 1))
        np.add.at(G, own, fit.gram[group == g][:, columns][:, :, columns])
        np.add.at(s, own, fit.score[group == g][:, columns])
        total, score = G.sum(axis=0), s.sum(axis=0)
        if not total[-1, -1] > 0:
            continue
        inverse = np.linalg.pinv(total, hermitian=True)
        shifts[g] = -float((inverse @ score)[-1])
        less = np.linalg.pinv(total - G, hermitian=True)  # without each unit
        without = -(less @ (score - s)[..., None])[:, -1]
        scatter = float(jackknife(without)[0]) if len(names) > 1 else 0.0
        stds[g] = max(float(np.sqrt(inverse[-1, -1])), scatter)
    square, apart = float((stds**2).sum()), float(shifts[0] - shifts[1]) ** 2
    return _Difference(shifts, stds, 0.5 * apart / square if 0 < square < np.inf else 0.0)
