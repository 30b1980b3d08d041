"""Find that a program, or a drive, cuts a candidate's commands inside their limits.

A cut repeats one value to the last digit wherever the policy asks for more, and nowhere else. The
plan, made for the wider limits, then promises what cannot be sent, and the log, which has the
commands as they were sent, is right: no diagnosis of the model would find it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from grounded.findings import Finding, found
from grounded.frozen import Array
from grounded.policy import Policy
from grounded.result import number
from grounded.search.candidate import Candidate
from grounded.search.returned.who_drove import LEAST, SLIGHT, Commanded, commanded
from grounded.trial import Trial

SAME = 1e-6  # of a command's size: at the cut
PART = 0.05  # least share of the steps at a cut
NEARLY = 0.8  # least share of them in which more is asked for, and of those in which it is


@dataclass(frozen=True)
class Clipped:
    """Commands that were cut inside their limits."""

    cuts: dict[str, dict[int, float]]  # by input, and by the side, -1 or 1
    share: float  # of the steps in which some command was cut

    def bounds(self, own: Candidate) -> tuple[Array, Array]:
        """Return the limits with these cuts, (m,) each."""
        low, high = own.policy.low.copy(), own.policy.high.copy()
        for name, ends in self.cuts.items():
            j = own.policy.input_names.index(name)
            low[j], high[j] = ends.get(-1, low[j]), ends.get(1, high[j])
        return low, high

    def finding(self, own: Candidate) -> Finding:
        """Return that its commands are those of a candidate, cut inside their limits."""
        at = tuple(f"{n} = {number(v)}" for n, ends in self.cuts.items() for v in ends.values())
        return found("run.clipped", *self.cuts, ran=own.id, share=self.share, at=at)


def clipped(own: Candidate, trial: Trial) -> Clipped | None:
    """Return at which values the commands of a run were cut inside their limits, or None.

    Args:
        own: the candidate.
        trial: its run, without gaps.
    """
    policy, T = own.policy, min(trial.finite_steps, own.policy.horizon)
    if T < LEAST or (policy.state_names, policy.input_names) != (
        trial.state_names,
        trial.input_names,
    ):
        return None
    run = commanded(policy, trial)
    cuts, cut = dict[str, dict[int, float]](), np.zeros(T, bool)
    for j, name in enumerate(policy.input_names):
        for sign in (-1, 1):
            if (at := _cut(policy, run, j, sign)) is not None:
                cuts.setdefault(name, {})[sign] = float(run.sent[at, j][0])
                cut |= at
    return Clipped(cuts, float(cut.mean())) if cuts else None


def _cut(policy: Policy, run: Commanded, j: int, sign: float) -> Any:
    """Return the steps (T,) at which an input was cut at its largest or smallest value; or None."""
    u, wanted, size = sign * run.sent[:, j], sign * run.asked[:, j], float(run.size[j])
    end = float(u.max())
    limit = float(policy.high[j] if sign > 0 else -policy.low[j])
    at, more = u >= end - SAME * size, wanted > end + SLIGHT * size
    both = float((at & more).sum())
    enough = at.sum() >= max(LEAST, PART * len(u)) and end < limit - SLIGHT * size
    return at if enough and both >= NEARLY * max(at.sum(), more.sum()) else None
