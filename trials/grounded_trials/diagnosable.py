"""The stored trials that a diagnosis can use: gaps in single states stay, what diverged goes."""

from __future__ import annotations

from grounded.trial import Trial
from grounded_trials.workspace import Workspace

LEAST_STEPS = 2


def diagnosable(workspace: Workspace) -> list[Trial]:
    """In order of arrival, up to the first missing input or number beyond all bounds.

    A fit needs whole states; a diagnosis only needs some, so a sensor that dropped out for a while
    costs its samples, not the rest of the trial.

    Raises:
        GroundedError: if a stored file is damaged.
    """
    cut = [trial.until(trial.known_steps) for trial in workspace.task_trials(measured=True)]
    return [trial for trial in cut if trial.steps >= LEAST_STEPS]
