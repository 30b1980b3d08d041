"""How far a run is from what was predicted for its candidate.

A policy's commands alone don't tell which column is wrong: feedback on an angle of the other sign
sends nearly what it sends on a speed of the other sign. But a run resembles its prediction, even
by a crude model, since feedback keeps it there: a column in another unit, of the other sign or in
another's place is far from it.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from grounded.accounts.sent import as_sent
from grounded.frozen import Array
from grounded.policy import Policy
from grounded.trial import Trial

NEAR = 0.3  # of a state's usual size: smaller differences from the prediction are alike
CLOSE = 0.6  # the same in every state: a sign or a unit puts a column farther off
ALIKE = 1.0  # largest usual difference of a run that is like its prediction; unrelated: 1.4


class Ran(Protocol):
    """A candidate: its name, its policy, and the states (H + 1, n) predicted for it."""

    @property
    def id(self) -> str:
        """Its name."""

    @property
    def policy(self) -> Policy:
        """What it sends."""

    @property
    def predicted_states(self) -> Array:
        """The states (H + 1, n) of its run in the model."""


def far(own: Ran, trial: Trial, first: int = 0) -> Array:
    """Return each state's rms difference from its prediction, relative to its size, (n,).

    The size is the geometric mean of the standard deviations, so that a column that is too small is
    as far as one that is too large. NaN for a state that is predicted not to move, or of which
    nothing is finite.
    """
    predicted = own.predicted_states[first:]
    T = min(trial.finite_steps, len(predicted) - 1)
    if T < 0:
        return np.full(trial.states.shape[1], np.nan)
    seen, said = trial.states[: T + 1], predicted[: T + 1]
    off = np.sqrt(((seen - said) ** 2).mean(axis=0))
    moves, shown = said.std(axis=0), seen.std(axis=0)
    with np.errstate(all="ignore"):
        found: Array = off / np.sqrt(np.where(moves > 0, moves, np.nan) * (shown + 1e-6 * moves))
    return found


def apart(own: Ran, trial: Trial, first: int = 0) -> float:
    """Return how far a trial, from step `first` on, is from its prediction [nats] in all states."""
    return float(np.nansum(np.log(np.fmax(far(own, trial, first), NEAR))))


def like_predicted(own: Ran, trial: Trial) -> bool:
    """Return whether most states of a trial are near their prediction, as far as one is known."""
    known = far(own, trial)
    known = known[np.isfinite(known)]
    return not len(known) or bool(np.median(known) < ALIKE)


def as_planned(own: Ran, trial: Trial) -> bool:
    """Return whether a run's commands are its candidate's to the last digits, and its motion near.

    Then it came about as it is logged, and no other account is asked for: a column in another unit,
    of the other sign, dead or in another's place is far from its prediction.

    Args:
        own: the candidate.
        trial: its run, with gaps bridged.
    """
    known = far(own, trial)
    return as_sent(own.policy, trial) and bool((known[np.isfinite(known)] < CLOSE).all())
