"""An input that acts on a state without a path in the model, seen on a helicopter with two fans."""

import grounded as gr
from grounded.effects import Library
from grounded.models.arm import model as arm


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


def test_crosstalk_is_offered_where_the_model_has_no_such_path():
    names = {e.name for e in Library().candidates(fans()) if e.family.name == "crosstalk"}
    assert names == {"crosstalk:pitch_rate<-u_yaw", "crosstalk:yaw_rate<-u_pitch"}
    assert not any(e.family.name == "crosstalk" for e in Library().candidates(arm))
