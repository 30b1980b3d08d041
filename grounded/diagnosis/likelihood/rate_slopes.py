"""Jacobian of a step with added and limited rates, from A = d rate / d x (see `linearise`)."""

from __future__ import annotations

import numpy as np

from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.effects.sensed import behind_logs
from grounded.frozen import Array

STATE_NUDGE = 1e-4  # finite-difference step as a fraction of a state's spread
STEEPEST = 1.0  # most damping of a rate by its own state over half a step


def with_effects(
    predictor: Predictor, h: Hypothesis, x: Array, u: Array, F: Array, after: Array | None = None
) -> Array:
    """Return the Jacobian of a hypothesis' step from x (L, B, n), given the model's own F."""
    one, data = np.eye(x.shape[-1]), predictor.data
    F = passed(predictor, h, x, u, F, one)
    if not h.rates and not (h.limits and predictor.tied):
        return logged_slopes(predictor, h, F) if h.limits else F
    after = predictor.advance(h, x, u, data.time) if after is None else after
    half, mean = 0.5 * data.dt, (F - one) / data.dt
    first = rate_slopes(predictor, h, x, u, data.time, mean)
    direct = rate_slopes(predictor, h, after, u, data.time + data.dt, None)
    soft = direct
    if any(e.family.dry for e, _ in h.rates):
        soft = rate_slopes(predictor, h, after, u, data.time + data.dt, None, soft=True)
    later = F + half * (direct + half * soft @ direct) @ F  # where the second half leads
    if any(e.family.needs_own for e, _ in h.rates):
        # the model's own rate used at the end is the step's mean, a function of the start
        later += half * (rate_slopes(predictor, h, after, u, data.time + data.dt, mean) - direct)
    found = later @ (one + half * first)
    for heading, rate in predictor.tied:
        row = heading_slope(predictor, h, after, u, data.time + data.dt, heading, rate)
        row = (row[..., None, :] @ found)[..., 0, :]
        row -= heading_slope(predictor, h, x, u, data.time, heading, rate)
        row[..., rate] += 1.0
        found[..., rate, :] = row
    return logged_slopes(predictor, h, np.asarray(found))


def logged_slopes(predictor: Predictor, h: Hypothesis, F: Array) -> Array:
    """Return the Jacobian (..., n, n) with the rows of delayed logs made from the true values'."""
    if behind_logs(predictor.data.model) is None:
        return F
    columns = np.swapaxes(F, -1, -2)
    nudged = np.broadcast_to(np.eye(F.shape[-1]), columns.shape)
    return np.swapaxes(predictor.logged(h, nudged, columns), -1, -2)


def passed(
    predictor: Predictor,
    h: Hypothesis,
    x: Array,
    u: Array,
    slopes: Array,
    still: Array | float = 0.0,
) -> Array:
    """Return the model's slopes (L, B, n, k) from x (L, B, n) under limits of rates.

    A state that moves at its limit no longer depends on the model. For that part of the step its
    slope is `still` (n, k), that of a state at rest.
    """
    limits = h.limits
    if not limits:
        return slopes
    data = predictor.data
    parts = max(e.family.parts for e, _ in limits)
    dt, held = data.dt / parts, np.zeros_like(x)
    for k in range(parts):
        t, own = data.time + k * dt, (predictor.moved(h, x, u, dt) - x) / dt
        tiny = 1e-6 * np.abs(own).max(axis=(0, 1)) + 1e-12
        added, more = (
            predictor.added_rate(limits, x, u, t, predictor.named(rate))
            for rate in (own, own + tiny)
        )
        held += (more - added) / tiny / parts  # 0: free, -1: at its limit
        x = x + dt * (own + added)
    return np.asarray(slopes + held[..., None] * (slopes - still))


def rate_slopes(
    predictor: Predictor,
    h: Hypothesis,
    x: Array,
    u: Array,
    t: Array,
    of_own: Array | None,
    *,
    now: bool = False,
    soft: bool = False,
) -> Array:
    """Return the slope of the added rates in the state, (L, B, n, n) [1/s], at x (L, B, n).

    Args:
        predictor: evaluates the hypothesis on the data.
        h: the hypothesis.
        x: states (L, B, n).
        u: received inputs (L, B, m).
        t: times (L, B) [s].
        of_own: slope of the model's own rates, (L, B, n, n) or broadcastable; None: held constant.
        now: use instantaneous rates, limits included, instead of means over the step.
        soft: without dry frictions.
    """
    rates, data = [*h.rates, *(h.limits if now else [])], predictor.data
    rates = [(e, v) for e, v in rates if not (soft and e.family.dry)]
    n, half, names = x.shape[-1], 0.5 * data.dt, data.model.state_names
    if not rates:
        return np.zeros((*x.shape, n))
    own = x
    if any(e.family.needs_own for e, _ in rates):
        own = predictor.instant(h, x, u) if now else (predictor.moved(h, x, u) - x) / data.dt
    # the rates at the states and beside them, in each state's direction: (1 + n, L, B, n)
    size = np.array([0.0, *(STATE_NUDGE * data.scales.spread(name) for name in names)])
    beside = np.broadcast_to(x, (1 + n, *x.shape)).copy()
    moved = np.broadcast_to(own, beside.shape)
    moved = moved.copy() if of_own is not None else moved
    for j in range(n):
        beside[1 + j, ..., j] += size[1 + j]
        if of_own is not None:
            moved[1 + j] += size[1 + j] * of_own[..., j]
    rate = predictor.added_rate(rates, beside, u, t, predictor.named(moved))
    found = np.moveaxis((rate[1:] - rate[0]) / size[1:].reshape(-1, *[1] * x.ndim), 0, -1).copy()
    i = np.arange(n)
    found[..., i, i] = np.maximum(found[..., i, i], -STEEPEST / half)
    return np.asarray(found)


def heading_slope(
    predictor: Predictor, h: Hypothesis, x: Array, u: Array, t: Array, heading: int, rate: int
) -> Array:
    """Return the slope of the heading's instantaneous rate, effects included, (L, B, n) [1/s]."""
    short = 1e-3 * predictor.data.dt
    f_x, _ = predictor.slopes(x, u, predictor.params(h), short)
    one, name = np.eye(x.shape[-1]), predictor.seen[heading]
    slope = (f_x[..., heading, :] - one[heading]) / short
    acting = [*h.rates, *h.limits]
    if any(name in e.site.targets or f"{name}<-" in e.name for e, _ in acting):
        own = (f_x - one) / short
        slope += rate_slopes(predictor, h, x, u, t, own, now=True)[..., heading, :]
    slope[..., [heading, rate]] = 0.0
    return np.asarray(slope)
