"""An empirical correction of the leftover as a smooth curve, for use when no known cause fits.

The correction of a channel's rate is a curve (`grounded.effects.correction`) over the state or
input for which it gains most likelihood on held-out trials; a second curve is added if it gains
PICKED nats more. It may be adopted if predictions of each trial, with weights from the others,
improve by more than their scatter between trials. It is not an explanation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from grounded.diagnosis.error_report import Correction, Curve
from grounded.diagnosis.hypotheses.leftover import Leftover, filter_of, held_out_columns
from grounded.diagnosis.levels import LEAST, PICKED, SURE
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.validation.ahead import missed
from grounded.diagnosis.validation.prediction_error import Horizon
from grounded.effects import Library
from grounded.effects.correction import KNOTS, bells
from grounded.frozen import Array
from grounded.result import per_second

MOST = 2  # most variables


@dataclass(frozen=True)
class _Curve:
    """A variable, the ends of its range, and the basis functions over it (L, B, KNOTS)."""

    over: str
    lo: float
    hi: float
    columns: Array

    def values(self, weights: Array) -> dict[str, float]:
        """Return the quantities of the effect."""
        return {"lo": self.lo, "hi": self.hi} | {f"w{k}": float(w) for k, w in enumerate(weights)}


def correction(
    predictor: Predictor, fit: Fitted, left: Sequence[Leftover], where: Horizon
) -> Correction | None:
    """Fit and test a correction of the channel with the largest leftover.

    Args:
        predictor: evaluates hypotheses on the data.
        fit: the best hypothesis, beside which the correction is fitted.
        left: its leftovers, largest first.
        where: the predictions on which the correction is tested.

    Returns:
        The correction; None without a leftover, with a single trial, or if no curve gains enough.
    """
    if not left or predictor.data.count < 2:
        return None
    i = predictor.data.model.state_names.index(left[0].channel)
    chosen, gains = list[_Curve](), filter_of(predictor, fit)
    best, weights = PICKED, np.zeros((predictor.data.count + 1, 0))
    while len(chosen) < MOST:
        rivals = [c for c in _curves(predictor, fit) if c.over not in [o.over for o in chosen]]
        tried = [
            (held_out_columns(predictor, fit, gains, _joined([*chosen, c]), i), c) for c in rivals
        ]
        if not tried:
            break
        (gain, _, each), curve = max(tried, key=lambda pair: pair[0][0])
        if gain < best + PICKED * bool(chosen):
            break
        best, weights, chosen = gain, each, [*chosen, curve]
    if not chosen:
        return None
    return _judged(predictor, fit, left[0].channel, chosen, weights, where)


def _joined(curves: Sequence[_Curve]) -> Array:
    return np.concatenate([one.columns for one in curves], axis=-1)


def _curves(predictor: Predictor, fit: Fitted) -> list[_Curve]:
    """Return basis functions over every measured state and every received input."""
    data, model = predictor.data, predictor.data.model
    x, u = fit.track[:-1], predictor.inputs(fit.hypothesis)
    signals = {n: x[..., i] for i, n in enumerate(model.state_names) if i not in data.hidden}
    signals |= {n: u[..., j] for j, n in enumerate(model.input_names)}
    found = []
    for name, r in signals.items():
        lo, hi = (float(q) for q in np.quantile(r[data.valid.T > 0], [0.02, 0.98]))
        if hi - lo > 1e-6 * max(abs(lo), abs(hi), 1e-9):
            found.append(_Curve(name, lo, hi, np.stack(bells(r, lo, hi), axis=-1)))
    return found


def _judged(
    predictor: Predictor,
    fit: Fitted,
    channel: str,
    curves: Sequence[_Curve],
    weights: Array,
    where: Horizon,
) -> Correction | None:
    """Test a correction by the squared errors of each trial, with weights from the others."""
    data, h = predictor.data, fit.hypothesis
    of_start = data.trial_of[where.run]
    gains = []
    for trial, own in enumerate(weights[:-1]):
        at = np.flatnonzero(of_start == trial)
        if not len(at):
            continue
        start, which = (where.at[at], where.run[at], where.steps), np.zeros(len(at), int)
        off = [
            missed(predictor, [one], which, fit.states, *start)[-1] / where.spread[at]
            for one in (h, _with(h, predictor, channel, curves, own))
        ]
        before, after = (float(np.nanmean(each**2)) for each in off)
        gains.append(1 - after / before)
    if not gains:  # no trial is long enough to judge it
        return None
    gain = float(np.mean(gains))
    scatter = float(np.std(gains, ddof=1) / np.sqrt(len(gains))) if len(gains) > 1 else np.inf
    unit, shapes = per_second(data.model.states[channel]), []
    for k, one in enumerate(curves):
        whole = weights[-1][k * KNOTS : (k + 1) * KNOTS]
        apart = weights[:-1, k * KNOTS : (k + 1) * KNOTS]
        spread = np.sqrt((len(apart) - 1) * apart.var(axis=0))  # jackknife
        places = np.linspace(one.lo, one.hi, KNOTS)
        shapes.append(
            Curve(
                f"correction:{channel}<-{one.over}",
                one.over,
                tuple(float(p) for p in places),
                tuple(float(w) for w in whole),
                tuple(float(s) for s in spread),
                one.values(whole),
            )
        )
    return Correction(
        channel=channel,
        over=tuple(one.over for one in curves),
        held_out_gain=gain,
        adoptable=gain > max(2 * LEAST, SURE * scatter),
        unit=unit,
        curves=tuple(shapes),
    )


def _with(
    h: Hypothesis, predictor: Predictor, channel: str, curves: Sequence[_Curve], weights: Any
) -> Hypothesis:
    """Return the hypothesis with the correction added."""
    for k, one in enumerate(curves):
        name = f"correction:{channel}<-{one.over}"
        effect = Library().effect(name, predictor.data.model, predictor.data.scales)
        h = h.plus(effect, one.values(weights[k * KNOTS : (k + 1) * KNOTS]))
    return h
