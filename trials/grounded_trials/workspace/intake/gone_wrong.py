"""Ask whether a run went as it should: an input acted the other way round, or it went far astray.

A motor wired the wrong way round, an encoder that slipped or a hand on the robot give a faultless
log of a run that says nothing about its candidate. The next plan would be based on it. A log of
other driving is asked about as well: with another that contradicts it, no diagnosis is possible.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from grounded.search.step.mispredictions import STRAYED
from grounded_trials.wording import ranges
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.last_diagnosis import diagnosable

if TYPE_CHECKING:
    from grounded.search.candidate import Tried
    from grounded.search.returned.reversed_input import Reversed
    from grounded.trial import Trial

FAR = 10.0  # times what runs miss otherwise: from here on an input's sign is asked


@dataclass(frozen=True)
class Asked:
    """A question about a trial, and whether it is to be set aside unless the answer is no."""

    said: str
    aside: bool = True


def gone_wrong(
    workspace: Folder, trial: Trial, tried: Tried | None, history: Sequence[Tried]
) -> Asked | None:
    """Return a question about a trial with an input reversed, or a run that went far astray.

    Args:
        workspace: the workspace with the model.
        trial: the trial as stored, with short gaps bridged.
        tried: its candidate with all of its runs; None if it ran none.
        history: all candidates with their runs.

    Returns:
        None if nothing is wrong with it.
    """
    from grounded.search.returned.reversed_input import beside_friction, reversed_input

    others = [t for t in history if t.utilities and t is not tried and math.isfinite(t.utility)]
    missed, usual = _missed(workspace, trial, tried, others) if tried else (0.0, 1.0)
    astray = missed > FAR * usual
    run = trial.until(workspace.task.horizon) if trial.candidate else trial
    found = (reversed_input if astray else beside_friction)(workspace.planner, run)
    if found:
        return _is_it_wired(workspace, trial, found)
    if tried is None or not (others and astray and STRAYED * usual < missed < math.inf):
        return None
    return Asked(
        f"it missed its prediction by {missed:,.3g}, {missed / usual:,.3g} times what runs miss or "
        "cost otherwise: did it run as it should? If not (a motor, a sensor, somebody in the way), "
        f"`discard {trial.id}` and run {tried.candidate.id} again; if it did, `propose` goes on"
    )


def _missed(
    workspace: Folder, trial: Trial, tried: Tried, others: Sequence[Tried]
) -> tuple[float, float]:
    """Return by how much a run missed its promised utility, and what runs miss otherwise."""
    usual = max(
        abs(tried.promised),
        min((abs(t.utility) for t in others), default=0.0),
        float(np.median([abs(t.promised - t.utility) for t in others])) if others else 0.0,
        1e-9,
    )
    return tried.promised - workspace.task.utility(trial), usual


def _is_it_wired(workspace: Folder, trial: Trial, found: Reversed) -> Asked:
    """Return the question about an input that acted the other way round, given the other trials."""
    from grounded.search.returned.reversed_input import signs_of

    each = [
        (one.id, signs_of(workspace.planner, one)[found.input])
        for one in diagnosable(workspace)
        if one.id != trial.id
    ]
    right, wrong = ([name for name, sign in each if sign == s] for s in (1, -1))
    again = f"mend it and run {trial.candidate} again" if trial.candidate else "mend it"
    if right:
        wired = f"Is it wired, or its sign switched, otherwise than in {ranges(right)}?"
        if not trial.candidate:
            return Asked(f"{found.said}. {wired} Then `discard {trial.id}` and {again}")
    elif trial.candidate:
        wired = "Is it wired the wrong way round, or is its sign in the model wrong?"
    else:
        told = "Is its sign in the log or in the model wrong? `diagnose` says what to change"
        return Asked(f"{found.said}. {told}", aside=False)
    like = f", as in {ranges(wrong)}" if wrong and not right else ""
    return Asked(
        f"{found.said}{like}. {wired} Then `discard {trial.id}`, {again}; if not, `propose` goes on"
    )
