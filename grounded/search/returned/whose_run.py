"""Tell whose run a trial is: its candidate's, another's, a misused one's or nobody's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from grounded.accounts.inputs import limits_of, span
from grounded.findings import Finding, Quantity, found
from grounded.search.candidate import Candidate
from grounded.search.returned.stories import Kind, stories
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


@dataclass(frozen=True, eq=False)
class Suspicion:
    """The result of comparing a trial's commands with its candidate's and others'."""

    ran: Following | None  # the comparison with its candidate
    why: Finding | None = None  # why it is not its candidate's run
    other: str = ""  # the candidate whose run it is instead, or ""


def suspicion(task: Task, trial: Trial, own: Candidate, others: Sequence[Candidate]) -> Suspicion:
    """Check whether a trial is a run of its candidate, and if not, whose it is.

    Args:
        task: the task with latency and units.
        trial: the trial, with gaps bridged; its candidate is `own`.
        own: the candidate that it is said to have run.
        others: candidates that it may have run instead, in order of proposal.
    """
    trial, late = trial.until(task.horizon), latest(task)
    ran = follows(own.policy, trial, late)
    if ran is None or (ran.alike and ran.error < 1e-5):
        return Suspicion(ran)
    rivals = [(follows(c.policy, trial, late), c.id) for c in others[-OTHERS:] if c.id != own.id]
    alike = [(evidence(ran, f), n, f.error) for f, n in rivals if f is not None and f.alike]
    nats, name, left = max(alike, default=(-np.inf, "", 0.0))
    if nats > DECISIVE:
        near = name if left < max(CLEAR, SAME * ran.error) else ""
        return Suspicion(ran, found("log.another", ran=own.id, other=name, nats=nats), near)
    if ran.alike:
        return Suspicion(ran)
    known = trial.inputs.any() and not ran.beyond  # else nothing was recorded, or another unit
    for story in stories(task, own, trial, ran) if known else ():
        if story.kind is Kind.PROGRAM:
            return Suspicion(ran, story.finding)
    moves = np.ptp(own.policy.feedforward, axis=0) > 0
    silent = moves & ~(trial.inputs != 0).any(axis=0)
    if silent.any():
        names = [n for n, is_ in zip(trial.input_names, silent, strict=True) if is_]
        return Suspicion(ran, found("log.silent", *names, ran=own.id))
    units, facts = task.model.inputs, dict[str, Any]()
    if ran.beyond:
        j = trial.input_names.index(ran.beyond)
        facts = {"beyond": ran.beyond, "logged": span(trial.inputs[:, j])}
        facts["limits"] = limits_of(task, j)
    until = Quantity(ran.until_s if ran.opens else 0.0, "s")
    rms = Quantity(ran.rms, units[ran.input])
    return Suspicion(
        ran, found("log.not_run", ran.input, ran=own.id, rms=rms, until=until, **facts)
    )
