"""A simulated REAL car, with effects for which the crude model `grounded.models.car` has no terms.

They are declared only here; neither the model nor the search nor the diagnosis may import it. They
are those that the paper suspects (section 5.2): calibration errors of 6 to 20 %, an asymmetric
carpet that makes the car drift 0.1 m per circle of 1 m and changes yaw, speed and the stalling
speed with the heading, understeer, a servo that saturates softly, and a latency beyond the modelled
0.1 s.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from grounded.model import Model, Param
from grounded.models import car
from grounded.plant import Noise, Plant

CALIBRATION = {  # true value / the crude model's
    "a1": 0.90,
    "a2": 0.92,
    "a3": 1.20,
    "b2": 1.10,
    "a4": 0.85,
    "tau_delta": 1.20,
    "tau_v": 1.15,
    "L": 1.06,
    "stall": 1.10,  # the stalled range is wider
}
UNMODELLED = {
    "steering_offset": Param(0.015, "rad"),  # b1, calibrated to zero
    "cubic": Param(0.12, "1"),  # steering u - cubic u^3
    "understeer": Param(0.035, "s^2/m^2"),  # psi' / (1 + understeer v^2)
    "drift": Param(0.016, "1"),  # sideways along the thread per metre driven
    "thread": Param(0.6, "rad"),  # direction of the threading
    "thread_yaw": Param(0.05, "1/m"),  # psi' += thread_yaw v sin(2 (psi - thread))
    "thread_speed": Param(0.05, "1"),  # v_ss (1 - thread_speed sin^2(psi - thread))
    "thread_stall": Param(0.02, "1"),  # stall + thread_stall sin^2(psi - thread)
}
LATENCY = {"steering": 0.12, "throttle": 0.13}  # [s]; the model has 0.1
SCATTER = Noise(
    start={"x": 0.005, "y": 0.005, "psi": 0.01},
    process={"v": 0.004, "psi": 0.002},
    measurement={"x": 0.002, "y": 0.002, "psi": 0.004, "v": 0.01, "delta": 0.005, "psi_rate": 0.03},
)


def dynamics(s: Any, a: Any, p: Any) -> dict[str, Any]:
    """Return ds/dt of the real car."""
    across = np.sin(s.psi - p.thread) ** 2
    throttle = np.where(a.throttle > p.stall + p.thread_stall * across, a.throttle, 0.0)
    bent = a.steering - p.cubic * a.steering**3
    delta_ss = p.a1 * bent + p.steering_offset
    v_ss = p.a2 * throttle + p.a3 * np.abs(a.steering) + p.b2
    v_ss = np.maximum(v_ss * (1 - p.thread_speed * across), 0.0)
    delta_dot = (delta_ss - s.delta) / p.tau_delta
    braking = np.maximum((v_ss - s.v) / car.TAU_BRAKE, p.a4)
    v_dot = np.where(v_ss >= s.v, (v_ss - s.v) / p.tau_v, braking)
    grip = 1 / (p.L * (1 + p.understeer * s.v**2))
    twice = 2 * (s.psi - p.thread)
    yaw = s.v * np.sin(s.delta) * grip + p.thread_yaw * s.v * np.sin(twice)
    slide = p.drift * s.v * np.cos(s.psi - p.thread)
    rear = s.v * np.cos(s.delta)
    # a gyro shows the full yaw rate, carpet and understeer included: its derivative by chain rule
    yaw_dot = s.v * np.cos(s.delta) * delta_dot * grip
    yaw_dot += v_dot * np.sin(s.delta) * grip * (1 - 2 * p.understeer * s.v**2 * grip * p.L)
    yaw_dot += p.thread_yaw * (v_dot * np.sin(twice) + 2 * s.v * np.cos(twice) * yaw)
    return {
        "delta": delta_dot,
        "v": v_dot,
        "x": rear * np.cos(s.psi) - slide * np.sin(p.thread),
        "y": rear * np.sin(s.psi) + slide * np.cos(p.thread),
        "psi": yaw,
        "psi_rate": yaw_dot,
    }


def real_car() -> Model:
    """Return the true dynamics."""
    params = {
        name: Param(param.value * CALIBRATION.get(name, 1.0), param.unit)
        for name, param in car.model.params.items()
    }
    return replace(car.model, name="real car", params={**params, **UNMODELLED}, derivative=dynamics)


def real_plant(noisy: bool = False) -> Plant:
    """Return the simulated real car as a plant, deterministic unless `noisy`."""
    return Plant(model=real_car(), latency=LATENCY, noise=SCATTER if noisy else Noise())
