"""Trials that repeat one motion tell no cause from whatever else repeats with it."""

import numpy as np
import pytest

from grounded import Model, Param, Trial
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.validation.limits import (
    without_others,
)
from grounded.effects import Library

DT, STEPS = 0.05, 120
WAVE, OMEGA = 0.4, 2.0


def carts(speeds, params=None):
    """A cart that is shaken, sent a sine of each angular frequency [rad/s]; its crude model."""
    model = Model(
        states={"x": "m", "v": "m/s"},
        inputs={"u": "m/s^2"},
        params=params or {"k": Param(1.0, "1", std=0.1)},
        roles={"position": ("x",), "speed": "v"},
        derivative=lambda s, a, p: {"x": s.v, "v": p.k * a.u - s.v},
        name="cart",
    )
    rng, found, t = np.random.default_rng(3), [], np.arange(STEPS) * DT
    for speed in speeds:
        u, x, states = np.sin(speed * t), np.zeros(2), [np.zeros(2)]
        for now, value in zip(t, u, strict=True):
            for part in range(5):
                shake = WAVE * np.sin(OMEGA * (now + (part + 0.5) * DT / 5))
                half = x[1] + DT / 10 * (value - x[1] + shake)  # a midpoint
                x = x + DT / 5 * np.array([half, value - half + shake])
            states.append(x)
        y = np.array(states) + np.array([1e-3, 4e-3]) * rng.standard_normal((STEPS + 1, 2))
        found.append(Trial(y, u[:, None], DT, ("x", "v"), ("u",), start_inputs=np.zeros(1)))
    return model, found


APART = (1.1, 1.7, 2.6, 3.4)
shake = {"A": WAVE, "B": 0.0, "omega": OMEGA}


@pytest.mark.parametrize(("speeds", "free"), [(APART, True), ([1.7] * 4, False)])
def test_numbers_of_an_adopted_wave_are_held_where_one_motion_is_repeated(speeds, free):
    names = ("periodic_v_A", "periodic_v_B", "periodic_v_omega")
    numbers = dict(zip(names, shake.values(), strict=True))
    params = {"k": Param(1.0, "1", std=0.1)}
    params |= {name: Param(value, "1", std=0.1) for name, value in numbers.items()}
    model, trials = carts(speeds, params)
    data = prepare(model, trials, np.zeros(1))
    held = without_others(data, ["periodic:v"], Library())
    assert [held.params[name].spread > 0 for name in ("k", *names)] == [True] + [free] * 3
