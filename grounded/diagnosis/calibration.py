"""Which of the model's own parameters are off, where calibrating them explains the gap.

Around the calibrated fit the log-posterior of the shifts is a parabola, H its curvature. With only
a set S of the parameters free the best that is left is lower by

    loss(S) = 1/2 b' (H_rr - H_rS H_SS^-1 H_Sr) b,        r: the others, b: their shifts

Parameters are taken into S one by one, each time the one that lowers the loss most, until what the
others would add is not worth a claim. So two parameters that only one combination of the data
knows (a gain and a time constant) are not both blamed for it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grounded.diagnosis.data import Data
from grounded.diagnosis.fitted import Fit, calibrated
from grounded.diagnosis.hypothesis import param_scale
from grounded.frozen import Array

ENOUGH = 3.0  # nats that the parameters that are not named may still hold


@dataclass(frozen=True)
class Blame:
    """A parameter that is off: its index in the model, what is lost without it [nats]."""

    index: int
    nats: float


def loss(H: Array, b: Array, free: list[int]) -> float:
    """What is lost when only `free` shifts may differ from zero [nats]."""
    rest = [i for i in range(len(b)) if i not in free]
    if not rest:
        return 0.0
    block, left = H[np.ix_(rest, rest)], b[rest]
    if free:
        across = H[np.ix_(rest, free)]
        block = block - across @ np.linalg.pinv(H[np.ix_(free, free)], hermitian=True) @ across.T
    return 0.5 * float(left @ block @ left)


def blamed(data: Data, fit: Fit) -> tuple[Blame, ...]:
    """The parameters of a calibrated fit that have to differ, most important first."""
    h = fit.hypothesis
    if h.spread == 0 or h.shift is None:
        return ()
    k, which = len(h.theta), calibrated(data)
    H = fit.gram.sum(axis=0)[k:, k:] + np.diag(fit.prior[k:])
    b = h.shift[which] / param_scale(data.model)[which]
    free: list[int] = []
    now = loss(H, b, free)
    while len(free) < len(b) and (now > ENOUGH or not free):
        losses = {i: loss(H, b, [*free, i]) for i in range(len(b)) if i not in free}
        i = min(losses, key=lambda j: losses[j])
        free, now = [*free, i], losses[i]
    found = [Blame(int(which[i]), loss(H, b, [j for j in free if j != i]) - now) for i in free]
    return tuple(sorted(found, key=lambda blame: -blame.nats))
