"""How an error passes through a step of a hypothesis: the model's Jacobian, its effects' too.

    F_h = (1 + dt/2 A_1) F (1 + dt/2 A_0),     A = d rate / d x at the start, at the end

An added rate that depends on the state (a coupling, a friction) moves errors as the model does:
left out, the noise of one state shows up unexplained in another. Effects in proportion to the
model's own rates take their slope from F. A heading rate that is only carried along is the
heading's rate, effects and all: its row follows from the heading's slope.

A dry friction's slope at rest is as steep as its smoothing is narrow; it is bounded, so that no
error turns its sign within half a step.

The slope of one step in the model's parameters, thresholds included.

A threshold (the throttle below which a motor stalls) has no derivative: a small change moves no
sample across it. Where a parameter's derivative is zero at every sample, the secant over a few
per cent of its size takes its place, so that a threshold that is off is found like any other
parameter, and not blamed on an effect.
"""

from __future__ import annotations

import numpy as np

from grounded.diagnosis.hypothesis import Hypothesis, Predictor, limits_of, param_scale, rates_of
from grounded.frozen import Array
from grounded.model import Model

SMALL = 1e-4  # of a state's spread: the difference that a slope is taken over
STEEPEST = 1.0  # of a rate's own state, per half step


def with_effects(predictor: Predictor, h: Hypothesis, x: Array, u: Array, F: Array) -> Array:
    """The Jacobian of a hypothesis' step from x (L, B, n); F (L, B, n, n) of the model alone."""
    one, data = np.eye(x.shape[-1]), predictor.data
    F = passed(predictor, h, x, u, F, one)
    if not rates_of(h):
        return F
    after, half, mean = predictor.advance(h, x, u, data.time), 0.5 * data.dt, (F - one) / data.dt
    first = slopes(predictor, h, x, u, data.time, mean)
    direct = slopes(predictor, h, after, u, data.time + data.dt, None)
    later = F + half * direct @ F
    if any(e.family.needs_own for e, _ in rates_of(h)):
        # at the end the model's own rate is still the mean of the step: a function of its start
        later += half * (slopes(predictor, h, after, u, data.time + data.dt, mean) - direct)
    found = later @ (one + half * first)
    for heading, rate in predictor.tied():
        row = heading_slope(predictor, h, after, u, data.time + data.dt, heading, rate)
        row = (row[..., None, :] @ found)[..., 0, :]
        row -= heading_slope(predictor, h, x, u, data.time, heading, rate)
        row[..., rate] += 1.0
        found[..., rate, :] = row
    return np.asarray(found)


def passed(
    predictor: Predictor,
    h: Hypothesis,
    x: Array,
    u: Array,
    slopes: Array,
    still: Array | float = 0.0,
) -> Array:
    """What limits of rates leave of the model's slopes (L, B, n, k) from x (L, B, n).

    A state that moves as fast as it can no longer depends on the model: its slope is that of
    standing `still` (n, k), for the part of the step that it does.
    """
    limits = limits_of(h)
    if not limits:
        return slopes
    data, p = predictor.data, predictor.params(h)
    parts = max(e.family.parts for e, _ in limits)
    dt, held = data.dt / parts, np.zeros_like(x)
    for k in range(parts):
        t, own = data.time + k * dt, (predictor.step(x, u, p, dt) - x) / dt
        tiny = 1e-6 * np.abs(own).max(axis=(0, 1)) + 1e-12
        added, more = (
            predictor.added_rate(limits, x, u, t, predictor.named(rate))
            for rate in (own, own + tiny)
        )
        held += (more - added) / tiny / parts  # 0: free, -1: held back
        x = x + dt * (own + added)
    return np.asarray(slopes + held[..., None] * (slopes - still))


def slopes(
    predictor: Predictor, h: Hypothesis, x: Array, u: Array, t: Array, of_own: Array | None
) -> Array:
    """Slope of the added rates (L, B, n, n) [1/s] at x (L, B, n).

    of_own: slope of the model's own rates, (L, B, n, n) or broadcastable; None: they stay.
    """
    rates, data = rates_of(h), predictor.data
    n, half, names = x.shape[-1], 0.5 * data.dt, data.model.state_names
    if not rates:
        return np.zeros((*x.shape, n))
    needs = any(e.family.needs_own for e, _ in rates)
    own = (predictor.step(x, u, predictor.params(h)) - x) / data.dt if needs else x
    base = predictor.added_rate(rates, x, u, t, predictor.named(own))
    found = np.empty((*x.shape, n))
    for j, name in enumerate(names):
        size = SMALL * data.scales.spread(name)
        other = x.copy()
        other[..., j] += size
        moved = own if of_own is None else own + size * of_own[..., j]
        rate = predictor.added_rate(rates, other, u, t, predictor.named(moved))
        found[..., j] = (rate - base) / size
    i = np.arange(n)
    found[..., i, i] = np.maximum(found[..., i, i], -STEEPEST / half)
    return found


def heading_slope(
    predictor: Predictor, h: Hypothesis, x: Array, u: Array, t: Array, heading: int, rate: int
) -> Array:
    """Slope of the heading's rate of this very moment, effects and all, (L, B, n) [1/s]."""
    data, n = predictor.data, x.shape[-1]
    short = 1e-3 * data.dt
    flat = np.ascontiguousarray(x.reshape(-1, n))
    inputs = np.ascontiguousarray(u.reshape(-1, u.shape[-1]))
    f_x, _ = data.model.system.linearise(flat, inputs, predictor.params(h), short)
    own = ((f_x - np.eye(n)) / short).reshape(*x.shape, n)
    slope, name = own[..., heading, :].copy(), data.model.state_names[heading]
    if any(name in e.site.targets or f"{name}<-" in e.name for e, _ in rates_of(h)):
        slope += slopes(predictor, h, x, u, t, own)[..., heading, :]
    slope[..., [heading, rate]] = 0.0
    return np.asarray(slope)


PART = 0.05  # of a parameter's size, to each side


def sensitivities(model: Model, x: Array, u: Array, p: Array, dt: float) -> tuple[Array, Array]:
    """f_x (N, n, n) and f_p (N, n, k) of one step from x (N, n) with received inputs u (N, m)."""
    f_x, _, f_p = model.system.sensitivities(x, u, p, dt)
    flat = np.flatnonzero(~f_p.any(axis=(0, 1)) & (param_scale(model) > 0))
    for i in flat:
        size = PART * param_scale(model)[i]
        ends = []
        for sign in (-1, 1):
            moved = p.copy()
            moved[i] += sign * size
            ends.append(model.system.step(x, u, moved, dt))
        f_p[:, :, i] = model.difference(ends[1], ends[0]) / (2 * size)
    return f_x, f_p
