"""Ask whether a run that missed its prediction by far more than other runs ran as it should.

A motor wired the wrong way round, an encoder that slipped or a hand on the robot give a faultless
log of a run that says nothing about its candidate. The next plan would be based on it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from grounded.search.mispredictions import STRAYED
from grounded_trials.workspace.folder import Folder

if TYPE_CHECKING:
    from grounded.search.candidate import Tried
    from grounded.trial import Trial

FAR = 10.0  # times what runs miss otherwise: from here on an input's sign is asked


def gone_wrong(
    workspace: Folder, trial: Trial, tried: Tried | None, history: Sequence[Tried]
) -> str:
    """Return a question about a run that went far astray, and what to do about it; or "".

    Args:
        workspace: the workspace with the model.
        trial: the run as stored, with short gaps bridged.
        tried: its candidate with all of its runs.
        history: all candidates with their runs.
    """
    if tried is None:
        return ""
    utility = workspace.task.utility(trial)
    others = [t for t in history if t.utilities and t is not tried and math.isfinite(t.utility)]
    missed = tried.promised - utility
    usual = max(
        abs(tried.promised),
        min((abs(t.utility) for t in others), default=0.0),
        float(np.median([abs(t.promised - t.utility) for t in others])) if others else 0.0,
        1e-9,
    )
    if not missed > FAR * usual:
        return ""
    from grounded.search.returned.reversed_input import reversed_input

    name, run = tried.candidate.id, trial.until(workspace.task.horizon)
    if found := reversed_input(workspace.planner, run):
        ran = [one for t in history for one in t.trials if one.id != trial.id]
        wired = "wired, or its sign switched, otherwise than in the runs before"
        if not ran:
            wired = "wired the wrong way round, or is its sign in the model wrong"
        return (
            f"{found.input} acted the other way round: with its sign flipped, the model predicts "
            f"{found.state} {1 / found.share:.2g} times as well. Is it {wired}? Then "
            f"`discard {trial.id}`, mend it and run {name} again; if not, `propose` goes on"
        )
    if not (others and STRAYED * usual < missed < math.inf):
        return ""
    return (
        f"it missed its prediction by {missed:,.3g}, {missed / usual:,.3g} times what runs miss or "
        "cost otherwise: did it run as it should? If not (a motor, a sensor, somebody in the way), "
        f"`discard {trial.id}` and run {name} again; if it did, `propose` goes on"
    )
