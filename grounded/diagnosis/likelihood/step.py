"""The next step of a fit: values of the effects, shifts of the parameters, track and noise.

The step in values and shifts is Gauss-Newton within bounds. Values stay inside their own,
parameters keep their sign or the user's bounds, scanned values move by a few grid gaps at most.
The bounds are part of the least-squares problem. Clipping the unbounded step instead would leave
the other unknowns relying on a move that is not made. Where two unknowns are strongly correlated (a
viscous friction, a motor's gain) the clipped step lowers the likelihood and the fit gets stuck.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grounded.diagnosis.likelihood.data import Data
from grounded.diagnosis.likelihood.fitted import Fitted, calibrated
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.linearise import step_sizes
from grounded.diagnosis.likelihood.noise import NoiseModel
from grounded.frozen import Array

LEAP = 0.3  # most that a parameter's shift moves in one step, in units of its scale
ROUNDS = 4  # most changes of what is held at its bound, per unknown
GAPS = 20  # most that a scanned value moves in one step, in units of `step_sizes` (two grid gaps)


@dataclass(eq=False)
class ProposedStep:
    """A step from the best point in values, shifts and track, and the noise that it leads to."""

    delta: Array  # (C,) of the values, then of the shifts in units of `Model.spreads`
    track: Array
    noise: NoiseModel
    promise: float  # gain expected by the quadratic model [nats]


def proposed(
    data: Data, fit: Fitted, filtered: Array, noise: NoiseModel, promise: float
) -> ProposedStep:
    """Propose a step: Gauss-Newton in values and shifts; track and noise are given.

    Args:
        data: the data.
        fit: the best point so far.
        filtered: the filtered columns (L + 1, B, n, 1 + C): the track's correction, and its
            derivatives by the values and shifts; further columns are ignored.
        noise: the noise after its scoring step.
        promise: the gain expected of the step in the noise [nats].
    """
    h = fit.hypothesis
    G = fit.gram.sum(axis=0) + np.diag(fit.prior)
    slope = fit.score.sum(axis=0) + fit.prior_pull(data)
    delta = np.zeros(len(slope))
    if len(slope):
        low, high = room(data, h, len(slope))
        far = _far(h, len(slope))
        delta = bounded(G, slope, np.maximum(low, -far), np.minimum(high, far))
    promise -= float(slope @ delta + 0.5 * delta @ G @ delta)
    return ProposedStep(delta, _moved(filtered, delta), noise, promise)


def _moved(filtered: Array, delta: Array) -> Array:
    """Return the track's correction by a step; columns of what does not move may overflow."""
    parts = np.zeros(filtered.shape[-1])
    parts[0], parts[1 : 1 + len(delta)] = 1.0, delta
    flat = filtered.reshape(-1, len(parts))
    found = flat @ parts
    if not np.isfinite(found).all():
        found = flat[:, parts != 0] @ parts[parts != 0]
    return np.asarray(found.reshape(filtered.shape[:-1]))


def bounded(G: Array, slope: Array, low: Array, high: Array) -> Array:
    """Return the Gauss-Newton step within bounds: the minimum of slope' x + x' G x / 2.

    An active-set method (Nocedal & Wright, Numerical Optimization, 2006, 16.5): an unknown that
    comes to its bound on the way is held there, and released if the others then pull it back. All
    that the unbounded step takes beyond a bound must not be held at once: of correlated unknowns
    it leads far out, and what is left at the bounds lowers the likelihood. One whose slope is not
    finite (a value at which the effect overflows) does not move.

    Args:
        G: (K, K), positive semidefinite.
        slope: (K,).
        low: (K,), at most 0.
        high: (K,), at least 0.
    """
    known = np.isfinite(np.diag(G)) & np.isfinite(slope)
    G, slope = np.where(np.outer(known, known), G, 0.0), np.where(known, slope, 0.0)
    scale = 1 / np.sqrt(np.maximum(np.diag(G), 1e-300))
    delta, free = np.zeros(len(slope)), known & (low < high)
    for _ in range(ROUNDS * len(slope)):
        step = np.zeros(len(slope))
        if free.any():
            scaled = G[np.ix_(free, free)] * np.outer(scale[free], scale[free])
            down = scale[free] * (slope + G @ delta)[free]
            step[free] = -scale[free] * np.linalg.lstsq(scaled, down, rcond=1e-10)[0]
        end = np.where(step > 0, high, low) - delta
        with np.errstate(all="ignore"):
            parts = np.where(step == 0, np.inf, end / step)
        stop = int(np.argmin(parts)) if len(parts) else 0
        if len(parts) and parts[stop] < 1:
            delta = np.clip(delta + parts[stop] * step, low, high)
            delta[stop], free[stop] = high[stop] if step[stop] > 0 else low[stop], False
            continue
        delta = delta + step
        pull = scale * (slope + G @ delta)  # > 0: down
        held = known & ~free & np.where(delta <= low, pull < 0, pull > 0) & (low < high)
        if not held.any():
            break
        free[int(np.argmax(np.where(held, np.abs(pull), 0.0)))] = True
    return delta


def room(data: Data, h: Hypothesis, size: int) -> tuple[Array, Array]:
    """Return how far each unknown may step down and up within its bounds: values, then shifts."""
    low, high, k = np.full(size, -np.inf), np.full(size, np.inf), len(h.theta)
    free = [q for e in h.effects for q in e.free]
    low[:k] = np.minimum([q.low for q in free] - h.theta, 0.0)
    high[:k] = np.maximum([q.high for q in free] - h.theta, 0.0)
    if size > k:
        which = calibrated(data)
        shift = np.zeros(data.model.system.k) if h.shift is None else h.shift
        lowest, highest = _bounds(data)
        at, unit = data.model.values + shift, np.maximum(data.model.spreads, 1e-300)
        low[k:] = np.minimum((lowest - at) / unit, 0.0)[which]
        high[k:] = np.maximum((highest - at) / unit, 0.0)[which]
    return low, high


def _far(h: Hypothesis, size: int) -> Array:
    """Return the largest step of each unknown, (size,): for scanned values a few grid gaps."""
    far, free = np.full(size, LEAP), [q for e in h.effects for q in e.free]
    gaps = [GAPS * s if q.grid else np.inf for s, q in zip(step_sizes(h), free, strict=True)]
    far[: len(gaps)] = gaps
    return far


def inside(data: Data, shift: Array) -> Array:
    """Return the shift (k,) clipped so that the parameters stay inside their bounds."""
    values = data.model.values
    return np.asarray(np.clip(values + shift, *_bounds(data)) - values)


def _bounds(data: Data) -> tuple[Array, Array]:
    """Return the lower and upper `reach` of the model's parameters, (k,) each."""
    ends = np.array([p.reach for p in data.model.params.values()], float).reshape(-1, 2)
    return ends[:, 0], ends[:, 1]
