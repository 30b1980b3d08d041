"""Correct the derivatives of each step of the run by themselves, when other steps have lost.

The laws of `mispredictions` hold at all times of a run. Two trials determine them, but no such law
describes tyres that lose grip, a filter on top of a wrong inertia, or a pusher that sticks and
slides. So each step t gets a law of its own for what those laws leave of its mispredictions,

    y_jt - C_t d_jt = E_t [dx_jt, du_jt]        for every trial j

A dozen trials determine E_t in a dozen directions at most. Ridge regression leaves it zero in all
others, as a secant method leaves the derivatives across its steps (Broyden, "A class of methods for
solving nonlinear simultaneous equations", Math. Comp. 19, 1965), with the nearest trials weighted
most. Lost trials count as much as others: nothing else shows what a step does that lost.

The penalty is chosen by leaving out the three nearest trials in turn, as in `mispredictions`. That
does not show what such a law misses in a new direction, since a search moves along few. The
regression itself does: it says how uncertain E_t is in each direction, and what a step is planned
for is the cost that is expected with that uncertainty, as if its errors had the same sign all along
the run (`Corrected.doubt`; Deisenroth & Rasmussen, "PILCO", ICML 2011, plan with the uncertainty of
a learnt model, too). So a step goes far where trials have been, and not far elsewhere.

These derivatives wait until two steps from the incumbent have lost. They make a step if it promises
more than any other, each promise less its likely error (`improve`), and the steps after that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.compile import Problem
from grounded.frozen import Array
from grounded.search.candidate import Tried
from grounded.search.planner import Planner
from grounded.search.step.corrected import Corrected
from grounded.search.step.mispredictions import (
    ASKED,
    Believed,
    Seen,
    laws,
    moved_near,
    neighbours,
    received,
    unforetold,
    with_law,
)

PRICES = (1e-3, 1e-2, 0.1, 1.0, 10.0)  # ridge penalties


def believed_by_step(
    planner: Planner, incumbent: Tried, history: Sequence[Tried], grounded: Problem
) -> Believed | None:
    """Return the grounded model with derivatives corrected step by step.

    Args:
        planner: the task, and the task used for planning.
        incumbent: the candidate whose trial the model replays.
        history: all candidates with their trials.
        grounded: the exact model with the incumbent's bias.

    Returns:
        The model and the share of movements that it mispredicts; `corrected` also prices their
        uncertainty. None if fewer than two other trials are known, or if none of the penalties
        predicts a trial that is left out.
    """
    known = neighbours(planner, incumbent, history, grounded)
    if known is None or len(known[1]) < 2:
        return None
    own, others = known[0], [other for other, _ in known[1]]
    dear, asked = worth(own, grounded), others[:ASKED]
    rests = [Told.by([o for o in others if o is not one], own, grounded) for one in asked]
    off = [
        sum(
            told.off(price, one, own, grounded, dear)
            for one, told in zip(asked, rests, strict=True)
        )
        for price in PRICES
    ]
    price = PRICES[int(np.argmin(off))]
    models = [with_law(told.law(price), own, grounded).problem for told in rests]
    missed = unforetold(models, own, asked)
    if not np.mean(missed) < 1.0:
        return None
    told = Told.by(others, own, grounded)
    law = told.law(price)
    cautious = Corrected(grounded.system, law, own.x, own.u, own.before, told.doubt(price, dear))
    return replace(with_law(law, own, grounded), corrected=cautious, missed=float(np.mean(missed)))


@dataclass(frozen=True, eq=False)
class Told:
    """What trials show of the derivatives, beyond the laws of the whole run.

    Differences and leftovers are in units of each trial's distance from the incumbent's.
    """

    whole: Array  # (H, n, 2 n + 2 m) the laws of the whole run
    d: Array  # (j, H, n + m) differences in [x, u], scaled
    left: Array  # (j, H, n) what those laws leave of the mispredictions
    weight: Array  # (j,)
    scale: Array  # (n + m,)

    @classmethod
    def by(cls, others: Sequence[Seen], own: Seen, grounded: Problem) -> Told:
        """Return what `others`, of which at least one differs, show beside the incumbent's trial.

        Args:
            others: other trials.
            own: the incumbent's trial.
            grounded: the exact model with the incumbent's bias.
        """
        d, y, far = moved_near(own, others, grounded)
        whole, _ = laws(own, others, grounded)
        if whole is None:
            whole = np.zeros((*own.x.shape, d.shape[2]))
        left = (y - np.einsum("tnq,jtq->jtn", whole, d)) / far[:, None, None]
        d = d[:, :, : own.x.shape[1] + own.u.shape[1]] / far[:, None, None]
        scale = np.sqrt(np.mean(d**2, axis=(0, 1))) + 1e-12
        return cls(whole, d / scale, left, (far / far[0]) ** -2.0, scale)

    def law(self, price: float) -> Array:
        """Return the laws of the whole run plus those of each step (H, n, 2 n + 2 m)."""
        N = np.einsum("j,jtp,jtk->tpk", self.weight, self.d, self.left)
        E = np.linalg.solve(self._information(price), N) / self.scale[:, None]
        made = self.whole.copy()
        made[:, :, : len(self.scale)] += E.transpose(0, 2, 1)
        return made

    def off(self, price: float, other: Seen, own: Seen, grounded: Problem, worth: Array) -> float:
        """Return the share of another trial's mispredictions that the laws leave, by its cost."""
        (d,), (y,), _ = moved_near(own, [other], grounded)
        left = y - np.einsum("tnq,tq->tn", self.law(price), d)
        return float(np.vdot(worth, left**2) / (np.vdot(worth, y**2) + 1e-300))

    def doubt(self, price: float, worth: Array) -> Array:
        """Return R (H, n + m, n + m): |R_t [dx, du]|^2 is the cost to be expected of errors of E_t.

        With the prior of the regression, entries of variance tau^2, E_t [dx, du] has the variance
        tau^2 price [dx, du]' M^-1 [dx, du] where M is the information. Errors of the same sign in
        all H steps cost H times the sum of the steps' own.

        Args:
            price: the ridge penalty.
            worth: (H, n) cost of a misprediction of 1 of each state at each step.
        """
        H, q = self.d.shape[1:]
        square = np.einsum("j,jtk->k", self.weight, self.left**2) / (self.weight.sum() * H * q)
        spread = price * np.linalg.inv(self._information(price)) / np.outer(self.scale, self.scale)
        size = np.sqrt(H * (worth @ square))
        return np.asarray(size[:, None, None] * np.linalg.cholesky(spread).transpose(0, 2, 1))

    def _information(self, price: float) -> Array:
        """Return M (H, n + m, n + m)."""
        M = np.einsum("j,jtp,jtq->tpq", self.weight, self.d, self.d)
        return np.asarray(M + price * np.eye(len(self.scale)))


def worth(own: Seen, grounded: Problem) -> Array:
    """Return the cost (H, n) of a misprediction of 1 of each state at each step.

    It is that of the states and inputs that follow, under the gains of an LQR about the trial.
    """
    n = own.x.shape[1]
    A, B = grounded.system.linearise(own.x, received(grounded, own.u), grounded.p, grounded.dt)
    R = np.diag(grounded.input_weight + grounded.change_weight)
    Q = grounded.state_weight[:, :n]
    V, found = np.diag(Q[-1]), np.empty((len(A), n))
    for t in range(len(A) - 1, -1, -1):
        found[t] = np.diag(V)
        K = -np.linalg.lstsq(R + B[t].T @ V @ B[t], B[t].T @ V @ A[t], rcond=None)[0]
        closed = A[t] + B[t] @ K
        V = np.diag(Q[t]) + K.T @ R @ K + closed.T @ V @ closed
    return found
