"""What must hold before a candidate is handed to a robot.

Finite numbers, inputs inside the hard limits, gains within reason, and a PREDICTED run that stays
inside [safety]. Each objection is a sentence that says which limit, where and when.
"""

from __future__ import annotations

import numpy as np

from grounded.search import Candidate
from grounded.task import Task

MAX_GAIN = 1e6  # input units per state unit: beyond it a gain is a numerical accident


def objections(task: Task, candidate: Candidate) -> list[str]:
    """Why a candidate must not be run; empty when nothing speaks against it."""
    policy = candidate.policy
    parts = {"feed-forward": policy.feedforward, "predicted state": candidate.predicted_states}
    if policy.gain is not None and policy.reference is not None:
        parts |= {"gain": policy.gain, "reference": policy.reference}
    for name, values in parts.items():
        bad = ~np.isfinite(values.reshape(len(values), -1)).all(axis=1)
        if bad.any():
            t = int(np.argmax(bad))
            return [
                f"the {name} of {candidate.id} is not a finite number at t = {t * task.dt:g} s "
                f"(step {t}): the model diverges there; check it with a shorter horizon"
            ]
    found = [_outside(task, candidate, i) for i in range(task.model.n)]
    if policy.gain is not None and np.abs(policy.gain).max() > MAX_GAIN:
        t = int(np.argmax(np.abs(policy.gain).max(axis=(1, 2))))
        found.append(
            f"a gain of {candidate.id} reaches {np.abs(policy.gain).max():.3g} at t = "
            f"{t * task.dt:g} s, more than {MAX_GAIN:g}: raise the input weights"
        )
    return [sentence for sentence in found if sentence]


def _outside(task: Task, candidate: Candidate, i: int) -> str:
    """The sentence for state i leaving [safety] in the predicted run, or ""."""
    assert task.safety_low is not None and task.safety_high is not None
    value = candidate.predicted_states[:, i]
    excess = np.maximum(task.safety_low[i] - value, value - task.safety_high[i])
    t = int(np.argmax(excess))
    if excess[t] <= 0:
        return ""
    name = task.model.state_names[i]
    return (
        f"{candidate.id} (alpha = {candidate.alpha:g}) is predicted to take {name} to "
        f"{value[t]:.3f} {task.model.states[name]} at t = {t * task.dt:.2f} s, outside [safety] "
        f"{name} = [{task.safety_low[i]:g}, {task.safety_high[i]:g}]"
    )
