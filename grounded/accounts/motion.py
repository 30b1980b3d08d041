"""The motion given the model: predictions of one trial 0.25 to 1 s ahead, from many samples.

The model predicts as it is, or calibrated on the trial itself: uncertain parameters, a gain on
every input and a common delay of the commands are fitted, and a constant rate of each state is
removed. The remaining error is what no plain calibration explains.
On request everything linear in the states (unmodelled friction, back-EMF, springs) or in the
commands is removed as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grounded.accounts.levels import EXACT, FEWEST_SAMPLES, SMALL, TINY
from grounded.frozen import Array
from grounded.model import Model
from grounded.places import motion, true_values
from grounded.rollout import stepper
from grounded.trial import Trial

AHEAD_S = 0.25  # [s]
STATES_BOUND = 1e9  # bound on predicted states
DELAYS = tuple(np.linspace(0.0, 0.3, 7).tolist())  # [s] command delays tried
ROUNDS, SLOPE = 5, 0.02  # iterations, difference step
SAME = 1e-6  # singular values below this share of the largest count as zero
SHORTLIST = 8  # accounts of a table that are compared in full

Steps = NDArray[np.intp]


def starts_from(model: Model, states: Array, shown: Sequence[int]) -> Array:
    """Return the states that predictions start from at each sample, (..., T + 1, n).

    States without a sensor are taken as 0, but the memory of adopted inputs' effects as the trial
    has it, where it follows the commands, and true values behind a delayed log as what is logged
    later.
    """
    names, x = model.state_names, np.array(states)
    hidden = [i for i in range(model.n) if i not in shown]
    if not hidden:
        return x
    own = motion(model).state_names
    known = np.isfinite(x) & np.array([name not in own for name in names])
    x[..., hidden] = np.where(known, x, 0.0)[..., hidden]
    for i, k in true_values(names, [names[i] for i in hidden]).items():
        stem, _, steps = names[i].rpartition("_")
        stem, ago = (stem, int(steps)) if steps.isdigit() else (names[i], 0)
        late = sum(f"{stem}_{j + 1}" in names for j in range(model.n))  # up to one step too long
        at, last = np.arange(x.shape[-2]) + late - ago, x.shape[-2] - 1
        newer, older = (x[..., np.clip(at - j, 0, last), :] for j in (0, 1 if late else 0))
        x[..., i] = (older + 0.5 * model.difference(newer, older))[..., k]
    return x


def known_states(trial: Trial, shown: Sequence[int]) -> list[int]:
    """Return which of the states with a sensor have a value in a trial."""
    return [i for i in shown if np.isfinite(trial.states[:, i]).any()]


@dataclass(frozen=True)
class Fit:
    """The result of calibrating a model on one trial; 1 for states without a sensor."""

    rms: Array  # error of each state (n,), in its unit
    gains: Array  # of each input (m,)
    moved: Array  # how far each state moves in that time (n,)

    @property
    def score(self) -> float:
        """Sum of the logarithms of the errors [nats]; it is invariant to exchanged columns."""
        return float(np.log(self.rms).sum())

    @property
    def share(self) -> Array:
        """Share of each state's motion that is missed (n,), at most 1: nothing is predicted."""
        return np.asarray(np.clip(self.rms / np.maximum(self.moved, TINY), SMALL, 1.0))

    @property
    def missed(self) -> float:
        """Sum of the logarithms of the shares [nats], at most 0; it is the same in any unit."""
        return float(np.log(self.share).sum())


