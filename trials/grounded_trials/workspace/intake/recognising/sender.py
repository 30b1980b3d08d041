"""Decide which candidate sent the commands of a log, on the samples that its program acted on.

The candidate that is said to have run is compared with the others that may be on the robot: a
neighbour of it sends commands that differ by a few percent, so each is computed from the samples of
the age that fits best (`acted_on`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from grounded.accounts.sent import (
    FINE,
    LATEST,
    LEAST,
    RESEMBLES,
    Following,
    follows,
    steps_alike,
)
from grounded.findings import Finding, found
from grounded.policy import Policy
from grounded.search.candidate import Candidate
from grounded_trials.workspace.intake.locating.acted_on import ActedOn, acted_on
from grounded_trials.workspace.intake.locating.run_start import Recording, Start

LUCK = float(np.log(2) / 2)  # [nats] per step: half the squares, which lower gains also give
CLEARLY = 6.0  # [nats] of evidence, beyond LUCK, for another candidate
ONE = 3e-3  # rms difference, relative to size, below which two candidates count as equal


def nats(own: ActedOn, other: ActedOn) -> float:
    """Return the evidence [nats] that another candidate sent the commands, not the own one.

    It is the logarithm of the ratio of the differences that each leaves, summed over the steps,
    which corresponds to heavy-tailed noise (lost packets). Ratios that chance or lower gains could
    also give do not count.
    """
    T = min(len(own.off), len(other.off))
    both = np.isfinite(own.off[:T] + other.off[:T])
    a, b = (np.log(np.hypot(one.off[:T][both], FINE)) for one in (own, other))
    gained = a - b - LUCK
    return float(gained.sum()) / steps_alike(gained) if both.sum() >= LEAST else 0.0


@dataclass(frozen=True, eq=False)
class Sender:
    """The candidate that sent the commands of a log, judged on the samples that it acted on."""

    own: ActedOn | None  # None if the log is too short
    other: str = ""  # another candidate whose commands they are, or ""
    why: Finding | None = None  # the reason

    @property
    def sure(self) -> bool:
        """Whether the own candidate sent them throughout, mostly to the last digits."""
        return self.own is not None and self.own.throughout


def sender_of(
    log: Recording,
    own: Candidate,
    candidates: Sequence[Candidate],
    start_of: Callable[[Candidate], Start | None],
) -> Sender:
    """Check whether another candidate than the stated one sent the commands of a log.

    Args:
        log: the log with the run.
        own: the candidate that it is said to have run.
        candidates: candidates that may have been run instead.
        start_of: returns where a candidate's run seems to begin in the log.
    """
    start = start_of(own)
    begins = log.first if start is None else start.seconds
    mine = acted_on(log, own.policy, begins)
    if mine is None or mine.exact:
        return Sender(mine)
    best, name, theirs = CLEARLY, "", mine
    ran = _following(log, own.policy, begins)
    late = ran is not None and ran.alike and ran.late != 0  # late commands belong to other steps
    for one in reversed(candidates):
        at = begins
        if (start is None or not start.alike) and (begun := start_of(one)) and begun.opens_alike:
            at = begun.seconds
        fit = None if one.id == own.id else acted_on(log, one.policy, at)
        if fit is None or _one(mine, fit):
            continue
        if fit.left > RESEMBLES or (for_it := nats(mine, fit)) <= best:
            continue
        if fit.exact or (not late and (there := _following(log, one.policy, at)) and there.alike):
            best, name, theirs = for_it, one.id, fit
        if name and theirs.left < FINE:
            break
    if not name:
        return Sender(mine)
    why = found("log.another", ran=own.id, other=name, nats=best)
    left = {"theirs": max(theirs.left, FINE), "mine": max(mine.left, FINE)}
    return Sender(mine, name, why.also(**left))


def _one(mine: ActedOn, fit: ActedOn) -> bool:
    """Return whether two candidates send the same commands within ONE."""
    T = min(len(mine.asked), len(fit.asked))
    apart = (mine.asked[:T] - fit.asked[:T]) / mine.size
    return float(np.sqrt((apart**2).mean())) < ONE


def _following(log: Recording, policy: Policy, start: float) -> Following | None:
    """Compare commands with a policy's by `follows`; even of unrelated ones some is nearest."""
    trial = log.trial_from(start)
    return follows(policy, trial.until(policy.horizon), LATEST) if trial else None
