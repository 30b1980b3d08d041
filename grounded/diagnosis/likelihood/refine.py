"""Maximum likelihood of many hypotheses at once: effects, parameters, noise and track together.

For each hypothesis, again and again until nothing rises: predict along its own track; whiten by the
Kalman filter; one Gauss-Newton step in the effects' values and the parameters' shifts; one scoring
step in the noise; take the filtered track as the new track. All steps start from the best point so
far, and one that does not rise is taken in part, so that nothing is lost by boldness (`Work`). A
track that was filtered with a wrong model hides what is wrong with it, so every hypothesis gets its
own.

The shifts of the model's parameters have a normal prior and are integrated out (Laplace):

    log p(y | h) = loglik - shift' P shift / 2 - log det(1 + P^-1 G) / 2,   P = (spread scale)^-2

All hypotheses of one noise structure step through time together, along the batch axis.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.diagnosis.likelihood.data import Data
from grounded.diagnosis.likelihood.delays import Delays, delays_of
from grounded.diagnosis.likelihood.fitted import Fitted, calibrated, moved, shift_precision
from grounded.diagnosis.likelihood.hypothesis import Hypothesis, Predictor, param_scale
from grounded.diagnosis.likelihood.linearise import (
    filter_system,
    gains_of,
    linearise,
    smoothed,
    step_sizes,
)
from grounded.diagnosis.likelihood.noise import (
    NoiseModel,
    average,
    cleaned,
    climbed,
    likelihood_slopes,
    working,
)
from grounded.effects import SensorDelayFamily
from grounded.filter import kalman
from grounded.filter.augmented import Delayed, joined
from grounded.filter.kalman import LinearSystem
from grounded.frozen import Array
from grounded.threads import each

MOST_NUMBERS = 1e5  # of one (L, B, N, N) array: what fits in the cache goes fastest
SHORTEST = 0.05  # part of a step that is still tried
BELIEVED = 3.0  # standard deviations, as the user gave them, that a parameter may be off


@dataclass(eq=False)
class ProposedStep:
    """A step proposed at the best point: of values, shifts, track; the noise it leads to."""

    delta: Array  # (C,) of the values, then of the shifts in units of param_scale
    track: Array
    noise: NoiseModel


@dataclass(eq=False)
class Work:
    """One hypothesis on its way: mutable, private to this module."""

    h: Hypothesis
    noise: NoiseModel
    track: Array
    best: Fitted | None = None
    step: ProposedStep | None = None
    part: float = 1.0  # of the step that is taken
    still: bool = False  # it no longer rises
    moving: bool = True  # the track too: where the model has kinks that may not help

    def shorten(self, data: Data) -> None:
        """The same step about the track as it was; then parts of it; then the end."""
        if self.moving:
            self.moving = False
        else:
            self.part *= 0.4
        if self.best is None or self.part < SHORTEST:
            self.still = True
        else:
            self.go(data)

    def go(self, data: Data) -> None:
        """From the best point by a part of the step."""
        assert self.best is not None
        assert self.step is not None
        best, step, part = self.best, self.step, self.part
        self.h = moved(data, best.hypothesis, part * step.delta)
        if len(step.delta) > len(self.h.theta) and self.h.shift is not None:
            self.h = replace(self.h, shift=_inside(data, self.h.shift))
        self.noise = best.noise.towards(step.noise, part)
        self.track = best.track + step.track if self.moving else best.track


def proposed(data: Data, fit: Fitted, filtered: Array, noise: NoiseModel) -> ProposedStep:
    """Gauss-Newton in values and shifts, scoring in the noise, the filtered track as the track."""
    h = fit.hypothesis
    G = fit.gram.sum(axis=0) + np.diag(fit.prior)
    slope = fit.score.sum(axis=0) + fit.prior_pull(data)
    k, track, delta = len(h.theta), filtered[..., 0], np.zeros(len(slope))
    if len(slope):
        delta = _bounded(G, slope, *_room(data, h, k, len(slope)))
        delta[:k] = _limited(h, delta[:k])
        delta[k:] = np.clip(delta[k:], -0.3, 0.3)
        by = delta != 0
        track = track + filtered[..., 1:][..., by] @ delta[by]
    return ProposedStep(delta, track, noise)


def _bounded(G: Array, slope: Array, low: Array, high: Array) -> Array:
    """The Gauss-Newton step -G^-1 slope within low <= step <= high, (K,) each.

    An unknown that would leave its bounds stops there, and the others step as is best with it
    there: clipped afterwards, they would rely on a move that is not made. One whose slope is no
    number (a value at which the effect overflows) does not move.
    """
    delta, free = np.zeros(len(slope)), np.isfinite(np.diag(G)) & np.isfinite(slope)
    G, slope = np.where(np.outer(free, free), G, 0.0), np.where(free, slope, 0.0)
    scale = 1 / np.sqrt(np.maximum(np.diag(G), 1e-300))
    while free.any():
        left = slope[free] + G[np.ix_(free, ~free)] @ delta[~free]
        scaled = G[np.ix_(free, free)] * np.outer(scale[free], scale[free])
        step = -scale[free] * np.linalg.lstsq(scaled, scale[free] * left, rcond=1e-10)[0]
        delta[free] = np.clip(step, low[free], high[free])
        stopped = delta[free] != step
        if not stopped.any():
            break
        free[np.flatnonzero(free)[stopped]] = False
    return delta


def _room(data: Data, h: Hypothesis, k: int, size: int) -> tuple[Array, Array]:
    """How far each unknown may step down and up: values freely, shifts inside their bounds."""
    low, high = np.full(size, -np.inf), np.full(size, np.inf)
    if size > k:
        which = calibrated(data)
        shift = np.zeros(data.model.system.k) if h.shift is None else h.shift
        lowest, highest = _bounds(data)
        at, unit = data.model.values + shift, np.maximum(param_scale(data.model), 1e-300)
        low[k:] = np.minimum((lowest - at) / unit, 0.0)[which]
        high[k:] = np.maximum((highest - at) / unit, 0.0)[which]
    return low, high


def _limited(h: Hypothesis, delta: Array) -> Array:
    """Scanned values move by at most two grid gaps at once: between grid points anything may be."""
    limits = [
        20 * s if q.grid else np.inf
        for s, q in zip(step_sizes(h), [q for e in h.effects for q in e.free], strict=True)
    ]
    return np.clip(delta, -np.array(limits), np.array(limits))


def _inside(data: Data, shift: Array) -> Array:
    """Keeps parameters inside their bounds."""
    values = data.model.values
    return np.asarray(np.clip(values + shift, *_bounds(data)) - values)


def _bounds(data: Data) -> tuple[Array, Array]:
    """Bounds of the model's parameters, (k,) each; where none is given the sign stays.

    Nor does one go further than three of its own standard deviations: thousands of nats of a model
    that is wrong elsewhere would carry a measured length to a fifth of itself.
    """
    params = data.model.params.values()
    low = [
        p.low if p.low is not None else 0.2 * p.value if p.value > 0 else -np.inf for p in params
    ]
    high = [
        p.high if p.high is not None else 0.2 * p.value if p.value < 0 else np.inf for p in params
    ]
    far = np.array([np.inf if p.std is None else BELIEVED * p.std for p in params])
    values = data.model.values
    return np.maximum(low, values - far), np.minimum(high, values + far)


def refine(
    predictor: Predictor,
    starts: Sequence[Fitted | tuple[Hypothesis, NoiseModel, Array]],
    *,
    iterations: int = 6,
    tick: Callable[[], None] | None = None,
    fixed_noise: bool = False,
) -> list[Fitted]:
    """Refines hypotheses that share a noise structure; the result has the same order.

    Args:
        predictor: the data.
        starts: fits to go on from, or (hypothesis, noise, track).
        iterations: at most; a hypothesis that stopped rising is left alone.
        tick: called after each iteration.
        fixed_noise: keep the noise as it is.
    """
    data = predictor.data
    works = [
        Work(s.hypothesis, s.noise, s.track) if isinstance(s, Fitted) else Work(*s) for s in starts
    ]
    if not works:
        return []
    L, B, n = predictor.data.time.shape[0], data.time.shape[1], data.model.n
    wide = n if works[0].noise.structure.tau is None else 2 * n
    size = max(1, int(MOST_NUMBERS / (L * B * wide * wide)))
    for _ in range(iterations):
        shapes = _of_one_shape([work for work in works if not work.still])
        blocks = [a[at : at + size] for a in shapes for at in range(0, len(a), size)]
        each(lambda block: _iterate(predictor, block, fixed_noise), blocks)
        if tick is not None:
            tick()
    return [work.best for work in works if work.best is not None]


def _of_one_shape(works: list[Work]) -> list[list[Work]]:
    """Works whose filters have states of one size: as many sensors are delayed."""
    groups: dict[int, list[Work]] = {}
    for work in works:
        count = sum(isinstance(e.family, SensorDelayFamily) for e in work.h.effects)
        groups.setdefault(count, []).append(work)
    return [groups[count] for count in sorted(groups)]


def _iterate(predictor: Predictor, works: list[Work], fixed_noise: bool) -> None:
    data = predictor.data
    B = data.time.shape[1]
    late = [delays_of(work.h, data) for work in works]
    parts = [linearise(predictor, work.h, work.track) for work in works]
    width = kalman.whole(max(part[1].shape[-1] for part in parts), data.model.n)
    d, r = (_side_by_side([part[k] for part in parts], width) for k in (1, 2))
    systems = [
        filter_system(predictor, work.h, work.noise, work.track, part[0])
        for work, part in zip(works, parts, strict=True)
    ]
    system, delayed = joined(systems)
    try:
        g = kalman.gains(system, delayed)
    except np.linalg.LinAlgError:
        if len(works) == 1:
            works[0].still = True
        else:  # one of them diverged: each alone
            for work in works:
                _iterate(predictor, [work], fixed_noise)
        return
    white, filtered = kalman.innovations(g, d, r, track=True)
    assert filtered is not None
    started = smoothed(data, g, np.concatenate([part[0] for part in parts], axis=1), white[..., 0])
    if started is not None:
        filtered[0, ..., 0] += started
    steps = [work.noise for work in works]
    if not fixed_noise:
        steps = _climbed(data, works, late, systems, g, white[..., 0])
    for i, work in enumerate(works):
        own = slice(i * B, (i + 1) * B)
        columns, before, delays = parts[i][1].shape[-1], 0.0, late[i]
        if delays is not None:
            entry, residual = systems[i][0].G, white[:, own, :, 0]
            before = delays.before(work.noise, entry, work.track, residual, g.weight[:, own])
        _update(
            predictor,
            work,
            white[:, own, :, :columns],
            g.logdet[:, own],
            filtered[:, own, :, :columns],
            steps[i],
            before,
        )


def _climbed(
    data: Data,
    works: list[Work],
    delays_each: list[Delays | None],
    systems: list[tuple[LinearSystem, Delayed | None]],
    g: kalman.Gains,
    white: Array,
) -> list[NoiseModel]:
    """Each work's noise after one step up the likelihood."""
    B, width = data.time.shape[1], data.model.n
    adjoints = kalman.smoother(g, white).parts(B)
    columns_each = []
    for work, delays, (own, _), adjoint in zip(works, delays_each, systems, adjoints, strict=True):
        noise = work.noise if delays is None else delays.noise(work.noise)
        columns_each.append(working(noise, adjoint, own.G, data.dt))
    K = columns_each[0][0].shape[-1]
    wide = kalman.whole(K, width)
    d, r = (_side_by_side([part[k] for part in columns_each], wide) for k in (0, 1))
    columns = kalman.innovations(g, d, r)[0]
    found = []
    for i, (work, delays, adjoint) in enumerate(zip(works, delays_each, adjoints, strict=True)):
        info = average(columns[:, i * B : (i + 1) * B, :, :K])
        in_log = adjoint if delays is None else delays.restored(adjoint)
        slope = likelihood_slopes(work.noise, in_log, data.dt)
        found.append(climbed(work.noise, slope, info, int(data.valid.sum())))
    return found


