"""Gains and offsets in the constants that a model declares."""

import numpy as np
import pytest

from grounded.effects.declared import declared
from grounded.model import Model, Param

ROVER = Model(
    states={"x": "m", "y": "m", "psi": "rad"},
    inputs={"left": "rad/s", "right": "rad/s"},
    params={"r_left": Param(0.03, "m"), "r_right": Param(0.03, "m"), "track": Param(0.2, "m")},
    derivative=lambda s, a, p: {
        "x": 0.5 * (p.r_left * a.left + p.r_right * a.right) * np.cos(s.psi),
        "y": 0.5 * (p.r_left * a.left + p.r_right * a.right) * np.sin(s.psi),
        "psi": (p.r_right * a.right - p.r_left * a.left) / p.track,
    },
)
CAR = Model(
    states={"x": "m", "y": "m", "psi": "rad", "v": "m/s"},
    inputs={"steering": "1", "throttle": "1"},
    params={
        "ratio": Param(0.4, "rad"),
        "offset": Param(0.0, "rad"),
        "push": Param(3.0, "m/s^2"),
        "L": Param(0.3, "m", 0.1, 1.0),
    },
    derivative=lambda s, a, p: {
        "x": s.v * np.cos(s.psi),
        "y": s.v * np.sin(s.psi),
        "psi": s.v / p.L * np.tan(p.ratio * a.steering + p.offset),
        "v": p.push * a.throttle,
    },
)
ROTOR = Model(
    states={"z": "m", "w": "m/s"},
    inputs={"speed": "rad/s"},
    params={"k_T": Param(2e-3, "N s^2"), "m": Param(1.0, "kg")},
    derivative=lambda s, a, p: {"z": s.w, "w": p.k_T / p.m * a.speed**2 - 9.81},
)


@pytest.mark.parametrize(
    ("model", "effect", "size", "values"),
    [
        (ROVER, "input_gain:left", 0.1, {"r_left": 0.033}),
        (ROVER, "rate_gain:psi", -0.2, {"track": 0.25}),
        (ROVER, "input_gain:left+right", 0.1, {}),  # of both radii together
        (CAR, "input_gain:steering", 0.25, {"ratio": 0.5}),
        (CAR, "input_bias:steering", 0.1, {"offset": 0.04}),
        (CAR, "rate_gain:psi", 0.1, {}),  # L is uncertain: a cause of its own
        (CAR, "offset:v", 0.1, {}),
        (ROTOR, "input_gain:speed", 0.1, {"k_T": 2e-3 * 1.21, "m": 1 / 1.21}),
        (ROTOR, "delay:speed", 0.1, {}),
    ],
)
def test_an_effect_is_another_value_of_a_constant(model, effect, size, values):
    found = {one.parameter: one.value for one in declared(model, effect, size, 0.01)}
    assert found == pytest.approx(values)
