"""One hypothesis on its way up: the step that is proposed, the part of it that is taken.

Gauss-Newton in the effects' values and the parameters' shifts, scoring in the noise, the filtered
track as the new track: together, from the best point so far. A step that does not rise is taken in
part, so that nothing is lost by boldness.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from grounded.diagnosis.data import Data
from grounded.diagnosis.fitted import Fit, calibrated
from grounded.diagnosis.hypothesis import Hypothesis, param_scale
from grounded.diagnosis.linearise import step_sizes
from grounded.diagnosis.noise import Noise
from grounded.frozen import Array

MOST_NUMBERS = 2e6  # of one (L, B, N, N) array: what fits in the cache goes fastest
SHORTEST = 0.05  # part of a step that is still tried


@dataclass(eq=False)
class Step:
    """A step proposed at the best point: of values, shifts, track; the noise it leads to."""

    theta: Array
    shift: Array  # in units of param_scale
    track: Array
    noise: Noise


@dataclass(eq=False)
class Work:
    """One hypothesis on its way: mutable, private to this module."""

    h: Hypothesis
    noise: Noise
    track: Array
    best: Fit | None = None
    step: Step | None = None
    part: float = 1.0  # of the step that is taken
    still: int = 0
    age: int = 0  # points that were better than all before
    moving: bool = (
        True  # whether the track is updated too: where the model has kinks it may not help
    )

    def done(self) -> bool:
        """Whether it no longer rises."""
        return self.still >= 1

    def shorten(self, data: Data) -> None:
        """The same step about the track as it was; then parts of it; then the end."""
        if self.moving:
            self.moving = False
        else:
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
        self.track = best.track + step.track if self.moving else best.track


def proposed(data: Data, fit: Fit, filtered: Array, noise: Noise) -> Step:
    """Gauss-Newton in values and shifts, scoring in the noise, the filtered track as the track."""
    h = fit.hypothesis
    G = fit.gram.sum(axis=0) + np.diag(fit.prior)
    slope = fit.score.sum(axis=0) + fit.prior_pull(data)
    k, track = len(h.theta), filtered[..., 0]
    theta, shift = np.zeros(k), np.zeros(len(slope) - k)
    if len(slope):
        delta = _bounded(G, slope, *_room(data, h, k, len(slope)))
        delta[:k] = _limited(h, delta[:k])
        delta[k:] = np.clip(delta[k:], -0.3, 0.3)
        theta, shift = delta[:k], delta[k:]
        moved = delta != 0
        track = track + filtered[..., 1:][..., moved] @ delta[moved]
    return Step(theta, shift, track, noise)


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
        at, unit = data.model.values + shift, param_scale(data.model)
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
    """Bounds of the model's parameters, (k,) each; positive ones stay positive."""
    values = data.model.values
    low = [-np.inf if p.low is None else p.low for p in data.model.params.values()]
    high = [np.inf if p.high is None else p.high for p in data.model.params.values()]
    low = [max(b, 0.2 * v) if v > 0 else b for b, v in zip(low, values, strict=True)]
    high = [min(b, 0.2 * v) if v < 0 else b for b, v in zip(high, values, strict=True)]
    return np.array(low), np.array(high)
