"""Policies: what a robot runs. A sequence of inputs, or linear feedback around one.

    u_t = clip( ubar_t + K_t (z_t - zbar_t) ),     z_t = [x_t, inputs already sent]

The past inputs in z (newest first, input by input, see `grounded.compile.problem`) are known to
whoever runs the policy: `Runner` keeps them. theta, the paper's policy parameters, are all
feed-forwards and gains; `theta + alpha d` is `toward(other, alpha)`.

This file needs numpy alone, so that a robot needs nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from grounded.errors import GroundedError
from grounded.frozen import Array, readonly


@dataclass(frozen=True, eq=False)
class Policy:
    """Feed-forward, gain and reference for each control step.

    An open-loop policy (the paper's turn) has no gain and no reference. Sizes: H steps, m inputs,
    n states, nz = n + sum(depths).
    """

    feedforward: Array  # (H, m) ubar
    low: Array  # (m,) hard limits of the inputs
    high: Array  # (m,)
    dt: float  # [s]
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    depths: tuple[int, ...]  # past inputs in z, for each input
    angles: tuple[bool, ...]  # (n,) differences that wrap
    past: Array  # (m,) the input held before t = 0
    gain: Array | None = None  # (H, m, nz)
    reference: Array | None = None  # (H, nz) zbar

    def __post_init__(self) -> None:
        for name in ("feedforward", "low", "high", "past", "gain", "reference"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, readonly(getattr(self, name)))
        H, m = self.feedforward.shape
        nz = len(self.state_names) + sum(self.depths)
        if (self.gain is None) != (self.reference is None):
            raise GroundedError("a feedback policy needs both a gain and a reference")
        if self.gain is not None and self.reference is not None:
            found = (self.gain.shape, self.reference.shape)
            if found != ((H, m, nz), (H, nz)):
                raise GroundedError(
                    f"gain and reference must have shapes {((H, m, nz), (H, nz))}, got {found}"
                )

    @property
    def horizon(self) -> int:
        """H, the number of control steps."""
        return len(self.feedforward)

    @property
    def z_names(self) -> tuple[str, ...]:
        """Names of z: the states, then the past inputs as `steering[t-1]`."""
        past = [
            f"{name}[t-{i + 1}]"
            for name, depth in zip(self.input_names, self.depths, strict=True)
            for i in range(depth)
        ]
        return (*self.state_names, *past)

    def about(self, reference: Array) -> Policy:
        """The same policy, written about another reference (H, nz)."""
        if self.gain is None or self.reference is None:
            return self
        shift = z_difference(reference, self.reference, self.angles)
        moved = self.feedforward + np.einsum("tij,tj->ti", self.gain, shift)
        return replace(self, feedforward=moved, reference=reference)

    def toward(self, other: Policy, alpha: float) -> Policy:
        """theta + alpha d with d = theta' - theta (footnote 11): alpha = 1 is `other` itself."""
        if alpha == 1.0:
            return other
        if other.reference is None or other.gain is None:
            mixed = (1 - alpha) * self.feedforward + alpha * other.feedforward
            return replace(other, feedforward=mixed)
        mine = self.about(other.reference)
        mixed = (1 - alpha) * mine.feedforward + alpha * other.feedforward
        own_gain = np.zeros_like(other.gain) if mine.gain is None else mine.gain
        gain = (1 - alpha) * own_gain + alpha * other.gain
        return replace(other, feedforward=mixed, gain=gain)


def z_difference(a: Array, b: Array, angles: tuple[bool, ...]) -> Array:
    """a - b for augmented states (..., nz), angles wrapped."""
    d = np.asarray(a, float) - np.asarray(b, float)
    for i, angle in enumerate(angles):
        if angle:
            d[..., i] -= 2 * np.pi * np.rint(d[..., i] / (2 * np.pi))
    return d
