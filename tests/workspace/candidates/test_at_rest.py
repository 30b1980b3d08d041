"""Which inputs hold a robot where it stands at the start of a log."""

import numpy as np
import pytest

from grounded import Model
from grounded.trial import Trial
from grounded_trials.workspace.candidates.at_rest import standstill


def push(gain, slope=0.0, zone=0.0):
    """Return a model on a slope, whose throttle acts beyond a dead zone."""

    def dynamics(s, a, p):
        beyond = np.where(a.throttle > zone, a.throttle - zone, 0 * a.throttle)
        return {"x": s.v, "v": gain * beyond - slope - s.v}

    inputs = {"throttle": "1"}
    return Model(states={"x": "m", "v": "m/s"}, inputs=inputs, params={}, derivative=dynamics)


@pytest.mark.parametrize(
    ("model", "needs"),
    [
        (push(4.0, slope=1.2), True),
        (push(6.0, slope=1.2), True),  # a crude gain
        (push(0.0), True),  # a skeleton that is not fitted yet can't tell
        (push(4.0, zone=0.3), True),  # nor one that stands either way
        (push(4.0), False),  # its motors are off, or it would move
    ],
)
def test_a_held_input_holds_a_robot_unless_its_model_moves_less_without(model, needs):
    t = 0.02 * np.arange(600)
    v = np.where(t > 4, 0.3 * np.sin(t - 4), 0.0)
    sent = np.where(t > 4, 0.3 + 0.3 * np.sin(t - 4), 0.3)
    states = np.column_stack([np.cumsum(v) * 0.02, v])
    trial = Trial(states, sent[:-1, None], 0.02, model.state_names, model.input_names)
    stand = standstill(model, trial)
    assert stand is not None and stand.needs.tolist() == [needs] and stand.inputs == [0.3]
