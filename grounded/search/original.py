"""Step with the original model again if the steps of adopted effects break their promises.

A diagnosis may claim a wrong effect. The grounded model replays the best trial all the same, but
its steps lose. Every trial tests a promise: of the gain that a model's steps predicted, its KEPT
SHARE came about. If the model with the adopted effects has promised much and kept little, and the
original model has kept more, the original model makes the next step. This is decided anew for each
proposal, so the adopted effects are used again if the original model does worse. No trial is spent
on the choice. A gain within its own likely error is no promise: after one such gain had failed, a
self-balancing robot whose adopted effects were right nearly fell by a step of the original model.
The original model must also give the incumbent's own run about the utility that it had.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from grounded.search.candidate import LITTLE, Tried
from grounded.search.making import FORETOLD, About
from grounded.search.planner import Planner
from grounded.search.step_size import BROKEN


@dataclass(frozen=True)
class Promises:
    """Gains that the steps of a model promised in total, and what came of them in real trials."""

    promised: float = 0.0
    real: float = 0.0  # of each step at most the promised gain, and at least its negative

    @property
    def share(self) -> float:
        """Return the kept share; 1 for a model without steps."""
        return self.real / self.promised if self.promised > 0 else 1.0


def keeping_promises(about: About) -> About:
    """Return `about`, or the same without adopted effects if those broke their promises.

    Args:
        about: the current model grounded on the incumbent's trial.
    """
    make, planner = about.make, about.make.planner
    if planner.plan is planner.task:
        return about
    adopted, original = promises(make.now.history, make.fingerprint)
    much = adopted.promised >= LITTLE * -about.incumbent.utility
    if not (much and adopted.share < min(BROKEN, original.share)):
        return about
    crude = replace(make, planner=Planner(planner.task, planner.task))
    original_one = About(crude, about.incumbent, about.options, about.way, original=True)
    off = abs(original_one.already - about.incumbent.utility)
    return original_one if off < FORETOLD * -about.incumbent.utility else about


def promises(history: Sequence[Tried], model: str) -> tuple[Promises, Promises]:
    """Return the promises of the steps of the adopted model, and of all other steps.

    Args:
        history: all candidates with their trials.
        model: fingerprint of the model with the adopted effects.
    """
    utility = {t.candidate.id: t.utility for t in history if t.accepted is not None}
    adopted, original = Promises(), Promises()
    for tried in history:
        made = tried.candidate
        promised = 0.0 if made.doubtful else made.predicted_gain
        if made.base not in utility or made.id not in utility or not promised > 0:
            continue
        gained = max(-promised, min(utility[made.id] - utility[made.base], promised))
        if made.model == model and not made.of_original:
            adopted = Promises(adopted.promised + promised, adopted.real + gained)
        else:
            original = Promises(original.promised + promised, original.real + gained)
    return adopted, original
