"""How sure an improvement is, given that a real system seldom does the same thing twice."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from grounded.trial import Trial

if TYPE_CHECKING:
    from grounded.search.standing import Tried


def repeated_exactly(trials: Sequence[Trial]) -> bool:
    """Whether two trials of a candidate have the very same states."""
    return any(a.repeats(b) for a, b in pairwise(trials))


def in_doubt(incumbent: Tried, loser: Tried, most: int) -> bool:
    """Whether a loss may be luck: the incumbent's, whose trials were the best of several.

    A lucky winner blocks every step from there on. So a loss within two standard errors of the
    incumbent's own scatter (unknown after one trial) sends it out once more, until it has `most`
    trials: one for each loss. Where trials repeat themselves exactly, it costs one trial a winner.
    """
    if not np.isfinite(loser.utility) or len(incumbent.trials) >= most:
        return False
    scatter = incumbent.standard_error * np.sqrt(len(incumbent.trials))
    error = scatter * np.sqrt(1 / len(incumbent.trials) + 1 / len(loser.trials))
    return not incumbent.utility - loser.utility > 2 * error


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
    """How sure the last accepted improvement is, as a sentence; "" before there is one.

    Two candidates differ for certain where the difference of their means exceeds its standard
    error; Welch's t-test gives the probability. Single trials say nothing about noise: then the
    scatter of any candidate that was repeated stands in for it.
    """
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
