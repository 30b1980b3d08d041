"""Tell whose run a trial is: its candidate's, another's, a misused one's or nobody's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from grounded.accounts.inputs import limits_of, span
from grounded.result import listed, with_unit
from grounded.search.candidate import Candidate
from grounded.search.returned.misused import misused
from grounded.search.returned.who_drove import (
    CLEAR,
    DECISIVE,
    SAME,
    Following,
    evidence,
    follows,
    latest,
)
from grounded.task import Task
from grounded.trial import Trial

OTHERS = 20  # number of latest candidates to compare with
OR_UNITS = (
    ", or `runner.action` got states of another sensor, in other units or order, or a time that is "
    "not in s"
)


@dataclass(frozen=True, eq=False)
class Suspicion:
    """The result of comparing a trial's commands with its candidate's and others'."""

    ran: Following | None  # the comparison with its candidate
    why: str = ""  # why it is not its candidate's run, or ""
    other: str = ""  # the candidate whose run it is instead, or ""
    silent: tuple[str, ...] = ()  # inputs that are 0 throughout, though its plan moves them


def suspicion(task: Task, trial: Trial, own: Candidate, others: Sequence[Candidate]) -> Suspicion:
    """Check whether a trial is a run of its candidate, and if not, whose it is.

    Args:
        task: the task with latency and units.
        trial: the trial, with gaps bridged; its candidate is `own`.
        own: the candidate that it is said to have run.
        others: candidates that it may have run instead, in order of proposal.
    """
    trial, late = trial.until(task.horizon), latest(task)
    found = follows(own.policy, trial, late)
    if found is None or (found.alike and found.error < 1e-5):
        return Suspicion(found)
    rivals = [(follows(c.policy, trial, late), c.id) for c in others[-OTHERS:] if c.id != own.id]
    alike = [(evidence(found, f), n, f.error) for f, n in rivals if f is not None and f.alike]
    nats, name, left = max(alike, default=(-np.inf, "", 0.0))
    if nats > DECISIVE:
        same = left < max(CLEAR, SAME * found.error)
        looks = f"they are {'' if same else 'nearer to '}those of {name}"
        name = name if same else ""
    elif found.alike:
        return Suspicion(found)
    elif done := _misused(task, own, trial, found):
        looks = done
    elif still := _at_zero(trial, own):
        looks = (
            f"{listed(still)} {'is' if len(still) == 1 else 'are'} 0 from the first step to the "
        )
        looks += "last: were the commands recorded, and did `runner.action` get the seconds since "
        looks += "the start of the run?"
    elif found.opens:
        looks = (
            f"up to {found.until_s:.1f} s they are alike: then somebody, or something, took over, "
            f"or no new states reached the policy{OR_UNITS}"
        )
    else:
        looks = f"somebody, or another controller (the {own.id} of another workspace?), drove"
        looks += OR_UNITS
    name = name if nats > DECISIVE else ""
    if found.beyond:
        j = trial.input_names.index(found.beyond)
        logged, unit = span(trial.inputs[:, j]), task.model.inputs[found.beyond]
        differs = f"{found.beyond} is {with_unit(logged, unit)} in the log, beyond its [limits], "
        differs += limits_of(task, j)
        looks = f"check its unit and offset in [log]; if they are right, {looks}"
    else:
        rms = with_unit(f"{found.rms:.3g}", task.model.inputs[found.input])
        differs = f"{found.input} differs by {rms} (rms)"
    why = f"its commands are not what {own.id} sends on the logged states: {differs}; {looks}"
    return Suspicion(found, why, name, () if name else tuple(_at_zero(trial, own)))


def _misused(task: Task, own: Candidate, trial: Trial, found: Following) -> str:
    known = trial.inputs.any() and not found.beyond  # else nothing was recorded, or another unit
    done = misused(task, own, trial, found) if known else None
    return done[1].said if done else ""


def _at_zero(trial: Trial, own: Candidate) -> list[str]:
    """Return the inputs that are 0 in the whole log, though the candidate's plan moves them."""
    moves = np.ptp(own.policy.feedforward, axis=0) > 0
    silent = ~(trial.inputs != 0).any(axis=0)
    return [n for n, m, s in zip(trial.input_names, moves, silent, strict=True) if m and s]
