"""Standard deviations of the values of a fit: the largest of three estimates.

1. The inverse Fisher information, which assumes that the model is right. Where innovations are
   correlated, it is that of as many samples as are independent.
2. The jackknife over trials, each left out once (Efron & Tibshirani 1993, ch. 11).
3. A jackknife over stretches of time, each left out of all trials at once. Trials of one manoeuvre
   share the errors of the model and agree on a biased value, which the second does not show. With
   s_p and G_p the score and the information of a stretch p of all trials,

       sum_p s_p' G_p^-1 s_p ~ chi-squared

   if model and noise are right. This estimate counts only where the sum is too large to be chance,
   so that the values change along the manoeuvre. It is a sandwich estimate clustered by time
   (Cameron & Miller, A practitioner's guide to cluster-robust inference, 2015, its CR3). It says
   nothing about a value that only one stretch determines.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from grounded.diagnosis.error_report import TIMES
from grounded.diagnosis.likelihood.data import Data
from grounded.diagnosis.likelihood.fitted import Fitted, calibrated, leave_one_out, moved
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.linearise import gains_of, linearise, thresholds
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.likelihood.refine import refine
from grounded.diagnosis.likelihood.step import room
from grounded.filter import kalman
from grounded.frozen import Array

NORMAL = 1.96  # half-width of a 95 % interval in standard deviations
DELAY, LAGS = "sensor_delay", ("first_order_lag", "sensor_lag")
STRETCHES = (5, 10, 20)  # numbers of stretches tried, since the duration of misfits is unknown
SHORTEST_STRETCH = 4  # fewest steps of a stretch
# p-values of differing scores between which the model is more and more taken to be wrong: with a
# single one, an interval would double by the last bit
CHANCE, CLEAR = 0.02, 0.005
DROP = 3.67  # [nats] within which a threshold has its 95 % interval
# standard deviations of the prior between two bounds, and the farthest move
FARTHEST_MOVE = 12**0.5
HALVINGS, ZOOMS, PARTS = 10, 3, 4  # of the widest move; then in parts between two of them
# smallest fraction of the information taken to be left without a stretch
LEFT_WITHOUT_STRETCH = 0.2


def standard_deviations(
    predictor: Predictor,
    fit: Fitted,
    trial_of: Array,
    worth: float = 1.0,
    *,
    thresholds_too: bool = False,
) -> tuple[Array, Array]:
    """Return each unknown's standard deviation and half-width of its 95 % interval, (C,) each.

    Args:
        predictor: evaluates hypotheses on the data of the fit.
        fit: the fit at its most likely values.
        trial_of: the group that each run is left out with, usually its trial (B,).
        worth: what a nat is worth, below 1 if innovations are correlated: the same samples then
            hold less information (`grounded.filter.tempering`).
        thresholds_too: follow the likelihood of parameters that have no slope, which takes some
            tens of predictions each; else theirs are those of their secants.
    """
    if fit.gram.shape[-1] == 0:
        return np.zeros(0), np.zeros(0)
    std = fisher(worth * fit.gram.sum(axis=0) + np.diag(fit.prior))
    half = NORMAL * std
    shifts = leave_one_out(fit, trial_of, unseen=0.0)
    for some in (shifts, *_by_stretch(predictor, fit)):
        if len(some) >= 3:
            scatter = np.sqrt((len(some) - 1) * some.var(axis=0))
            std = np.maximum(std, scatter)
            half = np.maximum(half, _student(len(some) - 1) * scatter)
    for j in thresholds(predictor, fit) if thresholds_too else ():
        half[j] = np.abs(level(predictor, fit, j, DROP / worth)).max()
        std[j] = half[j] / NORMAL
    smeared = np.hypot(
        between_steps(fit.hypothesis, predictor.data.dt, len(std)),
        between_samples(fit.hypothesis, predictor.data, len(std)),
    )
    return np.hypot(std, smeared), np.hypot(half, NORMAL * smeared)


def level(predictor: Predictor, fit: Fitted, j: int, drop: float) -> tuple[float, float]:
    """Return how far unknown j may move, down and up, until the fit falls by `drop` nats.

    The unknowns are those of `moved`. Noise and track stay as they are; room ends at the bounds.
    """
    data, h = predictor.data, fit.hypothesis
    unit = np.arange(fit.gram.shape[-1]) == j

    def within(moves: Any) -> Any:
        """Return whether the fit is within `drop` after each move, (N,)."""
        tried = [replace(moved(data, h, move * unit), spread=0.0) for move in moves]
        starts = [(one, fit.noise, fit.track) for one in tried]
        found = refine(predictor, starts, iterations=1, fixed_noise=True)
        if len(found) < len(starts):  # one could not be filtered
            return np.zeros(len(moves), bool)
        return np.array([fit.loglik - one.loglik <= drop for one in found])

    sides = []
    for sign, ends in zip((-1.0, 1.0), room(data, h, len(unit)), strict=True):
        near, far = 0.0, min(abs(float(ends[j])), FARTHEST_MOVE)
        steps = far * 2.0 ** np.arange(-HALVINGS, 1)
        for _ in range(ZOOMS if far > 0 else 0):
            beyond = np.flatnonzero(~within(sign * steps))
            if not len(beyond):
                break
            near, far = [near, *steps][beyond[0]], steps[beyond[0]]
            steps = np.linspace(near, far, PARTS + 1)[1:]
        sides.append(sign * far)
    return sides[0], sides[1]


def between_steps(h: Hypothesis, dt: float, count: int) -> Array:
    """Return how far off lags and sensors' delays that end between two steps may be, (count,) [s].

    A log that is late by a part p of a step shows a mean of two steps, which spreads a signal by
    p (1 - p) dt^2 as a lag spreads it by tau^2. Beside it the lag is short by p (1 - p) dt^2 /
    (2 tau), and the delay longer by as much.
    """
    found, owners = np.zeros(count), [(e, v, q) for e, v in h.pairs for q in e.free]
    values = [(k, e.family.name, v[q.name]) for k, (e, v, q) in enumerate(owners)]
    late = {k: value / dt % 1.0 for k, name, value in values if name == DELAY}
    lags = {k: max(value, dt) for k, name, value in values if name in LAGS and value > 0}
    spread = {k: p * (1 - p) * dt**2 for k, p in late.items()}
    if lags and spread:
        most, shortest = max(spread.values()), min(lags.values())
        found[[*lags]] = [most / (2 * tau) for tau in lags.values()]
        found[[*spread]] = [own / (2 * shortest) for own in spread.values()]
    return found


def between_samples(h: Hypothesis, data: Data, count: int) -> Array:
    """Return how far off times may be since states were interpolated, (count,), as the unknowns.

    A step of an input bends the states' course, and a straight line between the samples around a
    bend has the response begin early. So a delay comes out short by up to the time that the line
    begins early, and a lag longer by as much: of a log at 50 Hz, on a grid of 20 Hz, 0.0462 s for
    0.050 s and 0.104 s for 0.100 s.
    """
    found, free = np.zeros(count), [e.family.name for e in h.effects for _ in e.free]
    if not data.interpolated_s:
        return found
    found[[k for k, name in enumerate(free) if name in TIMES]] = data.interpolated_s
    which, scale = calibrated(data), data.model.spreads
    for k, i in enumerate(which if count > len(free) else ()):
        param = list(data.model.params.values())[i]
        off = moved_by(data.interpolated_s, param.value, param.unit)
        found[len(free) + k] = off / scale[i]
    return found


def moved_by(seconds: float, value: float, unit: str) -> float:
    """Return by how much a value of a model changes if a time does; 0 if it is no time or rate."""
    return seconds * {"s": 1.0, "1/s": value**2}.get(unit, 0.0)


def _student(freedom: int) -> float:
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 0.975))


def _by_stretch(predictor: Predictor, fit: Fitted) -> list[Array]:
    """Return the changes of all values without each stretch, (P, C) per significant partition."""
    from scipy.special import chdtrc

    data = predictor.data
    F, d, r = linearise(predictor, fit.hypothesis, fit.track)
    gains = gains_of(predictor, fit.hypothesis, fit.noise, fit.track, F)
    white = kalman.innovations(gains, d, r)[0]
    axes = _whitener(fit.gram.sum(axis=0) + np.diag(fit.prior))
    columns, steps = white[..., 1:] @ axes, np.rint(data.time / data.dt).astype(int)
    length, found = int(data.lengths.max()), []
    for count in (c for c in STRETCHES if length >= SHORTEST_STRETCH * c and axes.size):
        part = steps * count // length
        s, G = np.zeros((count, axes.shape[1])), np.zeros((count, *2 * axes.shape[1:]))
        for p in range(count):
            own = columns[part == p].reshape(-1, axes.shape[1])
            s[p] = own.T @ white[..., 0][part == p].ravel()
            G[p] = own.T @ own
        share, turned = np.linalg.eigh(G)
        along = np.einsum("pij,pi->pj", turned, s)
        told = share > 1e-6
        surprise = float((along[told] ** 2 / share[told]).sum())
        value = float(chdtrc(max(int(told.sum()) - len(s[0]), 1), surprise))
        weight = min(float(np.log(max(value, 1e-300) / CHANCE) / np.log(CLEAR / CHANCE)), 1.0)
        if weight > 0:
            moved = np.einsum(
                "pij,pj->pi", turned, along / np.maximum(1 - share, LEFT_WITHOUT_STRETCH)
            )
            found.append(weight * moved @ axes.T)
    return found


def _whitener(information: Array) -> Array:
    """Return A (C, K) with A' information A = 1, over all directions with any information."""
    scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    size, axes = np.linalg.eigh(information * np.outer(scale, scale))
    known = size > 1e-10
    return np.asarray(scale[:, None] * axes[:, known] / np.sqrt(size[known]))


def fisher(information: Array) -> Array:
    """Return standard deviations from an information matrix (C, C).

    Unknowns that take part in a direction without information get a very large one.
    """
    scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    size, axes = np.linalg.eigh(information * np.outer(scale, scale))
    return np.asarray(scale * np.sqrt((axes**2 / np.maximum(size, 1e-12)).sum(axis=1)))
