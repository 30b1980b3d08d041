"""A plan that reaches its target by a kick of its last commands is told before it is run."""

import numpy as np
import pytest

from facts import holds
from grounded.trial import Trial
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.intake.after_run import kicked
from workspaces import CONFIG, make

ENDS = CONFIG.replace("{ x = 10.0 }", "{ }\nterminal = { x = 100.0 }")


@pytest.mark.parametrize(
    ("last", "lag", "said"),
    [
        (5.0, 0.1, True),  # at its limit, and moving when it ends
        (1.0, 0.1, False),  # moving, but by no kick
        (5.0, 0.0, False),  # at its limit and at rest
    ],
)
def test_what_is_on_target_for_one_sample_only_is_told(tmp_path, last, lag, said):
    """`at the end x 1.009 m` stood where the robot was 4 cm away a second later."""
    assert ENDS != CONFIG
    planner = Folder(make(tmp_path / "w", config=ENDS).folder).planner
    task = planner.task
    states, inputs = np.array(task.target), np.zeros((task.horizon, 1))
    states[np.isnan(states)] = 0.0
    states[-1] = [states[-1, 0], lag]
    inputs[-3:] = last
    run = Trial(states, inputs, task.dt, ("x", "v"), ("force",))
    told = kicked(planner, run, np.zeros(1))
    assert bool(told) == said
    if said:
        assert holds(told, "force at a limit", "one sample", "--hold")
