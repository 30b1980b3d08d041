"""Lost samples: short gaps in a trial are bridged, long ones end it.

A camera that misses the car for half a second loses states, not the trial: the bias over the gap is
interpolated by interpolating the states (FACTS.md 2: 2 % lost samples are harmless). Inputs are
never invented: a trial ends before its first unknown input.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from grounded.trial import Trial

MAX_GAP_S = 1.0


@dataclass(frozen=True, eq=False)
class Bridged:
    """A trial without gaps: samples that were interpolated, and the state of the longest gap."""

    trial: Trial
    samples: int
    longest_s: float
    state: str  # where the longest gap was, "" if there was none
    at_s: float


def bridge(trial: Trial) -> Bridged:
    """Interpolates gaps of at most MAX_GAP_S between known samples; the first state must be known.

    A longer gap, or one that reaches the end, stays: the trial then counts as ended there.
    """
    bad = ~np.isfinite(trial.states)
    if not bad.any() or bad[0].any():
        return Bridged(trial, 0, 0.0, "", 0.0)
    states = np.array(trial.states)
    filled, longest, where, at = 0, 0, "", 0.0
    for i, name in enumerate(trial.state_names):
        for first, last in _gaps(bad[:, i]):
            if last == len(states) or (last - first) * trial.dt > MAX_GAP_S:
                continue
            known = [first - 1, last]
            states[first:last, i] = np.interp(range(first, last), known, states[known, i])
            filled += last - first
            if last - first > longest:
                longest, where, at = last - first, name, first * trial.dt
    return Bridged(replace(trial, states=states), filled, longest * trial.dt, where, at)


def _gaps(bad: np.ndarray) -> list[tuple[int, int]]:
    """[first, last) of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], bad.astype(int), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
