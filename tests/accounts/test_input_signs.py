"""A motor wired the wrong way round in some trials, seen by a model without friction."""

import numpy as np
import pytest

from grounded import Model, Param
from grounded.accounts.commands import how_inputs_act
from grounded.trial import Trial

DT = 0.01
AXIS = Model(
    name="axis",
    states={"x": "m", "v": "m/s"},
    inputs={"torque": "N m"},
    params={"M": Param(12.0, "kg", 9.0, 16.0)},
    derivative=lambda s, a, p: {"x": s.v, "v": 100.0 * a.torque / p.M},
)


def driven(wired=1.0, rises=0.0, seed=0, seconds=3.0, identity=""):
    """An axis with friction of 8 N and 15 N s/m, under feedback to points 1.3 s apart.

    With `rises`, a negative spring [N/m], it has no friction, and the points are near 0.
    """
    rubs, far = (0.0, 0.1) if rises else (1.0, 1.0)
    rng = np.random.default_rng(seed)
    goals = far * rng.uniform(0.0, 1.0, 40)
    x, v, states, inputs = 0.0, 0.0, [], []
    for k in range(round(seconds / DT)):
        states.append((x + 2e-5 * rng.normal(), v + 2e-3 * rng.normal()))
        u = 1.6 * (goals[int(k * DT / 1.3)] - states[-1][0]) - 0.5 * states[-1][1]
        inputs.append((np.clip(u + 0.05 * rng.normal(), -1.5, 1.5),))
        for _ in range(10):
            force = 100.0 * wired * inputs[-1][0] + rises * x
            v += 1e-3 * (force - rubs * (8.0 * np.tanh(v / 0.005) + 15.0 * v)) / 12.0
            x += 1e-3 * v
    names = (AXIS.state_names, AXIS.input_names)
    return Trial(np.array([*states, (x, v)]), np.array(inputs), DT, *names, id=identity)


@pytest.mark.parametrize("wired", [1.0, -1.0])
@pytest.mark.parametrize("seed", range(3))
def test_the_sign_of_an_input_is_known_though_friction_is_not_modelled(wired, seed):
    """With the wrong sign the feedback runs away: the input is at its limit but for 0.3 s."""
    (acts,) = how_inputs_act(AXIS, driven(wired, seed=seed), range(2))
    assert acts.sign * wired >= 0
