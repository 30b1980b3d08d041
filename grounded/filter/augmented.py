"""States that a filter carries beside the model's: its three passes stay as they are.

Coloured noise, c_{t+1} = phi c_t + eta, enters each step as white noise does, through G:

    A = [[F, G], [0, phi]]

A late measurement shows the state of earlier moments, and one more state remembers them:

    r_i(s) = z_i(s) + v(s),   z_i(s) = a e_i(s) + b e_i(s - 1) + c z_i(s - 1),   a + b + c = 1

of a channel i that is delayed by the part b of a step (c = 0), or filtered. Slot i of the widened
state is what is measured, z_i; slot n + j is e_i(s) itself, as a channel that is never measured. So
H stays the identity of what is seen, and

    e_i(s + 1) = (F e + d + G w)_i        into slot n + j
    z_i(s + 1) = a (F e + d + G w)_i + b e_i(s) + c z_i(s)        into slot i

where F takes e_i from slot n + j. Noise enters by G of n + D rows. Coloured noise follows, as ever.

Shapes: L steps, B runs, n channels, D late ones, n' = n + D, N' = n' or 2 n'.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from grounded.filter.kalman import LinearSystem
from grounded.frozen import Array


def coloured(F: Array, phi: float | None, G: Array | None = None) -> Array:
    """A of the filter: F alone (L, B, n, n), or with coloured noise beside it (L, B, 2 n, 2 n)."""
    if phi is None:
        return F
    L, B, n, _ = F.shape
    A, i = np.zeros((L, B, 2 * n, 2 * n)), np.arange(n)
    A[:, :, :n, :n] = F
    A[:, :, :n, n:] = np.eye(n) if G is None else G
    A[:, :, n + i, n + i] = phi
    return A


@dataclass(frozen=True, eq=False)
class Delayed:
    """Late channels of every run: which (B, D) of int; a, b and c (B, D, 3)."""

    channel: Any
    weights: Array

    @property
    def count(self) -> int:
        """D."""
        return int(self.channel.shape[1])

    def system(self, of: LinearSystem) -> LinearSystem:
        """The widened system."""
        n, D = of.seen.shape[-1], self.count
        G = self._entry(of)
        still = np.zeros((*of.seen.shape[:-1], D))
        seen, R = np.concatenate([of.seen, still], axis=-1), np.concatenate([of.R, still], axis=-1)
        seen[:1, :, n:] = np.take_along_axis(of.seen[:1], self.channel[None], axis=-1)
        # the first measurement shows what was before: noise has come since, most of it lately
        since_then = (1 - self.weights[..., 0]) ** 2 / (1 - self.weights[..., 2] ** 2)
        first, colour = of.start[:, :n], of.start[:, n:]
        power = of.Q[0, :, :n] + colour if colour.size else of.Q[0, :, :n]
        since = np.einsum("bdk,bk->bd", G[0, :, n:, :n] ** 2, power)
        parts = [first, np.take_along_axis(first, self.channel, axis=-1) + since_then * since]
        parts += [colour, np.zeros((len(colour), D))] if colour.size else []
        start = np.concatenate(parts, axis=-1)
        return LinearSystem(self._transition(of, G), self.noises(of.Q, n), R, seen, start, G)

    def _entry(self, of: LinearSystem) -> Array:
        """How noise enters, (L, B, n', n')."""
        L, B, n, D = *of.A.shape[:2], of.seen.shape[-1], self.count
        G = np.zeros((L, B, n + D, n + D))
        G[:, :, :n, :n] = np.eye(n) if of.G is None else of.G
        return self._led(G, n)

    def _transition(self, of: LinearSystem, G: Array) -> Array:
        """A of the widened state, (L, B, N', N')."""
        (L, B, N, _), n, D = of.A.shape, of.seen.shape[-1], self.count
        wide, run = n + D, np.arange(B)
        A = np.zeros((L, B, wide if n == N else 2 * wide, wide if n == N else 2 * wide))
        A[:, :, :n, :n] = of.A[:, :, :n, :n]
        A[:, :, :n, n:wide] = np.take_along_axis(A[:, :, :n, :n], self.channel[None, :, None], 3)
        for j in range(D):
            A[:, run, :, self.channel[:, j]] = 0.0
        A[:, :, :wide, :wide] = self._led(A[:, :, :wide, :wide], n)
        for j in range(D):
            i = self.channel[:, j]
            A[:, run, i, n + j] += self.weights[:, j, 1]
            A[:, run, i, i] += self.weights[:, j, 2]
        if n < N:
            A[:, :, :wide, wide:] = G
            A[:, :, wide : wide + n, wide : wide + n] = of.A[:, :, n:, n:]
        return A

    def _led(self, rows: Array, n: int) -> Array:
        """Rows of e (L, B, n', C), late channels led to slot n + j and, times a, to i."""
        found, run = rows.copy(), np.arange(rows.shape[1])
        found[:, :, n:] = np.take_along_axis(rows, self.channel[None, :, :, None], 2)
        for j in range(self.count):
            found[:, run, self.channel[:, j]] *= self.weights[:, j, :1]
        return found

    def columns(self, d: Array, r: Array) -> tuple[Array, Array]:
        """Columns of d (L, B, n, C) and r (L + 1, B, n, C) for the widened state."""
        L, B, n, C = d.shape
        r = np.broadcast_to(r, (L + 1, B, n, C))
        more = np.zeros((L + 1, B, self.count, C))
        more[0] = np.take_along_axis(r[0], self.channel[:, :, None], axis=1)
        wide = np.concatenate([d, np.zeros((L, B, self.count, C))], axis=2)
        return self._led(wide, n), np.concatenate([r, more], axis=2)

    def errors(self, wide: Array) -> Array:
        """The errors e themselves (L + 1, B, n, C) of the widened state's (L + 1, B, n', C)."""
        n, run = wide.shape[2] - self.count, np.arange(wide.shape[1])
        found = wide[:, :, :n].copy()
        for j in range(self.count):
            found[:, run, self.channel[:, j]] = wide[:, :, n + j]
        return found

    def noises(self, Q: Array, n: int) -> Array:
        """Variances of w and c (..., N) for the widened state (..., N')."""
        still = np.zeros((*Q.shape[:-1], self.count))
        parts = [Q[..., :n], still] + ([Q[..., n:], still] if Q.shape[-1] > n else [])
        return np.concatenate(parts, axis=-1)

    def disturbances(self, values: Array, n: int) -> Array:
        """Of values for each slot (L, B, N'), those of w and c, which have noise, (L, B, N)."""
        wide = n + self.count
        return np.concatenate([values[..., :n], values[..., wide : wide + n]], axis=-1)


def joined(
    parts: Sequence[tuple[LinearSystem, Delayed | None]],
) -> tuple[LinearSystem, Delayed | None]:
    """Systems with as many delayed channels each as one, their runs one after the other."""
    if len(parts) == 1:
        return parts[0]
    systems = [system for system, _ in parts]
    A, Q, R, seen = (np.concatenate([one[k] for one in systems], axis=1) for k in range(4))
    entries = [one.G for one in systems if one.G is not None]
    G = np.concatenate(entries, axis=1) if entries else None
    whole = LinearSystem(A, Q, R, seen, np.concatenate([one.start for one in systems]), G)
    each = [delayed for _, delayed in parts if delayed is not None]
    if not each:
        return whole, None
    channel, weights = ([getattr(one, k) for one in each] for k in ("channel", "weights"))
    return whole, Delayed(np.concatenate(channel), np.concatenate(weights))
