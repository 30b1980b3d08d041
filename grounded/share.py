"""A share of what is large: trials of which so many steps are used as an answer needs.

A fit and a diagnosis take minutes for 100,000 steps or 100 trials, and what more data add to an
answer falls with their root. So whole trials are taken at equal distances in the order in which
they were recorded, as many as the budget has room for; a longer one is cut to its first steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from grounded.findings import Finding, found
from grounded.trial import Trial

STEPS, TRIALS = 100_000, 100  # control steps of all trials together, and trials, at most


@dataclass(frozen=True, eq=False)
class Share:
    """The trials that are used, and the finding that says which these are; None for all."""

    trials: list[Any]
    finding: Finding | None = None


def share_of(trials: Sequence[Trial], steps: int = STEPS, most: int = TRIALS) -> Share:
    """Choose trials, which are in the order of their recording, within both budgets."""
    total = sum(trial.steps for trial in trials)
    if total <= steps and len(trials) <= most:
        return Share([*trials])
    cut = [trial.until(steps) for trial in trials]
    length = np.array([trial.steps for trial in cut])
    for count in range(min(len(cut), most), 0, -1):
        chosen = np.unique(np.linspace(0, len(cut) - 1, count).astype(int))
        if (used := int(length[chosen].sum())) <= steps:
            break
    kept = len(chosen) if len(chosen) < len(cut) else None
    first = any(trial.steps > steps for trial in trials)
    told = found("model.share", used=used, total=total, kept=kept, trials=len(cut), first=first)
    return Share([cut[i] for i in chosen], told)
