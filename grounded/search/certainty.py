"""How sure an improvement is, given that the real system never does the same thing twice.

Two candidates with means m_a, m_b of k_a, k_b trials differ for certain where the difference
exceeds its standard error; Welch's t-test gives the probability. Single trials say nothing about
noise: then the scatter of any candidate that WAS repeated stands in for it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from grounded.search.standing import Tried


def utility_noise(history: Sequence[Tried]) -> tuple[float, int]:
    """Standard deviation of a single trial's utility, pooled, and its degrees of freedom."""
    square, freedom = 0.0, 0
    for tried in history:
        known = [u for u in tried.utilities if math.isfinite(u)]
        if len(known) > 1:
            square += float(np.var(known, ddof=1)) * (len(known) - 1)
            freedom += len(known) - 1
    return (math.sqrt(square / freedom) if freedom else float("nan")), freedom


def last_improvement(history: Sequence[Tried]) -> str:
    """A sentence on the last accepted improvement; "" before there is one."""
    accepted = [t for t in history if t.accepted]
    if len(accepted) < 2:
        return ""
    before, after = accepted[-2], accepted[-1]
    gain = after.utility - before.utility
    noise, freedom = utility_noise(history)
    if not freedom:
        return (
            f"the last gain is {gain:.3g}; every candidate was run once, so the noise of a "
            "trial is unknown: run the best one again"
        )
    error = noise * math.sqrt(1 / len(before.utilities) + 1 / len(after.utilities))
    if error == 0:
        return f"the last gain is {gain:.3g}; repeated trials agree exactly"
    from scipy.stats import t as student

    probability = float(student.cdf(gain / error, freedom))
    return (
        f"the last gain is {gain:.3g} +- {error:.2g} (noise of one trial {noise:.2g}): "
        f"an improvement with probability {probability:.2f}"
    )
