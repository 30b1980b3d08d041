"""Find an input that acted the other way round in a run: a motor that was wired wrongly.

Its commands are the candidate's, so nothing is wrong with the log. But the model, with the effects
that were adopted, predicts a quarter of a second ahead from each sample far better if the sign of
that input is flipped. The memory of effects follows from the flipped commands. No constant rate is
removed: feedback with a wrong sign soon holds the input at its limit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grounded.instruments.short_runs import Ahead
from grounded.search.planner import Planner
from grounded.search.returned.as_predicted import multiplied
from grounded.trial import Trial

STARTS = 120  # samples to predict from
CLEAR = 2.0  # [nats] by which the flipped sign must lower the errors
MUCH = 0.3  # the error of at least one state must fall to this share
PLAIN = 0.5  # and to this share of how far the state moves: else the model explains neither


@dataclass(frozen=True)
class Reversed:
    """An input that acted the other way round.

    Args:
        input: its name.
        state: the state whose prediction the flipped sign improves most.
        share: the error of that prediction, as a share of the one with the model's sign.
    """

    input: str
    state: str
    share: float


def reversed_input(planner: Planner, trial: Trial) -> Reversed | None:
    """Return the input that acted the other way round in a run, or None.

    Args:
        planner: plans with the model, and the effects adopted.
        trial: a run; only its part without gaps is used.
    """
    known, model = trial.until(max(trial.finite_steps, 0)), planner.plan.model
    own, gains = planner.task.model.n, np.ones(model.m)
    as_it_is = _ahead(planner, known)
    if not as_it_is.enough:
        return None
    moved = model.difference(as_it_is.last, as_it_is.first)[:, :own]
    far = np.sqrt((moved**2).mean(axis=0))
    with np.errstate(all="ignore"):
        before, found = as_it_is.plain(gains), None
        least = before.score - CLEAR
        for name in known.input_names:
            after = _ahead(planner, multiplied(known, [name], -1.0)).plain(gains)
            shares = after.rms[:own] / before.rms[:own]
            shares[after.rms[:own] > PLAIN * far] = 1.0
            i = int(np.argmin(shares))
            if after.score < least and shares[i] < MUCH:
                state = planner.task.model.state_names[i]
                found, least = Reversed(name, state, float(shares[i])), after.score
    return found


def _ahead(planner: Planner, trial: Trial) -> Ahead:
    model = planner.plan.model
    lifted = planner.lift(trial)
    return Ahead(model, lifted, range(model.n), STARTS, (0.0,), constant=False)
