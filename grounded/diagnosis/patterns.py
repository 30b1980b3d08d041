"""The probes that are tried: a policy with ramps, steps, doublets or a sweep added to an input."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from grounded.frozen import Array
from grounded.model import Model
from grounded.policy import Policy

OWN = "the best candidate's policy"
BASE = f"{OWN} again"
SIZES = (0.15, 0.35)  # of the input's range


def probes(policy: Policy, model: Model, inputs: Sequence[int]) -> Iterator[tuple[str, Policy]]:
    """Yield the base policy, then the policy with each pattern added to each input, described."""
    yield BASE, policy
    t = np.arange(policy.horizon, dtype=float) * policy.dt
    for j in inputs:
        low, high = policy.low[j], policy.high[j]
        room = float(high - low) if np.isfinite(high - low) else 2.0
        limits = f" (limits {low:g} to {high:g})" * bool(np.isfinite(high - low))
        for size in SIZES:
            for words, shape in patterns(t):
                feedforward = policy.feedforward.copy()
                feedforward[:, j] = np.clip(feedforward[:, j] + size * room * shape, low, high)
                name = policy.input_names[j]
                unit = model.inputs[name]
                of = f"{size * room:.2g} {unit}" if unit != "1" else f"{size * room:.2g}{limits}"
                made = replace(policy, feedforward=feedforward)
                yield f"{OWN} with {words} of {of} added to {name}", made


def patterns(t: Any) -> list[tuple[str, Array]]:
    """Return the shapes, of unit size, over the times t (H,), with their names."""
    T = float(t[-1]) + 1e-9
    phase = t / T
    stairs = np.round(4 * np.sin(2 * np.pi * phase)) / 4
    doublets = np.sign(np.sin(2 * np.pi * t / max(T / 5, 0.4)))
    sweep = np.sin(2 * np.pi * (0.2 * t + 0.5 * (2.0 - 0.2) / T * t**2))
    return [
        ("a slow ramp down", -phase),
        ("a slow ramp up", phase),
        ("a staircase", stairs),
        ("doublets", doublets),
        ("a frequency sweep", sweep),
        ("a negative pulse", -((phase > 0.4) & (phase < 0.7)).astype(float)),
    ]
