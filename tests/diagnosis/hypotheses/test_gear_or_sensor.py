"""A state that only integrates another one: its sensor's scale and a gear are one thing."""

import numpy as np
import pytest

from grounded import Model, Param, Trial
from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.effects import Library
from grounded.models.pendulum import model as pendulum
from grounded.places import levelled

STICK = Model(
    name="stick",
    states={"stick": "rad", "stick_rate": "rad/s"},
    inputs={"valve": "1"},
    params={"k": Param(0.8, "rad/s", 0.4, 1.6)},
    derivative=lambda s, a, p: {
        "stick": s.stick_rate,
        "stick_rate": (p.k * a.valve - s.stick_rate) / 0.15,
    },
)


def test_a_wrong_zero_of_a_sensor_may_be_another_level():
    assert levelled(pendulum) == ["theta"] and not levelled(STICK)
    params = {"g": Param(9.8, "m/s^2"), "l": Param(0.5, "m")}
    coupled = Model(  # the angle also moves the cart
        name="cart",
        states={"x": "m", "v": "m/s", "q": "rad", "w": "rad/s"},
        inputs={"f": "N"},
        params=params,
        derivative=lambda s, a, p: {
            "x": s.v,
            "v": a.f + np.sin(s.q),
            "q": s.w,
            "w": -p.g / p.l * np.sin(s.q),
        },
    )
    assert levelled(coupled) == []
    ball = Model(  # the verdict named the encoder alone, and the student's table was not level
        name="ball",
        states={"x": "m", "v": "m/s", "beam": "rad", "w": "rad/s"},
        inputs={"volt": "V"},
        params=params,
        derivative=lambda s, a, p: {
            "x": s.v,
            "v": 5 / 7 * p.g * np.sin(s.beam),
            "beam": s.w,
            "w": 8 * (0.5 * a.volt - s.w),
        },
    )
    assert levelled(ball) == ["beam"]


def short(scale=0.94, trials=3, steps=200, dt=0.02):
    """An encoder that reads 6 % short beside a gyro that is right."""
    rng, found = np.random.default_rng(7), []
    for _ in range(trials):
        u, states = np.repeat(rng.uniform(-1, 1, steps // 10), 10), [np.zeros(2)]
        for sent in u:
            x, a = states[-1][None], np.array([[sent]])
            states.append(STICK.system.step(x, a, STICK.values, dt)[0])
        y = np.array(states) * [scale, 1.0] + rng.normal(size=(steps + 1, 2)) * [5e-4, 4e-3]
        found.append(Trial(y, u[:, None], dt, STICK.state_names, STICK.input_names))
    return found


@pytest.mark.slow
def test_an_encoder_that_reads_short_is_named_and_a_gear_as_its_second_reading():
    families = ("sensor_scale", "rate_gain", "viscous_friction")
    few = DiagnosisOptions(library=Library(tuple(map(Library().family, families))))
    found = diagnose(STICK, short(), few)
    assert found.effects == ("sensor_scale:stick",)
    assert found.ranking[0].values["k"] == pytest.approx(-0.06, abs=0.005)
    (one,) = [one for one in found.findings if one.code == "model.sensor"]
    assert one.about == ("stick",) and one.facts["rate"] == "stick_rate"
