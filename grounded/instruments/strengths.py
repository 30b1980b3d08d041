"""How strongly each input acts in a trial, if its commands are carried out so many steps late.

Fitted to predictions a quarter of a second ahead, beside all that is linear in the states. Only
predictions count in which the effect of an input is nearly linear in it: an arm that whirls ends
anywhere, and with the commands of one sign the prediction may diverge and with the other not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grounded.frozen import Array
from grounded.instruments.short_runs import LEAST, SAME, Ahead, basis

ROUNDS = 5  # iterations
BLOCKS = 12  # stretches of a trial whose scatter gives a standard error
BENT = 1.001  # largest deviation from a linear effect, as a share of the effect
FARTHEST = 100.0  # times as far as the states move: farther, a prediction diverges
TINY = 1e-3  # of how far the states move: a deviation that is always small enough


@dataclass(frozen=True)
class Strengths:
    """How strongly the inputs act.

    Args:
        factors: 1 as in the model, below 0 the other way round (m,); NaN if the log does not show
            it.
        errors: their standard errors (m,).
        score: sum of the logarithms of the errors that are left [nats].
    """

    factors: Array
    errors: Array
    score: float


class Acting:
    """Predictions with commands that are carried out `late` steps late.

    Args:
        ahead: predictions of a trial.
        late: the delay [steps].
    """

    def __init__(self, ahead: Ahead, late: int) -> None:
        m, self.ahead, self.late = ahead.model.m, ahead, late
        gains = np.vstack([np.ones(m), 1.0 - 2.0 * np.eye(m), 1.0 - np.eye(m)])
        off = ahead.missed(gains, ahead.model.values, late)
        self.off, turned, without = off[0], off[1 : m + 1], off[m + 1 :]
        self.by = np.moveaxis(self.off - turned, 0, -1) / 2  # (N, shown, m): what each input does
        bent = np.moveaxis((self.off + turned) / 2 - without, 0, -1)
        moved = (ahead.moved[ahead.shown] + ahead.least)[:, None]
        does, strays = ((np.abs(x * self.by) / moved**2).sum(axis=1) for x in (self.by, bent))
        even = ((strays <= BENT * does + TINY**2) & (does < FARTHEST**2)).all(axis=1)
        self.even: NDArray[np.bool_] = even & np.isfinite(off).all(axis=(0, 2))

    def strengths(self, rows: NDArray[np.bool_]) -> Strengths | None:
        """Fit how strongly each input acts; None with too few predictions.

        Args:
            rows: which predictions to use (N,).
        """
        found, error = np.full((2, self.ahead.model.m), np.nan)
        if rows.sum() < LEAST:
            return None
        linear, size_of = basis(self.ahead.first[rows][:, self.ahead.shown]), self.ahead.size
        off, by = self.off[rows], self.by[rows]
        off = off - linear @ (linear.T @ off)
        by = by - np.einsum("nc,cki->nki", linear, np.einsum("nc,nki->cki", linear, by))
        size = size_of(off)
        acts = np.asarray((np.sqrt((by**2).mean(axis=0)) > self.ahead.least[:, None]).any(axis=0))
        if not acts.any():
            return Strengths(found, error, float(np.log(size).sum()))
        by = by[:, :, acts]
        for _ in range(ROUNDS):
            slopes = by / size[:, None]
            inverse = np.linalg.pinv(np.einsum("nki,nkj->ij", slopes, slopes), SAME, hermitian=True)
            change = -inverse @ np.einsum("nki,nk->i", slopes, off / size)
            left = off + by @ change
            size = size_of(left)
        pulls = _in_blocks(np.einsum("nki,nk->ni", slopes, left / size))
        found[acts] = 1.0 + change
        error[acts] = np.sqrt(np.diag(inverse @ (pulls.T @ pulls) @ inverse))
        return Strengths(found, error, float(np.log(size).sum()))


def _in_blocks(each: Array) -> Array:
    """Sum rows (N, k) over stretches of the trial whose errors count as independent."""
    block = np.arange(len(each)) * BLOCKS // len(each)
    sums = [np.bincount(block, column, minlength=BLOCKS) for column in each.T]
    return np.asarray(np.array(sums).T * np.sqrt(BLOCKS / (BLOCKS - 1)))
