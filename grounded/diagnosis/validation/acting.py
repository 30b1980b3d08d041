"""How strongly an effect acts in each step."""

from __future__ import annotations

import numpy as np

from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.frozen import Array

MEMORY = 1e-2  # fraction of a memory state's spread that stands in for its noise, which is zero


def acting(predictor: Predictor, fit: Fitted, name: str) -> Array:
    """Return the squared change of each step by an effect, relative to the noise, (L, B)."""
    data, h, x = predictor.data, fit.hypothesis, fit.track
    less = h.minus(name)
    moved = data.model.difference(predictor.next(less, x[:-1]), predictor.next(h, x[:-1]))
    shown = np.zeros_like(x) + predictor.offset(h, x) - predictor.offset(less, x)
    log_q, log_r = fit.noise.log_q.copy(), fit.noise.log_r.copy()
    for i in data.hidden:  # its noise is zero, by which nothing can be divided
        log_q[i] = log_r[i] = 2 * np.log(MEMORY * data.scales.spread(data.model.state_names[i]))
    square = moved**2 / np.exp(log_q) + shown[1:] ** 2 / np.exp(log_r)
    return np.asarray(square.sum(axis=-1) * data.valid.T)
