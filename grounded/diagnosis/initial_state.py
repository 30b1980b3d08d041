"""States that nobody measured when a run began: how little is known of them, what the run tells.

A run starts with the state as it was measured. What was not measured (a speed that the log does not
hold, a sensor that had dropped out) starts anywhere: a wide prior about the track, and with every
pass the track's start moves to where the whole run puts it,

    E[e_0 | y] = - P_0 sum_t w_t nu_t,        nu, w: whitened innovations of the residual, and of a
                                              unit of e_0 entering the first step (columns of F_0)
"""

from __future__ import annotations

import numpy as np

from grounded.diagnosis import filter as kalman
from grounded.diagnosis.data import Data
from grounded.diagnosis.filter import UNKNOWN
from grounded.frozen import Array

WIDE = 10.0  # [SI unit] standard deviation of a state that is never measured


def prior(data: Data) -> Array:
    """Variances (n,) of states that were not measured when a run began."""
    found = []
    for i, name in enumerate(data.model.state_names):
        known = bool(data.seen[..., i].any())
        found.append(data.scales.spread(name) ** 2 if known else WIDE**2)
    return np.array(found)


def widened(data: Data, R: Array, seen: Array) -> Array:
    """Measurement variances (L + 1, B, n) with the prior of what was not seen at the start.

    In the filter's own convention: at t = 0 what is not seen has UNKNOWN times its R.
    """
    if seen[0].all():
        return R
    R = R.copy()
    R[0] = np.where(seen[0] > 0, R[0], prior(data) / UNKNOWN)
    return R


def smoothed(data: Data, g: kalman.Gains, jacobian: Array, white: Array) -> Array | None:
    """Where the run puts the start, (B, n) to be added to the track's; None: all was measured.

    Args:
        data: of one or several batches of runs.
        g: gains of the runs (L, B, ...), as many times data's runs as there are hypotheses.
        jacobian: F of the same runs (L, B, n, n).
        white: whitened innovations of the residual (L, B, n).
    """
    if data.seen[0].all():
        return None
    L, B, n, _ = jacobian.shape
    missing = np.tile(data.seen[0] == 0, (B // data.seen.shape[1], 1))
    which = np.flatnonzero(missing.any(axis=0))
    d = np.zeros((L, B, n, kalman.whole(len(which), n)))
    d[0, :, :, : len(which)] = jacobian[0][:, :, which] * missing[:, None, which]
    columns = kalman.innovations(g, d, np.zeros((L + 1, 1, 1, 1)))[0]
    found = np.zeros((B, n))
    against = np.einsum("lbnc,lbn->bc", columns[..., : len(which)], white)
    found[:, which] = -prior(data)[which] * against
    return found
