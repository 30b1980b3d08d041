"""The RC car of section 5.2: a kinematic car with lagged steering and a one-sided speed response.

    delta_ss = a1 u1 + b1,                      delta' = (delta_ss - delta) / tau_delta
    v_ss     = a2 u2 + a3 |u1| + b2
    v'       = (v_ss - v) / tau_v  where v_ss >= v,  a4 where v_ss < v
    psi'     = v sin(delta) / L

delta is the steering angle, v the speed of the FRONT wheels, (x, y) the middle of the rear axle,
psi the heading; u1 is the steering and u2 the throttle, both in [-1, 1]. The heading rate is the
sixth state, so that it can be tracked and measured: it starts at v sin(delta) / L and is integrated
by the chain rule.

Two details of footnote 17 and one of physics:
  - the motor stalls: a throttle below `stall` acts as zero;
  - braking at a4 ends at v_ss and does not cross it: near v_ss, a4 is replaced by a short
    first-order response (TAU_BRAKE), without which v chatters around v_ss at any finite step;
  - a car that is not driven stands still (v_ss >= 0): friction does not push it backwards.
The latency of 0.1 s from input to camera belongs to the task (`latency`), as a queue in the state.

The values are not fitted to a particular car, but in the range of the XRAY M18's (section 5.2).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from grounded.model import Model, Param

TAU_BRAKE = 0.05  # [s]


def dynamics(s: Any, a: Any, p: Any) -> dict[str, Any]:
    """Return ds/dt (section 5.2)."""
    throttle = np.where(a.throttle > p.stall, a.throttle, 0.0)
    delta_ss = p.a1 * a.steering + p.b1
    v_ss = np.maximum(p.a2 * throttle + p.a3 * np.abs(a.steering) + p.b2, 0.0)
    delta_dot = (delta_ss - s.delta) / p.tau_delta
    braking = np.maximum((v_ss - s.v) / TAU_BRAKE, p.a4)
    v_dot = np.where(v_ss >= s.v, (v_ss - s.v) / p.tau_v, braking)
    return {
        "delta": delta_dot,
        "v": v_dot,
        "x": s.v * np.cos(s.delta) * np.cos(s.psi),
        "y": s.v * np.cos(s.delta) * np.sin(s.psi),
        "psi": s.v * np.sin(s.delta) / p.L,
        "psi_rate": (v_dot * np.sin(s.delta) + s.v * np.cos(s.delta) * delta_dot) / p.L,
    }


model = Model(
    name="car",
    states={"delta": "rad", "v": "m/s", "x": "m", "y": "m", "psi": "rad", "psi_rate": "rad/s"},
    inputs={"steering": "1", "throttle": "1"},
    params={
        "a1": Param(0.45, "rad", 0.1, 1.0),
        "b1": Param(0.0, "rad", -0.2, 0.2),
        "a2": Param(3.0, "m/s", 0.5, 10.0),
        "a3": Param(-0.5, "m/s", -2.0, 0.5),
        "b2": Param(-0.3, "m/s", -2.0, 1.0),
        "a4": Param(-1.0, "m/s^2", -5.0, -0.1),
        "tau_delta": Param(0.1, "s", 0.01, 1.0),
        "tau_v": Param(0.4, "s", 0.05, 3.0),
        "L": Param(0.15, "m", 0.05, 0.6),
        "stall": Param(0.18, "1", 0.0, 0.5),
    },
    angles=("psi",),
    roles={
        "position": ("x", "y"),
        "heading": "psi",
        "speed": "v",
        "steering_angle": "delta",
        "heading_rate": "psi_rate",
    },
    derivative=dynamics,
)
