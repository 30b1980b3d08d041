"""A hypothesis to first order: its Jacobian, its residual, what each of its values adds to a step.

    e_{t+1} = F_t e_t + d_t,   r_t = y_t - x_t - offset_t

d and r as columns: the residual first, then the derivative by each value and each shift. Where a
sensor is late, r_t is that of the sample that shows the state at t (`delays.py`).
"""

from __future__ import annotations

import numpy as np

from grounded.diagnosis import filter as kalman
from grounded.diagnosis.delayed_measurement import Late, System
from grounded.diagnosis.delays import delays_of
from grounded.diagnosis.fitted import Fit, calibrated
from grounded.diagnosis.hypothesis import Hypothesis, Predictor, param_scale
from grounded.diagnosis.initial_state import widened
from grounded.diagnosis.jacobian import PART, heading_slope, passed, sensitivities, with_effects
from grounded.diagnosis.noise import Noise
from grounded.effects import ParamFamily
from grounded.frozen import Array


def linearised(predictor: Predictor, h: Hypothesis, track: Array) -> tuple[Array, Array, Array]:
    """F (L, B, n, n); columns of d and r: the residual first, then each value, then each shift."""
    data = predictor.data
    model = data.model
    x = track[:-1]
    u = predictor.inputs(h)
    after = predictor.advance(h, x, u, data.time)
    ahead = np.concatenate([track[:1], after])  # predicted: a measurement must not explain itself
    delays = delays_of(h, data)
    y, here, shown = data.y, track, ahead
    if delays is not None:
        y, here, shown = delays.samples()[0], delays.shown(track, track), delays.shown(ahead, track)
    offset = predictor.standing(h, shown)
    columns_d = [model.difference(after, track[1:])]
    columns_r = [model.difference(y - here, np.asarray(offset))]
    theta = h.theta
    for j, sizes in enumerate(_tried(h)):
        by_d, by_r = np.zeros_like(after), np.zeros_like(track)
        for size in sizes:
            other, moved = _nudged(h, theta, j, size)
            if moved == 0:
                continue
            ahead_too = predictor.advance(other, x, predictor.inputs(other), data.time)
            by_d = model.difference(ahead_too, after) / moved
            other_shown = shown if delays is None else delays.moved(other).shown(ahead, track)
            shifted = predictor.standing(other, other_shown)
            by_r = (shown - other_shown + offset - shifted) / moved
            if by_d.any() or by_r.any():
                break
        columns_d.append(by_d)
        columns_r.append(by_r)
    F, of_shifts = _sensitivities(predictor, h, x, u)
    more = np.zeros((*track.shape, of_shifts.shape[-1]))
    d = np.concatenate([np.stack(columns_d, axis=-1), of_shifts], axis=-1)
    return F, d, np.concatenate([np.stack(columns_r, axis=-1), more], axis=-1)


def _sensitivities(predictor: Predictor, h: Hypothesis, x: Array, u: Array) -> tuple[Array, Array]:
    """F (L, B, n, n) and what each shift adds to a step, (L, B, n, k); k = 0 without shifts."""
    if h.spread == 0:
        return jacobian(predictor, h, x), np.zeros((*x.shape, 0))
    which = calibrated(predictor.data)
    F, f_p = sensitivities_of(predictor, h, x, u)
    return F, f_p[..., which] * param_scale(predictor.data.model)[which]


def sensitivities_of(
    predictor: Predictor, h: Hypothesis, x: Array, u: Array
) -> tuple[Array, Array]:
    """Of a hypothesis' steps from x (L, B, n): F (L, B, n, n), slope in all parameters (..., k)."""
    data, (L, B, n) = predictor.data, x.shape
    flat = (np.ascontiguousarray(x.reshape(-1, n)), np.ascontiguousarray(u.reshape(L * B, -1)))
    f_x, f_p = sensitivities(data.model, *flat, predictor.params(h), data.dt)
    F = with_effects(predictor, h, x, u, f_x.reshape(L, B, n, n))
    return F, passed(predictor, h, x, u, f_p.reshape(L, B, n, -1))


def jacobian(predictor: Predictor, h: Hypothesis, track: Array) -> Array:
    """F of every step along a track (L or more, B, n), (L, B, n, n)."""
    data, u = predictor.data, predictor.inputs(h)
    model, (L, B) = data.model, data.time.shape
    flat_x = np.ascontiguousarray(track[:L].reshape(-1, model.n))
    flat_u = np.ascontiguousarray(u.reshape(-1, model.m))
    f_x, _ = model.system.linearise(flat_x, flat_u, predictor.params(h), data.dt)
    return with_effects(predictor, h, track[:L], u, f_x.reshape(L, B, model.n, model.n))


def noise_entry(predictor: Predictor, h: Hypothesis, track: Array) -> Array | None:
    """G of the filter (L, B, n, n): a carried heading rate moves with what it is a function of."""
    tied = predictor.tied()
    if not tied:
        return None
    data = predictor.data
    x, u, n = track[1:], predictor.inputs(h), data.model.n
    G = np.zeros((*x.shape, n))
    G[..., np.arange(n), np.arange(n)] = 1.0
    for heading, rate in tied:
        G[..., rate, :] += heading_slope(predictor, h, x, u, data.time + data.dt, heading, rate)
    return G


def system_of(
    predictor: Predictor, h: Hypothesis, noise: Noise, track: Array, F: Array
) -> tuple[System, Late | None]:
    """What the filter of a hypothesis is made of; F (L, B, n, n)."""
    data = predictor.data
    (L, B, n, _), delays = F.shape, delays_of(h, data)
    seen, late = data.seen, None
    if delays is not None:
        noise, seen, late = delays.noise(noise), delays.samples()[1], delays.late()
    G = noise_entry(predictor, h, track)
    A = kalman.transition(F, noise.structure.phi(data.dt), G)
    Q = np.broadcast_to(noise.process(data.dt), (L, B, A.shape[-1]))
    R = widened(data, np.broadcast_to(noise.measurement(L), (L + 1, B, n)), seen)
    return System(A, Q, R, seen, noise.start(B), G), late


def gains_of(
    predictor: Predictor, h: Hypothesis, noise: Noise, track: Array, F: Array
) -> kalman.Gains:
    """The gains of a hypothesis' filter; F (L, B, n, n)."""
    system, late = system_of(predictor, h, noise, track, F)
    return kalman.gains(*system, late)


def base_columns(predictor: Predictor, fit: Fit) -> tuple[Array, Array]:
    """What a fit's own values and shifts add to d and r: (L, B, n, C), (L + 1, B, n, C)."""
    _, d, r = linearised(predictor, fit.hypothesis, fit.track)
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


def _tried(h: Hypothesis) -> list[tuple[float, ...]]:
    """The step of each free value; for a parameter that may be a threshold a larger one beside."""
    effects = [effect for effect in h.effects for _ in effect.free]
    found: list[tuple[float, ...]] = []
    for effect, size in zip(effects, step_sizes(h), strict=True):
        if isinstance(effect.family, ParamFamily):
            value = effect.site.model.params[effect.site.target].value
            found.append((size, PART * abs(value)))
        else:
            found.append((size,))
    return found


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
