"""Steps 6 and 7: the line search on the REAL system.

alpha = 1 first, then halved until a trial improves the utility (footnote 11). Real trials are the
evaluations, so the search is not a loop but a question put to the trials so far: which alpha is
next? An alpha may also be passed over because its predicted run leaves the safe region.
"""

from __future__ import annotations

from collections.abc import Iterable


def next_alpha(tried: Iterable[float], max_halvings: int) -> float | None:
    """The step to try after those that did not improve; None when the search has failed (step 7).

    Args:
        tried: alphas of the trials along this direction that did not improve the utility.
        max_halvings: alphas go down to 2^-max_halvings.
    """
    smallest = min(tried, default=2.0)
    alpha = smallest / 2
    return alpha if alpha >= 2.0**-max_halvings * (1 - 1e-12) else None