class Ahead:
    """Predictions of one trial.

    Args:
        model: however crude.
        trial: of its states and inputs.
        shown: indices of the states with a sensor.
        starts: largest number of samples to predict from.
        delays: command delays tried [s].
        linear: also remove errors that are linear in the initial states.
        constant: remove a constant rate of each state.
        horizon: how far ahead is predicted [s].
        early: steps by which commands may act early.
    """

    def __init__(
        self,
        model: Model,
        trial: Trial,
        shown: Sequence[int],
        starts: int,
        delays: Sequence[float] = DELAYS,
        *,
        linear: bool = False,
        constant: bool = True,
        horizon: float = AHEAD_S,
        early: int = 0,
    ) -> None:
        self.model, self.shown, self.sent, self.dt = model, list(shown), trial.inputs, trial.dt
        self.steps = max(1, round(horizon / trial.dt))
        self.delays = tuple(dict.fromkeys(round(d / trial.dt) for d in delays))
        logged = starts_from(model, trial.states, self.shown)
        good = np.asarray(np.isfinite(logged).all(axis=1))
        at = np.flatnonzero(good[: -self.steps] & good[self.steps :])
        at = at[(at >= max(self.delays)) & (at + self.steps + early <= len(self.sent))]
        self.at = at[:: -(-len(at) // starts)] if len(at) else at
        self.first, self.last = logged[self.at], logged[self.at + self.steps]
        self.left_out = basis(self.first[:, self.shown] if linear else self.first[:, :0])
        self.left_out = self.left_out if constant else self.left_out[:, :0]
        moves = np.nanstd(logged[:, self.shown], axis=0) if good.any() else np.zeros(len(shown))
        self.least = EXACT * moves + TINY
        free = {k: one for k, one in enumerate(model.params.values()) if one.uncertain}
        self.moving, self.spread = list(free), model.spreads[list(free)]
        ends = np.array([(one.low, one.high) for one in free.values()], float)  # NaN without one
        self.low, self.high = ends.reshape(-1, 2).T

    @property
    def enough(self) -> bool:
        """Whether there are enough samples, and all commands are known."""
        sent = bool(np.isfinite(self.sent).all())
        return sent and len(self.at) >= FEWEST_SAMPLES and bool(self.shown)

    @property
    def moved(self) -> Array:
        """How far each state moves until the predicted time (n,), rms about the mean."""
        found = np.ones(self.model.n)
        off = self.model.difference(self.last, self.first)[:, self.shown]
        found[self.shown] = off.std(axis=0)
        return found

    def whatever_commands_do(self) -> Ahead:
        """Return a copy that also removes errors linear in the past and present commands."""
        h, half = self.steps, max(1, self.steps // 2)
        sums = np.concatenate([np.zeros((1, self.model.m)), np.cumsum(self.sent, axis=0)])
        spans = [(-h, 0), (0, half)] + ([(half, h)] if half < h else [])
        starts = [np.maximum(self.at + a, 0) for a, _ in spans]
        told = [sums[self.at + b] - sums[a] for a, (_, b) in zip(starts, spans, strict=True)]
        other = copy(self)
        other.left_out = basis(np.hstack([self.left_out, *told]))
        return other

    def plain(self, gains: Array) -> Fit:
        """Return the fit of the uncalibrated model with given gains (m,) of its inputs."""
        return self._fit(self.size(self._off(gains, self.model.values, 0)[0]), gains)

    def scores(self, gains: Array, late: Steps) -> Array:
        """Return the errors of the uncalibrated model [nats] with commands (K,) steps late."""
        off = self._off(gains, self.model.values, late)
        return np.array([np.log(self.size(one)).sum() for one in off])

    def best(self, starts: Sequence[Array], *, free: bool = True, late: int | None = None) -> Fit:
        """Return the best fit over several initial gains, which are fitted as well if `free`.

        Commands are `late` by some steps; None: by the one of `delays` that fits best.
        """
        each = np.array(self.delays if late is None else [late])
        fits = [
            self._fitted(gains, int(each[self.scores(gains, each).argmin()]), free=free)
            for gains in starts
        ]
        return min(fits, key=lambda fit: fit.score)

    def _fitted(self, gains: Array, late: int, *, free: bool) -> Fit:
        """Fit gains (if free) and parameters by Gauss-Newton, each state weighted by its error."""
        m = self.model.m if free else 0
        prior = np.concatenate([np.zeros(m), np.ones(len(self.moving))])
        theta = np.zeros(len(prior))

        def off(theta: Array) -> Array:
            """Return the errors (K, N, shown) for several parameter vectors (K, q)."""
            own = (gains, self.model.values)
            moved, values = (np.repeat(one[None], len(theta), axis=0) for one in own)
            moved[:, :m] += theta[:, :m]
            shifted = values[:, self.moving] + theta[:, m:] * self.spread
            values[:, self.moving] = np.fmin(np.fmax(shifted, self.low), self.high)
            return self._off(moved, values, late)

        (r,) = off(theta[None])
        size = self.size(r)
        for _ in range(ROUNDS if len(theta) else 0):
            each = (off(theta + SLOPE * np.eye(len(theta))) - r) / size / SLOPE
            J, white = each.reshape(len(theta), -1).T, (r / size).ravel()
            if not (np.isfinite(J).all() and np.isfinite(white).all()):
                break  # the prediction diverges
            H = J.T @ J + np.diag(prior + 1e-9 * len(white))
            step = -np.linalg.lstsq(H, J.T @ white + prior * theta, rcond=None)[0]
            (new,) = off((theta + step)[None])
            if not np.log(self.size(new) / size).sum() < 0:
                break
            theta, r, size = theta + step, new, self.size(new)
        found = gains.copy()
        found[:m] += theta[:m]
        return self._fit(size, found)

    def _off(self, gains: Array, values: Array, late: int | Steps) -> Array:
        """Return the errors (K, N, shown) minus the removed parts, usually at least their means.

        For K gains (K, m), parameters (K, k) and delays (K,); a single one is broadcast.
        """
        off = self.missed(gains, values, late)
        return np.asarray(off - self.left_out @ (self.left_out.T @ off))

    def missed(self, gains: Array, values: Array, late: int | Steps) -> Array:
        """Return the errors of the predictions (K, N, shown), nothing removed.

        For K gains (K, m), parameters (K, k) and delays (K,) in steps; a single one is broadcast.
        Before the trial its first command is taken as sent.
        """
        gains, values, late = np.atleast_2d(gains), np.atleast_2d(values), np.atleast_1d(late)
        K, N = max(len(gains), len(values), len(late)), len(self.at)
        at = self.at - late[:, None]
        x, last = np.tile(self.first, (K, 1)), np.tile(self.last, (K, 1))
        own = np.repeat(np.broadcast_to(values, (K, values.shape[1])), N, axis=0)
        stepped = stepper(self.model, own, self.dt)
        for j in range(self.steps):
            sent = self.sent[np.maximum(at + j, 0)]
            u = np.broadcast_to(sent * gains[:, None], (K, N, self.model.m))
            x = stepped(x, u.reshape(K * N, -1))
            x = np.fmax(np.fmin(x, STATES_BOUND), -STATES_BOUND)
        return np.asarray(self.model.difference(x, last)[:, self.shown].reshape(K, N, -1))

    def size(self, off: Array) -> Array:
        """Return the rms of errors (..., N, shown) by state, at least what counts."""
        size = np.sqrt((off**2).mean(axis=0))
        return np.asarray(np.maximum(np.where(np.isfinite(size), size, STATES_BOUND), self.least))

    def _fit(self, size: Array, gains: Array) -> Fit:
        rms = np.ones(self.model.n)
        rms[self.shown] = size
        return Fit(rms, gains, self.moved)


def basis(told: Array) -> Array:
    """Return an orthonormal basis (N, k) of a constant and the columns `told` (N, m)."""
    told = told - told.mean(axis=0) if len(told) else told
    spread = told.std(axis=0) if len(told) else np.zeros(told.shape[1])
    own = spread > TINY
    columns = np.hstack([np.ones((len(told), 1)), told[:, own] / spread[own]])
    turned, size, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(turned[:, size > SAME * size.max(initial=0.0)])
