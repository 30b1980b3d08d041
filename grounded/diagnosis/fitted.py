"""A hypothesis at its most likely values: what `refine` returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from grounded.diagnosis.data import Data
from grounded.diagnosis.hypothesis import Hypothesis, param_scale
from grounded.diagnosis.noise import Noise
from grounded.frozen import Array


@dataclass(frozen=True, eq=False)
class Fit:
    """A hypothesis at its most likely values.

    Per run (B): `gram` (B, C, C), `score` (B, C), `rss` (B,), `logdet` (B,) of the whitened columns
    in the order [effects' free values, shifts]; `white` (L, B, n) are the whitened innovations.
    """

    hypothesis: Hypothesis
    noise: Noise
    track: Array  # (L + 1, B, n)
    loglik: float  # of the data
    evidence: float  # log p(y | h): the shifts integrated out
    gram: Array
    score: Array
    rss: Array
    logdet: Array
    white: Array
    residual: Array  # (L, B, n) x_{t+1|t+1} - prediction: what the filter had to correct

    @property
    def covariance(self) -> Array:
        """Of the free values and shifts, (C, C), from the Fisher information."""
        G = self.gram.sum(axis=0) + np.diag(self.prior)
        return np.linalg.pinv(G, hermitian=True)

    def prior_pull(self, data: Data) -> Array:
        """The prior's slope at the shifts as they are, (C,)."""
        h, pull = self.hypothesis, np.zeros(self.gram.shape[-1])
        k = len(h.theta)
        if h.shift is not None and len(pull) > k:
            which = calibrated(data)
            pull[k:] = self.prior[k:] * h.shift[which] / param_scale(data.model)[which]
        return pull

    @property
    def prior(self) -> Array:
        """Precision of each column, (C,): zero for effects."""
        h = self.hypothesis
        k = len(h.theta)
        return np.concatenate(
            [np.zeros(k), shift_precision(self.hypothesis, self.gram.shape[-1] - k)]
        )


def shift_precision(h: Hypothesis, count: int) -> Array:
    """Prior precision of the calibrated parameters' shifts (count,), in units of their scale."""
    return np.full(count, 1.0 / h.spread**2) if count else np.zeros(0)


def calibrated(data: Data) -> Any:
    """Parameters that have a scale, as indices: those that a shift makes sense for."""
    return np.flatnonzero(param_scale(data.model) > 0)
