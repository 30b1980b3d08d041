"""A model that is no number at states that were really measured: where, in words."""

from __future__ import annotations

import numpy as np

from grounded.diagnosis.hypothesis import Hypothesis, Predictor


def undefined(predictor: Predictor) -> str:
    """Where a model is no number along the log, in words."""
    data, h = predictor.data, Hypothesis()
    with np.errstate(all="ignore"):
        after = predictor.next(h, data.y[:-1])
    bad = np.argwhere(~np.isfinite(after).all(axis=-1) & (data.valid.T > 0))
    if not len(bad):
        return (
            "the model's own predictions of these trials diverge: try it with `grounded fit`, or "
            "check the units of its parameters"
        )
    t, b = bad[0]
    trial = data.ids[data.trial_of[b]] or f"number {data.trial_of[b] + 1}"
    values = ", ".join(
        f"{name} = {value:.4g}"
        for name, value in zip(data.model.state_names, data.y[t, b], strict=True)
    )
    return (
        f"the model '{data.model.name}' is no number at a state that was measured: trial {trial}, "
        f"t = {data.time[t, b]:.3g} s, {values}; noise can carry a log beyond where a square root "
        "or a logarithm holds: bound its argument in the model (np.maximum(x, 0))"
    )
