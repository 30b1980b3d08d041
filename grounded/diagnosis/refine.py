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
from typing import Any

import numpy as np

from grounded.diagnosis import filter as kalman
from grounded.diagnosis.data import Data
from grounded.diagnosis.hypothesis import Hypothesis, Predictor, param_scale
from grounded.diagnosis.noise import Noise, cleaned, climbed
from grounded.frozen import Array

MOST_NUMBERS = 1.2e7  # of one (L, B, N, N) array


@dataclass(frozen=True, eq=False)
class Fit:
    """A hypothesis at its most likely values.

    Per run (B): `gram` (B, C, C), `score` (B, C), `rss` (B,), `logdet` (B,) of the whitened columns
    in the order [effects' free values, shifts]; `white` (L, B, n) are the whitened innovations.
    """

    hypothesis: Hypothesis
    noise: Noise
    track: Array  # (L + 1, B, n)
    loglik: float  # of the data
    evidence: float  # log p(y | h): the shifts integrated out
    gram: Array
    score: Array
    rss: Array
    logdet: Array
    white: Array
    residual: Array  # (L, B, n) x_{t+1|t+1} - prediction: what the filter had to correct

    @property
    def covariance(self) -> Array:
        """Of the free values and shifts, (C, C), from the Fisher information."""
        G = self.gram.sum(axis=0) + np.diag(self.prior)
        return np.linalg.pinv(G, hermitian=True)

    def prior_pull(self, data: Data) -> Array:
        """The prior's slope at the shifts as they are, (C,)."""
        h, pull = self.hypothesis, np.zeros(self.gram.shape[-1])
        k = len(h.theta)
        if h.shift is not None and len(pull) > k:
            which = calibrated(data)
            pull[k:] = self.prior[k:] * h.shift[which] / param_scale(data.model)[which]
        return pull

    @property
    def prior(self) -> Array:
        """Precision of each column, (C,): zero for effects."""
        h = self.hypothesis
        k = len(h.theta)
        return np.concatenate(
            [np.zeros(k), shift_precision(self.hypothesis, self.gram.shape[-1] - k)]
        )


def shift_precision(h: Hypothesis, count: int) -> Array:
    """Prior precision of the calibrated parameters' shifts (count,), in units of their scale."""
    return np.full(count, 1.0 / h.spread**2) if count else np.zeros(0)


def calibrated(data: Data) -> Any:
    """Parameters that have a scale, as indices: those that a shift makes sense for."""
    return np.flatnonzero(param_scale(data.model) > 0)


@dataclass(eq=False)
class _Work:
    """One hypothesis on its way: mutable, private to this module."""

    h: Hypothesis
    noise: Noise
    track: Array
    best: Fit | None = None
    boldness: float = 1.0
    still: int = 0

    def done(self) -> bool:
        return self.still >= 2


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
    parts = [_linearised(predictor, work) for work in works]
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
            work.still = 2
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
        F, d, r = _linearised(predictor, work)
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


def _linearised(predictor: Predictor, work: _Work) -> tuple[Array, Array, Array]:
    """F (L, B, n, n); columns of d and r: the residual first, then each value, then each shift."""
    data, h = predictor.data, work.h
    model, track = data.model, work.track
    L, B = data.time.shape
    x = track[:-1]
    u = predictor.inputs(h)
    after = predictor.advance(h, x, u, data.time)
    ahead = np.concatenate([track[:1], after])  # predicted: a measurement must not explain itself
    offset = predictor.offset(h, ahead)
    columns_d = [model.difference(after, track[1:])]
    columns_r = [model.difference(data.y - track, np.asarray(offset))]
    theta = h.theta
    for j, size in enumerate(step_sizes(h)):
        other, moved = _nudged(h, theta, j, size)
        if moved == 0:
            columns_d.append(np.zeros_like(after))
            columns_r.append(np.zeros_like(track))
            continue
        columns_d.append(
            model.difference(predictor.advance(other, x, predictor.inputs(other), data.time), after)
            / moved
        )
        shifted = predictor.offset(other, ahead)
        columns_r.append((np.zeros_like(track) + offset - shifted) / moved)
    d, r = np.stack(columns_d, axis=-1), np.stack(columns_r, axis=-1)
    flat = (
        np.ascontiguousarray(x.reshape(-1, model.n)),
        np.ascontiguousarray(u.reshape(-1, model.m)),
    )
    p = predictor.params(h)
    if h.spread > 0:
        which = calibrated(data)
        f_x, _, f_p = model.system.sensitivities(*flat, p, data.dt)
        scaled = f_p[:, :, which] * param_scale(model)[which]
        d = np.concatenate([d, scaled.reshape(L, B, model.n, -1)], axis=-1)
        r = np.concatenate([r, np.zeros((L + 1, B, model.n, len(which)))], axis=-1)
    else:
        f_x, _ = model.system.linearise(*flat, p, data.dt)
    return f_x.reshape(L, B, model.n, model.n), d, r


