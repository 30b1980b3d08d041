"""Step with the original model again if the steps of adopted effects break their promises.

A diagnosis may claim a wrong effect. The grounded model replays the best trial all the same, but
its steps lose. Every trial tests a promise: of the gain that a model's steps predicted, its KEPT
SHARE came about. If the model with the adopted effects has promised much and kept little, and the
original model has kept more, the original model makes the next step. This is decided anew for each
proposal, so the adopted effects are used again if the original model does worse. No trial is spent
on the choice. A gain within its own likely error is no promise: after one such gain had failed, a
self-balancing robot whose adopted effects were right nearly fell by a step of the original model.
Nor is a promise broken by a loss that the scatter of repeats may explain, or by a run that ended
early on its path, because somebody stopped it: the promises count as kept as far as two standard
errors allow. The original model must also give the incumbent's own run about the utility that it
had, and it must foretell the motion of the runs that broke the promises better than the adopted one
does: losses by noise, or at an optimum, say nothing against effects that those runs confirm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.frozen import Array
from grounded.search.candidate import DOUBTFUL_GAIN, Tried
from grounded.search.difference import LUCK, Difference
from grounded.search.making import FORETOLD, About
from grounded.search.planner import Planner
from grounded.search.step.step_size import BROKEN_PROMISE
from grounded.solve.bias import residuals
from grounded.task import Task
from grounded.trial import Trial

BLOCK = 10  # steps over which misses are summed
ON_PATH = 2.0  # a run that ended early was on its path if it cost at most this times the best one


@dataclass(frozen=True)
class Promises:
    """Gains that the steps of a model promised in total, and what came of them in real trials."""

    promised: float = 0.0
    real: float = 0.0  # of each step at most the promised gain, and at least its negative
    doubt: float = 0.0  # by how much more it may be: `LUCK` standard errors, within those bounds

    @property
    def share(self) -> float:
        """Return the kept share; 1 for a model without steps."""
        return self.real / self.promised if self.promised > 0 else 1.0

    @property
    def broken(self) -> bool:
        """Whether less than the share `BROKEN_PROMISE` was kept, beyond doubt."""
        return self.real + self.doubt < BROKEN_PROMISE * self.promised

    def and_of(self, promised: float, real: float, error: float) -> Promises:
        """Return them with those of one more step, given the standard error of its gain."""
        gained, may = np.clip([real, real + LUCK * error], -promised, promised).tolist()
        doubt = math.hypot(self.doubt, may - gained)
        return Promises(self.promised + promised, self.real + gained, doubt)


def keeping_promises(about: About) -> About:
    """Return `about`, or the same without adopted effects if those broke their promises.

    Args:
        about: the current model grounded on the incumbent's trial.
    """
    make, planner = about.make, about.make.planner
    if planner.as_given:
        return about
    history = make.now.history
    stopped = [t.candidate.id for t in history if stopped_on_path(planner.task, t, history)]
    adopted, original = promises(history, make.fingerprint, stopped)
    much = adopted.promised >= DOUBTFUL_GAIN * -about.incumbent.utility
    if not (much and adopted.broken and adopted.share < original.share):
        return about
    bare = Planner(planner.task, planner.task)
    own = [t for t in history if _by_adopted(t, make.fingerprint)]
    if confirmed(planner, bare, [trial for t in own for trial in t.trials]):
        return about
    crude = replace(make, planner=bare.feeding_back(t.candidate.policy for t in history))
    original_one = About(crude, about.incumbent, about.options, about.way, original=True)
    off = abs(original_one.already - about.incumbent.utility)
    return original_one if off < FORETOLD * -about.incumbent.utility else about


def confirmed(adopted: Planner, bare: Planner, trials: Sequence[Trial]) -> bool:
    """Return whether the adopted effects tell the motion in these runs better than none do.

    Both models are compared by what they miss, summed up over `BLOCK` steps, as far as noise of the
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

    ours, theirs = missed(adopted), missed(bare)
    both = ours + theirs
    return bool(np.sum((theirs - ours)[both > 0] / both[both > 0]) > 0)


def _by_adopted(tried: Tried, model: str) -> bool:
    """Return whether a candidate's step is one of the adopted model."""
    return tried.candidate.model == model and not tried.candidate.of_original


def stopped_on_path(task: Task, tried: Tried, history: Sequence[Tried]) -> bool:
    """Return whether a candidate only failed by runs that ended early, though on their path.

    They are compared with the runs of the candidate that it was made from, up to the same step.
    """
    base = next((t for t in history if t.candidate.id == tried.candidate.base), None)
    failed = [t for t, u in zip(tried.trials, tried.utilities, strict=True) if u == -np.inf]
    if not failed or base is None or not math.isfinite(base.utility):
        return False
    costs = -np.mean([task.rewards(trial) for trial in base.trials], axis=0)

    def on_path(run: Trial) -> bool:
        T = run.steps
        early = run.finite_steps == T < task.horizon
        return early and -task.rewards(run)[:T].sum() <= ON_PATH * costs[:T].sum()

    return all(map(on_path, failed))


def promises(
    history: Sequence[Tried], model: str, without: Sequence[str] = ()
) -> tuple[Promises, Promises]:
    """Return the promises of the steps of the adopted model, and of all other steps.

    Args:
        history: all candidates with their trials.
        model: fingerprint of the model with the adopted effects.
        without: ids of candidates whose runs neither kept nor broke a promise.
    """
    judged = {t.candidate.id: t for t in history if t.accepted or t.lost}
    judged = {name: tried for name, tried in judged.items() if name not in without}
    adopted, original = Promises(), Promises()
    for tried in history:
        made = tried.candidate
        promised = 0.0 if made.doubtful else made.predicted_gain
        if made.base not in judged or made.id not in judged or not promised > 0:
            continue
        base = judged[made.base]
        between = Difference(base, tried, history)
        gained = promised, tried.gain_over(base), between.error if between.known else 0.0
        if _by_adopted(tried, model):
            adopted = adopted.and_of(*gained)
        else:
            original = original.and_of(*gained)
    return adopted, original
