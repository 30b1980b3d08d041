"""Find that a program smoothed the states it passed to its candidate, but logged them as measured.

A first-order filter, x_f = a x_f + (1 - a) x in each step, delays the feedback by a / (1 - a)
steps, which no plan allows for. The commands show it: with the right `a` the policy gives them
nearly to the last digits, on states of some age it doesn't.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from grounded.findings import Finding, Quantity, found
from grounded.frozen import Array
from grounded.model import Model
from grounded.places import velocities
from grounded.policy import Policy
from grounded.search.candidate import Candidate
from grounded.search.returned.who_drove import LATEST, LEAST, SAME, SLIGHT, UNLIKE, states_ago
from grounded.trial import Trial

SHARES = np.arange(1, 49) / 50  # tried for `a`
AGES = np.arange(13) / 4  # tried, in steps


@dataclass(frozen=True)
class Smoothed:
    """States that a program smoothed before it passed them on."""

    names: tuple[str, ...]
    share: float  # of the last value, a
    lag_s: float  # by which a steady motion is seen late [s]
    left: float  # rms difference of the commands on these, relative to their size

    def finding(self, own: Candidate) -> Finding:
        """Return that its commands are those of a candidate on smoothed states."""
        lag = Quantity(self.lag_s, "s")
        return found("run.smoothed", ran=own.id, states=self.names, share=self.share, lag=lag)


def smoothed(model: Model, own: Candidate, trial: Trial) -> Smoothed | None:
    """Return which states a program smoothed before its candidate acted on them, or None.

    Args:
        model: has the units of the states, which tell velocities from positions.
        own: the candidate.
        trial: its run, without gaps; the run may begin up to `LATEST` steps after it.
    """
    policy, T = own.policy, min(trial.finite_steps, own.policy.horizon)
    names = (policy.state_names, policy.input_names)
    if policy.gain is None or T < LEAST + LATEST or names != (trial.state_names, trial.input_names):
        return None
    off = float(_off(policy, trial, 0, trial.states[None, :T])[0])
    if off < SLIGHT:
        return None
    x = trial.states[:T]
    aged = np.stack([states_ago(x, age, policy.angles) for age in AGES])
    least = min(float(_off(policy, trial, late, aged).min()) for late in range(LATEST + 1))
    best, found = min(UNLIKE * off, SAME * least), None
    for late in range(LATEST + 1):
        filtered = _filtered(x[late:])
        for group in _groups(model, policy):
            which = np.isin(np.arange(x.shape[1]), group)
            passed = np.where(which, filtered, x[late:])
            left = _off(policy, trial, late, np.pad(passed, ((0, 0), (late, 0), (0, 0))))
            k = int(np.argmin(left))
            if left[k] < best:
                best, share = float(left[k]), float(SHARES[k])
                lag = share / (1 - share) * trial.dt
                found = Smoothed(tuple(policy.state_names[i] for i in group), share, lag, best)
    return found


def _off(policy: Policy, trial: Trial, late: int, states: Array) -> Array:
    """Return the rms difference of a run's commands from those on other states, (B,), relative.

    Args:
        policy: of the candidate.
        trial: the run.
        late: steps after which it begins.
        states: (B, T, n) as they were passed in each step of the trial; those before are not used.
    """
    T = states.shape[1]
    sent = np.clip(trial.inputs[:T], policy.low, policy.high)
    held = policy.past if trial.start_inputs is None else trial.start_inputs
    past = trial.inputs[late - 1] if late else held
    asked = policy.commands(states[:, late:], past, sent[None, late:])
    size = np.maximum(np.abs(policy.feedforward).max(axis=0), np.abs(sent).max(axis=0)) + 1e-12
    return np.asarray(np.sqrt((((asked - sent[late:]) / size) ** 2).mean(axis=(1, 2))))


def _filtered(x: Array) -> Array:
    """Return states (T, n) smoothed with each of `SHARES`, (K, T, n)."""
    a = SHARES[:, None]
    found = np.repeat(x[None], len(SHARES), axis=0)
    for t in range(1, len(x)):
        found[:, t] = a * found[:, t - 1] + (1 - a) * x[t]
    return found


def _groups(model: Model, policy: Policy) -> Iterator[list[int]]:
    """Yield the states that a program may smooth, the most first: one filter serves them all."""
    assert policy.gain is not None
    names, rates = policy.state_names, velocities(model)
    fed = np.abs(policy.gain[..., : len(names)]).max(axis=(0, 1)) > 0
    some = [i for i in range(len(names)) if fed[i]]
    moving = [i for i in some if names[i] in rates]
    groups = [some, moving, [i for i in some if i not in moving], *([i] for i in some)]
    yield from (list(one) for one in dict.fromkeys(map(tuple, groups)) if one)