def noise_entry(predictor: Predictor, h: Hypothesis, track: Array) -> Array | None:
    """G of the filter (L, B, n, n): a carried heading rate moves with what it is a function of."""
    tied = predictor.tied()
    if not tied:
        return None
    data = predictor.data
    model, (L, B) = data.model, data.time.shape
    x = np.ascontiguousarray(track[1:].reshape(-1, model.n))
    u = np.ascontiguousarray(predictor.inputs(h).reshape(-1, model.m))
    short = 1e-3 * data.dt
    f_x, _ = model.system.linearise(x, u, predictor.params(h), short)
    G = np.zeros((L * B, model.n, model.n))
    G[:, np.arange(model.n), np.arange(model.n)] = 1.0
    for heading, rate in tied:
        slope = f_x[:, heading, :] / short
        slope[:, [heading, rate]] = 0.0
        G[:, rate, :] += slope
    return G.reshape(L, B, model.n, model.n)


def base_columns(predictor: Predictor, fit: Fit) -> tuple[Array, Array]:
    """What a fit's own values and shifts add to d and r: (L, B, n, C), (L + 1, B, n, C)."""
    _, d, r = _linearised(predictor, _Work(fit.hypothesis, fit.noise, fit.track))
    return d[..., 1:], r[..., 1:]


def step_sizes(h: Hypothesis) -> list[float]:
    """Half a step of the difference quotient of each free value."""
    sizes = []
    for effect, values in zip(h.effects, h.values, strict=True):
        for q in effect.free:
            if q.grid:
                grid = np.sort(np.array(q.grid))
                near = int(np.argmin(np.abs(grid - values[q.name])))
                gaps = np.diff(grid) if len(grid) > 1 else np.array([abs(grid[0]) or 1.0])
                sizes.append(0.1 * float(gaps[min(near, len(gaps) - 1)]))
            else:
                sizes.append(1e-3 * max(abs(values[q.name]), 1e-2))
    return sizes


def _nudged(h: Hypothesis, theta: Array, j: int, size: float) -> tuple[Hypothesis, float]:
    up = theta.copy()
    up[j] += size
    other = h.with_theta(up)
    moved = float(other.theta[j] - theta[j])
    if moved == 0:
        up[j] = theta[j] - size
        other = h.with_theta(up)
        moved = float(other.theta[j] - theta[j])
    return other, moved


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
    data, h = predictor.data, work.h
    residual, columns = white[..., 0], white[..., 1:]
    fit = _scored(predictor, work, residual, columns, logdet, filtered[..., 0])
    rise = np.inf if work.best is None else fit.evidence - work.best.evidence
    if not np.isfinite(fit.evidence):
        work.still = 2
        return
    work.still = 0 if rise > 0.05 else work.still + 1
    if rise > 0:
        work.best = fit
    elif work.best is not None and rise < -1.0:  # overshot: back to the best, more carefully
        work.boldness *= 0.5
        best = work.best
        middle = 0.5 * (best.hypothesis.theta + h.theta)
        work.h = replace(best.hypothesis.with_theta(middle), shift=best.hypothesis.shift)
        work.noise, work.track = best.noise, best.track
        return
    prior = fit.prior
    G = fit.gram.sum(axis=0) + np.diag(prior)
    slope = fit.score.sum(axis=0) + fit.prior_pull(data)
    k = len(h.theta)
    if len(slope):
        scale = 1 / np.sqrt(np.maximum(np.diag(G), 1e-300))
        delta = -scale * np.linalg.lstsq(G * np.outer(scale, scale), scale * slope, rcond=1e-10)[0]
        delta[:k] = _limited(h, delta[:k])
        work.h = h.with_theta(h.theta + delta[:k])
        if len(slope) > k:
            which = calibrated(data)
            shift = np.zeros(data.model.system.k) if h.shift is None else h.shift.copy()
            shift[which] += np.clip(delta[k:], -0.3, 0.3) * param_scale(data.model)[which]
            work.h = replace(work.h, shift=_inside(data, shift))
        work.track = work.track + filtered[..., 0] + filtered[..., 1:] @ delta
    else:
        work.track = work.track + filtered[..., 0]
    if memory is not None:
        work.noise = climbed(work.noise, adjoint, memory, data.dt, work.boldness)


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
        white=residual,
        residual=error[1:],
    )
