"""Step with the original model again if a step of adopted effects lost and they miss its motion.

A diagnosis may claim a wrong effect. The grounded model replays the best trial all the same, but
its steps lose. A step that lost tests the effects: if the model without them foretells the motion
of such runs better, it makes the next step. Losses by noise, or at an optimum, say nothing against
effects that those runs confirm. This is decided anew for each proposal, and no trial is spent on
the choice. The original model must also give the incumbent's own run about the utility that it had.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from grounded.frozen import Array
from grounded.search.making import About
from grounded.search.planner import Planner
from grounded.solve.bias import residuals
from grounded.trial import Trial

FORETOLD = 0.2  # largest error of the original model at the incumbent, as a fraction of its cost
BLOCK = 10  # steps over which misses are summed


def trusted(about: About) -> About:
    """Return `about`, or the same without adopted effects if the runs that lost contradict those.

    Args:
        about: the current model grounded on the incumbent's trial.
    """
    make, planner = about.make, about.make.planner
    if planner.as_given:
        return about
    history, bare = make.now.history, Planner(planner.task, planner.task)
    lost = [
        trial
        for tried in history
        if tried.lost and tried.candidate.model == make.fingerprint
        if not tried.candidate.of_original
        for trial in tried.trials
    ]
    if not lost or tells_better(planner, bare, lost):
        return about
    crude = replace(make, planner=bare.feeding_back(t.candidate.policy for t in history))
    original = About(crude, about.incumbent, about.options, original=True)
    off = abs(original.already - about.incumbent.utility)
    return original if off < FORETOLD * -about.incumbent.utility else about


def tells_better(one: Planner, other: Planner, trials: Sequence[Trial]) -> bool:
    """Return whether one planner's model tells the motion in these runs better than another's.

    Both are compared by what they miss, summed up over `BLOCK` steps, as far as noise of the
    samples cancels in the sum; of each state, the difference counts as a share of both.
    """

    def missed(planner: Planner) -> Array:
        found = np.zeros(planner.task.model.n)
        for trial in trials:
            if not trial.finite_steps:
                continue
            whole = planner.lift(trial.until(trial.finite_steps))
            off = residuals(planner.plan, whole)[:, : len(found)]
            blocks = np.add.reduceat(off, np.arange(0, len(off), BLOCK))
            found += np.sum(np.square(blocks), axis=0)
        return found

    own, others = missed(one), missed(other)
    both = own + others
    return bool(np.sum((others - own)[both > 0] / both[both > 0]) > 0)
