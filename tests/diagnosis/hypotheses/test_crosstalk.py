"""An input that acts on a state without a path in the model, seen on a helicopter with two fans."""

import numpy as np
import pytest

import grounded as gr
from grounded.effects import Library
from grounded.models.arm import model as arm

DT, STEPS, K = 0.05, 160, -0.4


def fans(cross=0.0):
    """Each fan turns one axis, damped; the first one's torque may also turn the second axis."""
    return gr.Model(
        states={"pitch_rate": "rad/s", "yaw_rate": "rad/s"},
        inputs={"u_pitch": "V", "u_yaw": "V"},
        params={"d": gr.Param(0.8, "1/s", 0.1, 3.0), "cross": gr.Param(cross, "rad/s^2/V")},
        derivative=lambda s, a, p: {
            "pitch_rate": 1.2 * a.u_pitch - p.d * s.pitch_rate,
            "yaw_rate": a.u_yaw - p.d * s.yaw_rate + p.cross * a.u_pitch,
        },
    )


@pytest.fixture(scope="module")
def found():
    rng, trials, real = np.random.default_rng(7), [], fans(K)
    for _ in range(3):
        u = np.repeat(rng.uniform(-1, 1, (STEPS // 8, 2)), 8, axis=0)
        x = np.zeros((STEPS + 1, 2))
        for k in range(STEPS):
            x[k + 1] = real.system.step(x[None, k], u[None, k], real.values, DT)[0]
        x += 0.01 * rng.standard_normal(x.shape)
        trials.append(gr.Trial(x, u, DT, real.state_names, real.input_names))
    return gr.diagnose(fans(), trials)


def test_an_input_that_acts_on_another_axis_too_is_named(found):
    assert found.effects == ("crosstalk:yaw_rate<-u_pitch",)
    [row] = [row for row in found.ranking if row.effect == found.effects[0]]
    assert row.params["k"].value == pytest.approx(K, abs=3 * row.params["k"].std)
    assert row.params["k"].unit == "rad/s^2 per V"
    assert any("u_pitch also acts on yaw_rate" in one for one in found.verdict.causes)


def test_crosstalk_is_offered_where_the_model_has_no_such_path():
    names = {e.name for e in Library().candidates(fans()) if e.family.name == "crosstalk"}
    assert names == {"crosstalk:pitch_rate<-u_yaw", "crosstalk:yaw_rate<-u_pitch"}
    assert not any(e.family.name == "crosstalk" for e in Library().candidates(arm))
