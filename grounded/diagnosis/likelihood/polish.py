"""Fits that decide, converged until where they started from no longer matters.

`refine` keeps a step only if the posterior rises, also the part of it that moves the track. Points
beside the track's fixed point (the track that the filter returns unchanged) can be a few tenths of
a nat higher. A fit that meets one stops there, and which one it meets depends on the last bit of a
computation. So the track is first moved to what the filter makes of it, wherever that leads, and
the fit goes on from there, with finer thresholds: along a ridge of the posterior each step promises
little, and a nat may remain.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.likelihood.refine import refine

POLISH_SHARE = 0.05  # of the thresholds of `refine`
ROUNDS = 2  # most times that the track is moved
EVIDENCE_SETTLED = 0.05  # nats by which the evidence may change in the last of these rounds
APART = 2.0  # nats that a point beside the fixed point may be higher; more is a kink of the model


def polished(
    predictor: Predictor,
    fits: Sequence[Fitted],
    *,
    iterations: int,
    tick: Callable[[], None] | None = None,
) -> list[Fitted]:
    """Return converged fits, in order.

    Args:
        predictor: evaluates hypotheses on the data.
        fits: results of `refine`.
        iterations: most iterations of a round.
        tick: called whenever a block of fits is done.
    """
    found = list(fits)
    open_ = [i for i, fit in enumerate(found) if not fit.fine]
    for _ in range(ROUNDS):
        left = []
        starts = [(found[i].hypothesis, found[i].noise, found[i].states) for i in open_]
        again = refine(predictor, starts, iterations=iterations, tick=tick, share=POLISH_SHARE)
        for i, fit in zip(open_, again, strict=True) if len(again) == len(open_) else ():
            rise = fit.evidence - found[i].evidence
            if rise > -APART:
                found[i] = fit
                left += [i] * (abs(rise) > EVIDENCE_SETTLED)
        open_ = left
    return [replace(fit, settled=True, fine=True) for fit in found]
