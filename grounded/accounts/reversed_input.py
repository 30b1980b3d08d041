"""Find an input that acted the other way round in a run: a motor that was wired wrongly.

Its commands are the candidate's, so nothing is wrong with the log. But the model, with the effects
that were adopted, predicts a quarter of a second ahead from each sample far better if the sign of
that input is flipped. The memory of effects follows from the flipped commands. No constant rate is
removed: feedback with a wrong sign soon holds the input at its limit. A crude model predicts such a
run badly with either sign: then what its inputs do beside its friction tells, see `input_signs`.
"""

from __future__ import annotations

import numpy as np

from grounded.accounts.commands import Acts, how_inputs_act
from grounded.accounts.motion import HALF, Ahead
from grounded.accounts.returned import multiplied
from grounded.findings import Finding, found
from grounded.search.planner import Planner
from grounded.trial import Trial

STARTS = 120  # samples to predict from
CLEAR = 2.0  # [nats] by which the flipped sign must lower the errors
MUCH = 0.3  # the error of at least one state must fall to this share


def reversed_input(planner: Planner, trial: Trial) -> Finding | None:
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
        before, turned = as_it_is.plain(gains), None
        least = before.score - CLEAR
        for name in known.input_names:
            after = _ahead(planner, multiplied(known, [name], -1.0)).plain(gains)
            shares = after.rms[:own] / before.rms[:own]
            shares[after.rms[:own] > HALF * far] = 1.0
            i = int(np.argmin(shares))
            if after.score < least and shares[i] < MUCH:
                state = planner.task.model.state_names[i]
                turned = found("run.reversed", name, state=state, times=1 / shares[i])
                least = after.score
    return turned or beside_friction(planner, known)


def beside_friction(planner: Planner, trial: Trial) -> Finding | None:
    """Return the input that acted the other way round by all that is not linear in the states.

    Args:
        planner: plans with the model, and the effects adopted.
        trial: a trial; only its part without gaps is used.
    """
    acts = _acts(planner, trial)
    wrong = {name: one for name, one in acts.items() if one.sign < 0}
    if not wrong:
        return None
    name = min(wrong, key=lambda one: abs(wrong[one].share + 1))
    return found("run.reversed", name, share=-wrong[name].share)


def signs_of(planner: Planner, trial: Trial) -> dict[str, int]:
    """Return the sign with which each input acts: 1 as in the model, -1 reversed, 0 unknown.

    Args:
        planner: plans with the model, and the effects adopted.
        trial: a trial; only its part without gaps is used.
    """
    return {name: one.sign for name, one in _acts(planner, trial).items()}


def _acts(planner: Planner, trial: Trial) -> dict[str, Acts]:
    model = planner.plan.model
    acts = how_inputs_act(model, planner.lift(trial), range(planner.task.model.n))
    return dict(zip(model.input_names, acts, strict=True))


def _ahead(planner: Planner, trial: Trial) -> Ahead:
    model = planner.plan.model
    lifted = planner.lift(trial)
    return Ahead(model, lifted, range(model.n), STARTS, (0.0,), constant=False)
