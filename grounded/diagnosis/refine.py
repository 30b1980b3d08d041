"""Maximum likelihood of many hypotheses at once: effects, parameters, noise and track together.

For each hypothesis, again and again until nothing rises: predict along its own track; whiten by the
Kalman filter; one Gauss-Newton step in the effects' values and the parameters' shifts; one scoring
step in the noise; take the filtered track as the new track. A track that was filtered with a wrong
model hides what is wrong with it, so every hypothesis gets its own.

The shifts of the model's parameters have a normal prior and are integrated out (Laplace):

    log p(y | h) = loglik - shift' P shift / 2 - log det(1 + P^-1 G) / 2,   P = (spread scale)^-2

All hypotheses of one noise structure step through time together, along the batch axis.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.diagnosis import filter as kalman
from grounded.diagnosis.columns import linearised, noise_entry, step_sizes
from grounded.diagnosis.data import Data
from grounded.diagnosis.fitted import Fit, calibrated, shift_precision
from grounded.diagnosis.hypothesis import Hypothesis, Predictor, param_scale
from grounded.diagnosis.information import information
from grounded.diagnosis.noise import Noise, channel_information, cleaned, climbed, slopes
from grounded.frozen import Array

MOST_NUMBERS = 2e6  # of one (L, B, N, N) array: what fits in the cache goes fastest
MEASURED = (2, 7, 14)  # ages at which the noise's information is measured
SHORTEST = 0.02  # part of a step that is still tried


@dataclass(eq=False)
class _Step:
    """A step that was proposed at the best point: of values, shifts, track; the noise it leads to."""

    theta: Array
    shift: Array  # in units of param_scale
    track: Array
    noise: Noise


@dataclass(eq=False)
class _Work:
    """One hypothesis on its way: mutable, private to this module."""

    h: Hypothesis
    noise: Noise
    track: Array
    best: Fit | None = None
    step: _Step | None = None
    part: float = 1.0  # of the step that is taken
    still: int = 0
    age: int = 0  # points that were better than all before

    def done(self) -> bool:
        return self.still >= 1

    def shorten(self, data: Data) -> None:
        """Half the step, or the end where it is too short to matter."""
        self.part *= 0.4
        if self.best is None or self.part < SHORTEST:
            self.still = 1
        else:
            self.go(data)

    def go(self, data: Data) -> None:
        """From the best point by a part of the step."""
        assert self.best is not None
        assert self.step is not None
        best, step, part = self.best, self.step, self.part
        h = best.hypothesis
        self.h = h.with_theta(h.theta + part * step.theta)
        if len(step.shift):
            which = calibrated(data)
            shift = np.zeros(data.model.system.k) if h.shift is None else h.shift.copy()
            shift[which] += part * step.shift * param_scale(data.model)[which]
            self.h = replace(self.h, shift=_inside(data, shift))
        self.noise = best.noise.towards(step.noise, part)
        self.track = best.track + part * step.track


def refine(
    predictor: Predictor,
    starts: Sequence[Fit | tuple[Hypothesis, Noise, Array]],
    *,
    iterations: int = 6,
    tick: Callable[[], None] | None = None,
    fixed_noise: bool = False,
) -> list[Fit]:
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
        _Work(s.hypothesis, s.noise, s.track) if isinstance(s, Fit) else _Work(*s) for s in starts
    ]
    if not works:
        return []
    L, B, n = predictor.data.time.shape[0], data.time.shape[1], data.model.n
    wide = n if works[0].noise.structure.tau is None else 2 * n
    size = max(1, int(MOST_NUMBERS / (L * B * wide * wide)))
    for _ in range(iterations):
        active = [work for work in works if not work.done()]
        for at in range(0, len(active), size):
            _iterate(predictor, active[at : at + size], fixed_noise)
        if tick is not None:
            tick()
    return [work.best for work in works if work.best is not None]


def _iterate(predictor: Predictor, works: list[_Work], fixed_noise: bool) -> None:
    data = predictor.data
    L, B = data.time.shape
    parts = [linearised(predictor, work.h, work.track) for work in works]
    width = max(part[1].shape[-1] for part in parts)
    d = np.concatenate([_padded(part[1], width) for part in parts], axis=1)
    r = np.concatenate([_padded(part[2], width) for part in parts], axis=1)
    F = np.concatenate([part[0] for part in parts], axis=1)
    carried = [noise_entry(predictor, work.h, work.track) for work in works]
    entries = [entry for entry in carried if entry is not None]
    G = np.concatenate(entries, axis=1) if entries else None
    phi = works[0].noise.structure.phi(data.dt)
    Q = np.concatenate([_spread(w.noise.process(data.dt), (L, B)) for w in works], axis=1)
    R = np.concatenate([_spread(w.noise.measurement(L), (L + 1, B)) for w in works], axis=1)
    start = np.concatenate([w.noise.start(B) for w in works])
    seen = np.tile(data.seen, (1, len(works), 1))
    try:
        g = kalman.gains(kalman.transition(F, phi, G), Q, R, seen, start, G)
    except np.linalg.LinAlgError:
        for work in works:
            work.still = 1
        if len(works) > 1:  # one of them diverged: each alone
            for work in works:
                work.still = 0
                _iterate(predictor, [work], fixed_noise)
        return
    white, filtered = kalman.innovations(g, d, r, track=True)
    assert filtered is not None
    back = kalman.smoother(g, white[..., 0])
    for i, work in enumerate(works):
        own = slice(i * B, (i + 1) * B)
        adjoint = kalman.Adjoint(back.u[:, own], back.D[:, own], back.r[:, own], back.N[:, own])
        columns = parts[i][1].shape[-1]
        memory = np.einsum("tbii->i", parts[i][0]) / (L * B)
        _update(
            predictor,
            work,
            white[:, own, :, :columns],
            g.logdet[:, own],
            filtered[:, own, :, :columns],
            adjoint,
            None if fixed_noise else memory,
        )


def clean(predictor: Predictor, fit: Fit, rounds: int = 8) -> Fit:
    """The same hypothesis with outliers weighed down, its noise fitted to the rest."""
    data = predictor.data
    L, B = data.time.shape
    work = _Work(fit.hypothesis, fit.noise, fit.track)
    for _ in range(rounds):
        if not np.isfinite(work.track).all():
            return fit
        F, d, r = linearised(predictor, work.h, work.track)
        G = noise_entry(predictor, work.h, work.track)
        try:
            g = kalman.gains(
                kalman.transition(F, work.noise.structure.phi(data.dt), G),
                work.noise.process(data.dt),
                work.noise.measurement(L),
                data.seen,
                work.noise.start(B),
                G,
            )
        except np.linalg.LinAlgError:
            return fit
        white, filtered = kalman.innovations(g, d[..., :1], r[..., :1], track=True)
        assert filtered is not None
        work.noise = cleaned(work.noise, kalman.smoother(g, white[..., 0]))
        work.track = work.track + filtered[..., 0]
        if not all(np.isfinite(a).all() for a in (work.track, work.noise.log_q, work.noise.log_r)):
            return fit
    found = refine(predictor, [(work.h, work.noise, work.track)], iterations=4)
    return found[0] if found else fit


def _spread(values: Array | float, shape: tuple[int, int]) -> Array:
    array = np.asarray(values)
    return np.broadcast_to(array, (*shape, array.shape[-1]))


def _padded(columns: Array, width: int) -> Array:
    missing = width - columns.shape[-1]
    return np.pad(columns, [(0, 0)] * (columns.ndim - 1) + [(0, missing)]) if missing else columns


def _update(
    predictor: Predictor,
    work: _Work,
    white: Array,
    logdet: Array,
    filtered: Array,
    adjoint: kalman.Adjoint,
    memory: Array | None,
) -> None:
    """Scores the point where the work stands, keeps it if it is the best, and moves on."""
    data = predictor.data
    residual, columns = white[..., 0], white[..., 1:]
    fit = _scored(predictor, work, residual, columns, logdet, filtered[..., 0])
    rise = np.inf if work.best is None else fit.evidence - work.best.evidence
    if not rise > 0:  # too far, or not finite: part of the way from the best point
        work.shorten(data)
        return
    work.still = 0 if rise > 0.03 else 1
    work.age += 1
    if memory is not None and work.age in MEASURED and (fit.noise.info is None or work.age > 4):
        work.noise = _measured(predictor, fit)
        fit = replace(fit, noise=work.noise)
    work.best = fit
    work.part = min(1.0, 2 * work.part)
    work.step = _proposed(data, fit, filtered, adjoint, memory)
    work.go(data)


def _proposed(
    data: Data, fit: Fit, filtered: Array, adjoint: kalman.Adjoint, memory: Array | None
) -> _Step:
    """Gauss-Newton in values and shifts, scoring in the noise, the filtered track as the track."""
    h = fit.hypothesis
    G = fit.gram.sum(axis=0) + np.diag(fit.prior)
    slope = fit.score.sum(axis=0) + fit.prior_pull(data)
    k, track = len(h.theta), filtered[..., 0]
    theta, shift = np.zeros(k), np.zeros(len(slope) - k)
    if len(slope):
        scale = 1 / np.sqrt(np.maximum(np.diag(G), 1e-300))
        delta = -scale * np.linalg.lstsq(G * np.outer(scale, scale), scale * slope, rcond=1e-10)[0]
        delta[:k] = _limited(h, delta[:k])
        delta[k:] = np.clip(delta[k:], -0.3, 0.3)
        theta, shift = delta[:k], delta[k:]
        track = track + filtered[..., 1:] @ delta
    noise = fit.noise if memory is None else _climbed(data, fit.noise, adjoint, memory)
    return _Step(theta, shift, track, noise)


def _climbed(data: Data, noise: Noise, adjoint: kalman.Adjoint, memory: Array) -> Noise:
    count = int(data.valid.sum())
    info = noise.info
    if info is None:
        info = channel_information(noise, memory, data.dt, count)
    return climbed(noise, slopes(noise, adjoint, data.dt), info, count)


def _measured(predictor: Predictor, fit: Fit) -> Noise:
    """A fit's noise with the information of its variances measured."""
    data = predictor.data
    L, B = data.time.shape
    F, d, r = linearised(predictor, fit.hypothesis, fit.track)
    G = noise_entry(predictor, fit.hypothesis, fit.track)

    def adjoints(noises: list[Noise]) -> list[kalman.Adjoint]:
        H = len(noises)
        many = None if G is None else np.tile(G, (1, H, 1, 1))
        phi = fit.noise.structure.phi(data.dt)
        g = kalman.gains(
            kalman.transition(np.tile(F, (1, H, 1, 1)), phi, many),
            np.concatenate([_spread(w.process(data.dt), (L, B)) for w in noises], axis=1),
            np.concatenate([_spread(w.measurement(L), (L + 1, B)) for w in noises], axis=1),
            np.tile(data.seen, (1, H, 1)),
            np.concatenate([w.start(B) for w in noises]),
            many,
        )
        column, of_log = np.tile(d[..., :1], (1, H, 1, 1)), np.tile(r[..., :1], (1, H, 1, 1))
        white, _ = kalman.innovations(g, column, of_log)
        back = kalman.smoother(g, white[..., 0])
        parts = [slice(i * B, (i + 1) * B) for i in range(H)]
        return [kalman.Adjoint(back.u[:, p], back.D[:, p], back.r[:, p], back.N[:, p]) for p in parts]

    try:
        info = information(fit.noise, adjoints, data.dt)
    except np.linalg.LinAlgError:
        return fit.noise
    return replace(fit.noise, info=info) if np.isfinite(info).all() else fit.noise


