"""Estimate the delay d and scale s between two noisy signals of one quantity, b(t) = s a(t - d).

Both are smoothed with the same window, b is shifted, and d is the shift with the smallest
difference: the noise adds the same to the difference at every shift. The window with the smallest
standard deviation of d is used; the spread over the other windows is added to it. The scale is only
bounded from both sides (Frisch): noise in a makes <a b> / <a a> too small, noise in b makes
<b b> / <a b> too large. A first-order filter is distinguished from a delay by a = b + tau b'. It is
chosen if it fits better than any delay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from grounded.accounts.levels import FEWEST_SAMPLES, NEARLY_ALL, SLIGHT, SURELY
from grounded.frozen import Array

Pairs = Sequence[tuple[Array, Array]]

LARGEST_DELAY_S, LARGEST_DELAY_STEPS = 0.3, 6  # the larger of both is tried
WINDOWS = (1, 2, 4, 8, 16, 32, 64)  # half lengths of the smoothing window, samples


@dataclass(frozen=True)
class Lag:
    """b lags a by `delay` seconds and is `sign * scale` times as large."""

    delay: float  # [s], negative if b is early
    std: float  # its standard deviation [s]
    filtered: bool  # b follows a through a first-order filter with time constant `delay`
    sign: int  # 1 or -1
    low: float  # lower bound of the scale
    high: float  # upper bound of the scale
    coherence: float  # share of both signals that agrees, 0 to 1
    scale_std: float = np.inf
    slow: float = np.nan  # the scale of slow motion, from the widest window with enough samples

    @property
    def scale(self) -> float:
        """Size of b over that of a, without the sign."""
        return float(np.sqrt(self.low * self.high))

    def off(self, by: float) -> bool:
        """Check whether the scale is off by more than `by`, for slow motion as well.

        With only a few samples per period, averaging over a step reduces a signal: that is not a
        scale error.
        """
        slow = self.slow if np.isfinite(self.slow) else self.scale
        return min(self.low, slow) > 1 + by or max(self.high, slow) < 1 - by

    @property
    def one_size(self) -> bool:
        """Whether both have one sign and one size: within SLIGHT for certain, and perhaps equal."""
        off, sure = max(1 - self.low, self.high - 1), SURELY * self.scale_std
        return self.sign > 0 and off < max(SLIGHT / 3, sure) and off + sure < SLIGHT


def lag_between(pairs: Pairs, dt: float) -> Lag | None:
    """Estimate the delay of b behind a, and its scale; None if there is too little data.

    Pairs are pieces (a, b) without gaps, (T,) each.
    """
    longest = max((len(a) for a, _ in pairs), default=0)
    most = int(np.ceil(max(LARGEST_DELAY_S / dt, LARGEST_DELAY_STEPS)))
    reach = max(3, min(most, longest // 8))
    found = [_smoothed(pairs, h, reach) for h in WINDOWS if 2 * h + 2 * reach < longest / 2]
    every = [(p, one) for p in found if (one := _measured(p, dt)) is not None]
    clear = [(p, one) for p, one in every if one.coherence > NEARLY_ALL]
    if not clear:
        return max((one for _, one in every), key=lambda lag: lag.coherence, default=None)
    best = min((one for _, one in clear), key=lambda lag: lag.std)
    apart = float(np.median([abs(one.delay - best.delay) for _, one in clear]))
    told = [
        one.scale for p, one in clear if p.windows >= FEWEST_SAMPLES // 2
    ]  # few windows scatter a lot
    return replace(best, std=float(np.hypot(best.std, apart)), slow=told[-1] if told else np.nan)


@dataclass(frozen=True)
class _Pieces:
    """Pieces smoothed over `half`: all of b, and a where b can be shifted by `reach` either way."""

    a: list[Array]
    b: list[Array]
    reach: int
    half: int

    def moved(self, by: float) -> Array:
        """Return b from `by` samples later, at the samples of a (N,), each piece minus its mean."""
        pairs = zip(self.a, self.b, strict=True)
        return _centred([at_samples(b, np.arange(len(a)) + self.reach + by) for a, b in pairs])

    def scatter(self, force: Array) -> float:
        """Return the standard deviation of the sum of `force` (N,) by the scatter of its parts."""
        parts = max(FEWEST_SAMPLES, 2 * len(self.a))
        part = np.arange(len(force)) * parts // len(force)
        return float(np.linalg.norm(np.bincount(part, force)))

    @property
    def windows(self) -> int:
        """Number of windows that do not overlap."""
        return sum(len(a) for a in self.a) // (2 * self.half + 3)


def _smoothed(pairs: Pairs, h: int, reach: int) -> _Pieces:
    window = np.hanning(2 * h + 3)[1:-1]
    window /= window.sum()
    long = [(a, b) for a, b in pairs if len(a) >= max(FEWEST_SAMPLES, 2 * (h + reach) + 4)]
    a, b = ([np.convolve(pair[k], window, "valid") for pair in long] for k in (0, 1))
    return _Pieces([one[reach:-reach] for one in a], b, reach, h)


def _centred(columns: Sequence[Array]) -> Array:
    return np.concatenate([x - x.mean() for x in columns])


def _measured(pieces: _Pieces, dt: float) -> Lag | None:
    """Return the lag of pieces that are smoothed over one window."""
    if not pieces.a:
        return None
    a, h, reach = _centred(pieces.a), pieces.half, pieces.reach
    grid = np.arange(0.0, reach, h)
    grid = np.concatenate([-grid[:0:-1], grid])
    shifted = [pieces.moved(by) for by in grid]
    shared = np.array([_dot(a, b) ** 2 / max(_dot(b, b), 1e-300) for b in shifted])
    if not shared.max() > 0:
        return None
    # the best of the grid, the nearest of equal ones, refined by Gauss-Newton
    d = float(grid[int(np.argmax(shared - 1e-6 * shared.max() * np.abs(grid) / reach))])
    for _ in range(8):
        b, slope = pieces.moved(d), 0.5 * (pieces.moved(d + 1) - pieces.moved(d - 1))
        s = _dot(a, b) / max(_dot(b, b), 1e-300)
        curve = s * _dot(slope, slope)
        step = float(np.clip(_dot(a - s * b, slope) / curve if curve else 0.0, -h, h))
        d = float(np.clip(d + step, -reach + 1, reach - 1))
        if abs(step) < 1e-4:
            break
    rest, pull = a - s * b, s * slope
    std = pieces.scatter(rest * pull) / max(_dot(pull, pull), 1e-300)
    behind = _filter(pieces, a, _dot(rest, rest)) if d > 0 else None
    if behind is not None:
        d, b = behind  # the scale is that of the filter's input
        s = _dot(a, b) / max(_dot(b, b), 1e-300)
        rest = a - s * b
    both = abs(_dot(a, b))
    low, high = both / _dot(a, a), _dot(b, b) / max(both, 1e-300)
    scale_std = pieces.scatter(rest * b) / max(_dot(b, b), 1e-300) / max(s * s, 1e-300)
    sign, coherence = 1 if s > 0 else -1, min(low / high, 1.0)
    return Lag(d * dt, std * dt, behind is not None, sign, low, high, coherence, scale_std)


def _dot(a: Array, b: Array) -> float:
    return float((a * b).sum())  # on one thread


def _filter(pieces: _Pieces, a: Array, misfit: float) -> tuple[float, Array] | None:
    """Return tau [samples] and b + tau b' if a = s (b + tau b') fits better than a scaled delay."""
    b, slope = pieces.moved(0.0), 0.5 * (pieces.moved(1.0) - pieces.moved(-1.0))
    columns = np.stack([b, slope], axis=1)
    s, both = np.linalg.lstsq(columns, a, rcond=None)[0]
    rest = float(((a - columns @ [s, both]) ** 2).sum())
    better = rest < NEARLY_ALL * misfit and both / s > 0
    return (float(both / s), b + both / s * slope) if better else None


def at_samples(x: Array, at: Any) -> Array:
    """Interpolate x (T,) at fractional indices `at` (N,) by cubics; NaN outside."""
    whole = np.floor(at + 1e-9).astype(int)
    T, line = len(x), np.concatenate([[2 * x[0] - x[1]], x, [2 * x[-1] - x[-2]]])
    k = np.clip(whole, 0, T - 2)
    p = at - k
    a, b, c, d = (line[k + i] for i in range(4))
    value = b + 0.5 * p * (c - a + p * (2 * a - 5 * b + 4 * c - d + p * (3 * (b - c) + d - a)))
    return np.where((at < -1e-9) | (at > T - 1 + 1e-9), np.nan, value)


def whole_steps(steps: float) -> bool:
    """Check whether a shift is a whole number of samples, so that it needs no interpolation."""
    return abs(steps - round(steps)) < 0.05


def earlier(x: Array, steps: float) -> Array:
    """Return x shifted earlier by `steps` samples, NaN at the end."""
    at = np.arange(len(x)) + steps
    whole = round(steps)
    if whole_steps(steps):
        return np.concatenate([x[whole:], np.full(min(whole, len(x)), np.nan)])
    return at_samples(x, at)
