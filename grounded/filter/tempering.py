"""How much of a log-likelihood can be believed, said by the residuals it was made of.

Evidence adds up the nats of all samples as if each were news. Where the model is wrong, whitened
innovations are correlated: N samples then say as much as

    N_eff = N / (1 + 2 (w_1 rho_1 + w_2 rho_2 + ...))

independent ones, where the weights w_k fall from 1 to 0 at the first lags at which rho_k no longer
stands out of its scatter (a sum cut off at one threshold would jump with the last bit). And where
innovations are larger than claimed, each nat is one of a noise that is `misfit` times too small.
Differences of evidence are multiplied by the one factor

    N_eff / N / max(1, misfit)

of the likeliest hypothesis so far. It is 1 where model and noise are right.
Source: Geyer, Practical Markov chain Monte Carlo (1992), the initial positive sequence; Grünwald &
van Ommen, Inconsistency of Bayesian inference for misspecified linear models (2017).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grounded.frozen import Array

LAGS = 50
CHANCE, CLEAR = 2.0, 3.0  # standard errors of a correlation from which it counts in part, and whole


@dataclass(frozen=True)
class Tempering:
    """Share of the samples that are news, and the mean square of their whitened innovations."""

    independent: float = 1.0
    misfit: float = 1.0

    @property
    def factor(self) -> float:
        """What differences of log-likelihood are worth."""
        return self.independent / max(1.0, self.misfit)


def tempering(eps: Array, seen: Array) -> Tempering:
    """Of whitened innovations eps (T, B, n), zero where `seen` (T, B, n) is 0."""
    counts, news = seen.sum(axis=(0, 1)).tolist(), 0.0
    for i, count in enumerate(counts):
        e, there = eps[..., i] * seen[..., i], seen[..., i]
        power, worth, weight = float(np.sum(e**2)) / max(count, 1.0), 1.0, 1.0
        for k in range(1, min(LAGS, len(e) // 4) + 1):
            pairs = float(np.sum(there[k:] * there[:-k]))
            rho = float(np.sum(e[k:] * e[:-k])) / max(pairs * power, 1e-300)
            weight = min(weight, (rho * pairs**0.5 - CHANCE) / (CLEAR - CHANCE))
            if weight <= 0:
                break
            worth += 2 * weight * rho
        news += count / worth
    total = max(sum(counts), 1.0)
    return Tempering(news / total if news else 1.0, float(np.sum((eps * seen) ** 2)) / total)
