"""What the motion of a run tells of its commands: an input that acts in reverse.

A motor that was wired wrongly gives a faultless log: how its input acts tells, see `commands`.
"""

from __future__ import annotations

import numpy as np

from grounded.accounts.commands import STARTS, Acts, how_inputs_act
from grounded.accounts.levels import HALF, MARGIN
from grounded.accounts.motion import Ahead
from grounded.findings import Finding, found
from grounded.search.planner import Planner
from grounded.trial import Trial

LEFT_BY_FLIP = 0.3  # share left of one state's error if the sign of an input is flipped


def reversed_input(planner: Planner, trial: Trial, *, astray: bool) -> Finding | None:
    """Return the input that acted the other way round in a trial, or None.

    Of a run far from its prediction, `astray`, predictions with the flipped sign tell as well.
    """
    acts = _acts(planner, trial)
    wrong = {name: one for name, one in acts.items() if one.sign < 0}
    if wrong:
        name = min(wrong, key=lambda one: abs(wrong[one].share + 1))
        return found("run.reversed", name, share=-wrong[name].share)
    if not astray:
        return None
    # feedback with a wrong sign soon holds an input at its limit, where it does not move on its own
    model, m, own = planner.plan.model, planner.plan.model.m, list(range(planner.task.model.n))
    known = planner.lift(trial.until(max(trial.finite_steps, 0)))
    ahead = Ahead(model, known, range(model.n), STARTS, (0.0,), constant=False)
    if not ahead.enough:
        return None
    with np.errstate(all="ignore"):
        each = ahead.missed(np.vstack([np.ones(m), 1 - 2 * np.eye(m)]), model.values, 0)
        plain, *turned = [ahead.size(one) for one in each]
        nats = [float(np.log(plain / one).sum()) for one in turned]
        j = int(np.argmax(nats))
        shares = np.where(turned[j] > HALF * ahead.moved, 1.0, turned[j] / plain)[own]
    i = int(np.argmin(shares))
    if nats[j] < 2 * MARGIN or shares[i] > LEFT_BY_FLIP:
        return None
    state = planner.task.model.state_names[i]
    return found("run.reversed", trial.input_names[j], state=state, times=1 / float(shares[i]))


def signs_of(planner: Planner, trial: Trial) -> dict[str, int]:
    """Return the sign with which each input acts: 1 as in the model, -1 reversed, 0 unknown."""
    return {name: one.sign for name, one in _acts(planner, trial).items()}


def _acts(planner: Planner, trial: Trial) -> dict[str, Acts]:
    model = planner.plan.model
    acts = how_inputs_act(model, planner.lift(trial), range(planner.task.model.n))
    return dict(zip(model.input_names, acts, strict=True))