def clean(predictor: Predictor, fit: Fitted, rounds: int = 8) -> Fitted:
    """The same hypothesis with outliers weighed down, its noise fitted to the rest."""
    work = Work(fit.hypothesis, fit.noise, fit.track)
    for _ in range(rounds):
        if not np.isfinite(work.track).all():
            return fit
        F, d, r = linearise(predictor, work.h, work.track)
        try:
            g = gains_of(predictor, work.h, work.noise, work.track, F)
        except np.linalg.LinAlgError:
            return fit
        white, filtered = kalman.innovations(g, d[..., :1], r[..., :1], track=True)
        assert filtered is not None
        started = smoothed(predictor.data, g, F, white[..., 0])
        if started is not None:
            filtered[0, ..., 0] += started
        adjoint, delays = kalman.smoother(g, white[..., 0]), delays_of(work.h, predictor.data)
        work.noise = cleaned(work.noise, adjoint if delays is None else delays.restored(adjoint))
        work.track = work.track + filtered[..., 0]
        if not all(np.isfinite(a).all() for a in (work.track, work.noise.log_q, work.noise.log_r)):
            return fit
    found = refine(predictor, [(work.h, work.noise, work.track)], iterations=4)
    return found[0] if found else fit


def _side_by_side(parts: Sequence[Array], width: int) -> Array:
    """Columns (steps, B, n, any) of several works along the runs, zeros up to `width`."""
    steps, B, n, _ = parts[0].shape
    found = np.zeros((steps, B * len(parts), n, width))
    for i, part in enumerate(parts):
        found[:, i * B : (i + 1) * B, :, : part.shape[-1]] = part
    return found


