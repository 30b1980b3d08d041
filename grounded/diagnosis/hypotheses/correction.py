"""An empirical correction of the leftover as a smooth curve, for use when no known cause fits.

The correction of a channel's rate is a curve (`grounded.effects.correction`) over the state or
input for which it gains most likelihood on held-out trials; a second curve is added if it gains
PICKED nats more. It may be adopted if predictions of each fold, with weights from the others,
clearly improve. It is not an explanation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from grounded.diagnosis.error_report import Correction, Curve
from grounded.diagnosis.hypotheses.leftover import (
    Leftover,
    filter_of,
    held_out_columns,
    held_out_rate,
)
from grounded.diagnosis.levels import PICKED
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.validation.ruler import Ruler
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


def correction(ruler: Ruler, fit: Fitted, left: Sequence[Leftover]) -> Correction | None:
    """Fit and test a correction of the channel with the largest leftover.

    Args:
        ruler: tests it on predictions.
        fit: the best hypothesis, beside which the correction is fitted.
        left: its leftovers, largest first.

    Returns:
        The correction; None without a leftover, with a single trial, or if no curve gains enough.
    """
    predictor = ruler.predictor
    if not left or predictor.data.count < 2:
        return None
    i = predictor.data.model.state_names.index(left[0].channel)
    chosen, gains = list[_Curve](), filter_of(predictor, fit)
    best, weights = PICKED, np.zeros((0, 0))
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
    return _judged(ruler, fit, left[0].channel, chosen, weights) if chosen else None


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
    ruler: Ruler, fit: Fitted, channel: str, curves: Sequence[_Curve], weights: Array
) -> Correction:
    """Test a correction as a leftover is: by predictions of each fold, its weights from the others.

    Its gain is the share of the channel's squared error that is gone, a mean over horizons.
    """
    data = ruler.data
    rate = held_out_rate(data, _joined(curves), weights)
    found = ruler.corrected(fit, channel, rate)[0]
    gain = 1 - float(np.exp(-2 * found.channels[ruler.names.index(channel)]))
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
        adoptable=found.clear and gain > 0,
        unit=unit,
        curves=tuple(shapes),
    )
