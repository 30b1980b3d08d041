"""A plan that reaches its target by a kick of its last commands is told before it is run."""

import numpy as np
import pytest

from grounded.trial import Trial
from grounded_trials.workspace.candidates.rest_at_end import kicked
from grounded_trials.workspace.folder import Folder
from workspaces import CONFIG, MODEL, make

ENDS = CONFIG.replace("{ x = 10.0 }", "{ }\nterminal = { x = 100.0 }")
RESTS = MODEL.replace("a.force - p", "a.force - 5.0 * s.x - p")


@pytest.mark.parametrize(
    ("model", "last", "moving", "fact"),
    [
        (MODEL, 5.0, 0.1, "--hold"),  # at its limit, and moving when it ends
        (MODEL, 1.0, 0.1, None),  # moving, but by no kick
        (MODEL, 5.0, 0.0, None),  # at its limit and at rest
        (RESTS, 5.0, 0.0, "runner.done(t)"),  # held by a force that ends with the run
    ],
)
def test_a_kick_or_a_hold_at_the_end_of_a_plan_is_told(tmp_path, model, last, moving, fact):
    planner = Folder(make(tmp_path / "w", config=ENDS, model=model).folder).planner
    task = planner.task
    states, inputs = np.nan_to_num(task.target), np.zeros((task.horizon, 1))
    states[-1, 1] = moving
    inputs[:] = last if model == RESTS else 0.0
    inputs[-3:] = last
    told = kicked(planner, Trial(states, inputs, task.dt, ("x", "v"), ("force",)), np.zeros(1))
    assert bool(told) == bool(fact) and (fact or "") in (told.sentence if told else "")