def _update(
    predictor: Predictor,
    work: Work,
    white: Array,
    logdet: Array,
    filtered: Array,
    climbed: NoiseModel,
    before: float,
) -> None:
    """Scores the point where the work stands, keeps it if it is the best, and moves on."""
    data = predictor.data
    residual, columns = white[..., 0], white[..., 1:]
    fit = _scored(predictor, work, residual, columns, logdet, filtered[..., 0], before)
    rise = np.inf if work.best is None else fit.evidence - work.best.evidence
    if not (rise > 0 and np.isfinite(fit.evidence)):
        work.shorten(data)
        return
    work.still = not rise > 0.03
    work.moving = work.moving or rise > 1.0
    work.part = min(1.0, 2 * work.part)
    work.best = fit
    work.step = proposed(data, fit, filtered, climbed)
    work.go(data)


def _scored(
    predictor: Predictor,
    work: Work,
    residual: Array,
    columns: Array,
    logdet: Array,
    error: Array,
    before: float,
) -> Fitted:
    data, h = predictor.data, work.h
    L, B, n, C = columns.shape
    by_run = np.ascontiguousarray(columns.swapaxes(0, 1)).reshape(B, L * n, C)
    flat = np.ascontiguousarray(residual.swapaxes(0, 1)).reshape(B, L * n)
    gram = by_run.swapaxes(1, 2) @ by_run
    score = (by_run.swapaxes(1, 2) @ flat[:, :, None])[:, :, 0]
    rss = (flat**2).sum(axis=1)
    run_logdet = logdet.sum(axis=0)
    count = data.seen[1:].sum()
    loglik = -0.5 * float(rss.sum() + run_logdet.sum() + count * np.log(2 * np.pi)) + before
    evidence, k = loglik, len(h.theta)
    if k < C:
        precision = shift_precision(h, C - k)
        which = calibrated(data)
        shift = 0.0 if h.shift is None else h.shift[which] / param_scale(data.model)[which]
        G = gram.sum(axis=0)[k:, k:] / np.sqrt(np.outer(precision, precision))
        evidence -= 0.5 * float(np.sum(precision * np.square(shift)))
        evidence -= 0.5 * float(np.linalg.slogdet(np.eye(C - k) + G)[1])
    return Fitted(
        hypothesis=h,
        noise=work.noise,
        track=work.track,
        loglik=loglik,
        evidence=evidence,
        gram=gram,
        score=score,
        rss=rss,
        logdet=run_logdet,
        white=residual.copy(),  # not a view: it would keep all columns
        residual=error[1:].copy(),
    )