def _limited(h: Hypothesis, delta: Array) -> Array:
    """Scanned values move by at most two grid gaps at once: between grid points anything may be."""
    limits = [
        20 * s if q.grid else np.inf
        for s, q in zip(step_sizes(h), [q for e in h.effects for q in e.free], strict=True)
    ]
    return np.clip(delta, -np.array(limits), np.array(limits))


def _inside(data: Data, shift: Array) -> Array:
    """Keeps parameters inside their bounds, and positive ones positive."""
    values = data.model.values
    low = [-np.inf if p.low is None else p.low for p in data.model.params.values()]
    high = [np.inf if p.high is None else p.high for p in data.model.params.values()]
    low = [max(b, 0.2 * v) if v > 0 else b for b, v in zip(low, values, strict=True)]
    high = [min(b, 0.2 * v) if v < 0 else b for b, v in zip(high, values, strict=True)]
    return np.clip(values + shift, low, high) - values


def _scored(
    predictor: Predictor, work: _Work, residual: Array, columns: Array, logdet: Array, error: Array
) -> Fit:
    data, h = predictor.data, work.h
    L, B, n, C = columns.shape
    by_run = np.ascontiguousarray(columns.swapaxes(0, 1)).reshape(B, L * n, C)
    flat = np.ascontiguousarray(residual.swapaxes(0, 1)).reshape(B, L * n)
    gram = by_run.swapaxes(1, 2) @ by_run
    score = (by_run.swapaxes(1, 2) @ flat[:, :, None])[:, :, 0]
    rss = (flat**2).sum(axis=1)
    run_logdet = logdet.sum(axis=0)
    count = data.seen[1:].sum()
    loglik = -0.5 * float(rss.sum() + run_logdet.sum() + count * np.log(2 * np.pi))
    evidence, k = loglik, len(h.theta)
    if k < C:
        precision = shift_precision(h, C - k)
        which = calibrated(data)
        shift = 0.0 if h.shift is None else h.shift[which] / param_scale(data.model)[which]
        G = gram.sum(axis=0)[k:, k:] / np.sqrt(np.outer(precision, precision))
        evidence -= 0.5 * float(np.sum(precision * np.square(shift)))
        evidence -= 0.5 * float(np.linalg.slogdet(np.eye(C - k) + G)[1])
    return Fit(
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
