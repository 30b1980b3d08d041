"""The stored trials that a diagnosis can use: gaps in single states stay, what diverged goes."""

from __future__ import annotations

import numpy as np

from grounded.trial import HUGE, Trial
from grounded_trials.workspace import Workspace

LEAST_STEPS = 2


def diagnosable(workspace: Workspace) -> list[Trial]:
    """In order of arrival, up to the first missing input or number beyond all bounds.

    A fit needs whole states; a diagnosis only needs some, so a sensor that dropped out for a while
    costs its samples, not the rest of the trial.

    Raises:
        GroundedError: if a stored file is damaged.
    """
    cut = [trial.until(known_steps(trial)) for trial in workspace.task_trials(measured=True)]
    return [trial for trial in cut if trial.steps >= LEAST_STEPS]


def known_steps(trial: Trial) -> int:
    """Steps that a diagnosis can use."""
    known = np.isfinite(trial.states).any(axis=1)
    last = int(np.flatnonzero(known)[-1]) if known.any() else 0
    wild = (np.abs(trial.states) >= HUGE).any(axis=1)
    last = min(last, int(np.argmax(wild)) - 1) if wild.any() else last
    bad = ~(np.abs(trial.inputs) < HUGE).all(axis=1)
    return max(0, min(last, int(np.argmax(bad))) if bad.any() else last)
