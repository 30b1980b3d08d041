"""How sure a fit is of each unknown.

    information I = W'W,            covariance I^-1                 (noise as modelled)
    sandwich    I^-1 (sum_b g_b g_b') I^-1,   g_b = W_b' eps_b      (blocks b of time)

The sandwich does not believe that innovations are independent within a block; of the two the larger
is reported, so that an interval is not narrower than either says. A direction in which I is zero is
one that the data don't identify: its unknowns have an infinite standard deviation.
Source: White, Estimation, Inference and Specification Analysis (1994); Newey & West (1987).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grounded.fit.innovations import Linear
from grounded.frozen import Array

NULL = 1e-10  # of the largest eigenvalue of the scaled information
LOADING = 0.05  # a share of a null direction above which an unknown takes part in it


@dataclass(frozen=True, eq=False)
class Spread:
    """Standard deviations (k,), infinite where not identified, and which go together in that."""

    std: Array
    covariance: Array  # (k, k) of the identified ones; zero rows elsewhere
    together: tuple[tuple[int, ...], ...]  # unknowns that only a combination of is identified


def spread(slopes: Linear, free: NDArray[np.bool_]) -> Spread:
    """Standard deviations at the end of a climb.

    Args:
        slopes: there.
        free: unknowns that slopes speak about, (k,); the others get an infinite std.
    """
    k = slopes.W.shape[1]
    N = slopes.W.T @ slopes.W
    use = np.flatnonzero(free & (np.diag(N) > 0))
    std, covariance = np.full(k, np.inf), np.zeros((k, k))
    if len(use) == 0:
        return Spread(std, covariance, ())
    scale = 1 / np.sqrt(np.diag(N)[use])
    values, vectors = np.linalg.eigh(N[np.ix_(use, use)] * np.outer(scale, scale))
    null = values < NULL * values[-1]
    together = [
        tuple(int(i) for i in use[np.abs(vectors[:, j]) > LOADING]) for j in np.flatnonzero(null)
    ]
    lost = {i for group in together for i in group}
    said = ~null
    inverse = (vectors[:, said] / values[said]) @ vectors[:, said].T * np.outer(scale, scale)
    inside = _larger(inverse, _meat(slopes, use))
    covariance[np.ix_(use, use)] = inside
    std[use] = np.sqrt(np.maximum(np.diag(inside), 0.0))
    for i in lost:
        std[i] = np.inf
        covariance[i, :] = covariance[:, i] = 0.0
    return Spread(std, covariance, tuple(together))


def inflation(slopes: Linear, free: NDArray[np.bool_]) -> float:
    """How much less a nat is worth than it says: mean ratio of sandwich to information, >= 1.

    Where innovations are correlated (quantised encoders, an effect that the model has no term for),
    log-likelihoods differ by more than they should; an interval read off them must drop further
    (Kent, Biometrika 69, 1982).
    """
    use = np.flatnonzero(free & (np.sum(slopes.W**2, axis=0) > 0))
    if len(use) == 0:
        return 1.0
    N = (slopes.W.T @ slopes.W)[np.ix_(use, use)]
    inverse = np.linalg.pinv(N, rcond=NULL, hermitian=True)
    each = float(np.trace(inverse @ _meat(slopes, use))) / int(np.linalg.matrix_rank(N))
    return max(1.0, each)


def _meat(slopes: Linear, use: NDArray[np.int64]) -> Array:
    """The sum over blocks of g_b g_b', with the correction for few blocks."""
    count = int(slopes.block.max()) + 1
    scores = np.stack(
        [np.bincount(slopes.block, slopes.W[:, i] * slopes.eps, minlength=count) for i in use],
        axis=1,
    )
    return np.asarray(scores.T @ scores * count / max(count - 1, 1))


def _larger(inverse: Array, meat: Array) -> Array:
    """The modelled covariance, widened for each unknown to what the sandwich says."""
    robust = inverse @ meat @ inverse
    ratio = np.diag(robust) / np.maximum(np.diag(inverse), 1e-300)
    widen = np.sqrt(np.maximum(ratio, 1.0))
    return np.asarray(inverse * np.outer(widen, widen))
