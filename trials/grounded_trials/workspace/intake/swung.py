"""Say after a run that the feedback of its candidate made inputs oscillate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from grounded.result import figure, listed
from grounded.search.candidate import Tried
from grounded.search.feedback.oscillation import SWINGS, calm_ranges, swings
from grounded.task import Task
from grounded.trial import Trial
from grounded_trials.wording import with_unit


def swung(task: Task, tried: Tried | None, trial: Trial, history: Sequence[Tried]) -> list[str]:
    """Return a warning that names the inputs that oscillated in a run; [] if none did.

    Args:
        task: the manoeuvre.
        tried: the candidate that was run; None if it is none of the search.
        trial: its run.
        history: all candidates with their trials.
    """
    if tried is None or tried.candidate.policy.gain is None:
        return []
    made, model = tried.candidate, task.model
    ids = [one.candidate.id for one in history]
    sizes = calm_ranges(task, history)[ids.index(made.id)]
    counts = swings(made, trial, sizes)
    told = [
        f"{model.input_names[i]} ({counts[i]} swings of more than "
        f"{with_unit(figure(sizes[i], 2), model.inputs[model.input_names[i]])})"
        for i in np.flatnonzero(counts >= SWINGS)
    ]
    if not told:
        return []
    return [
        f"its feedback made {listed(told)} oscillate about the plan: the next candidates get "
        "weaker feedback, or say if they can't"
    ]
