"""Real systems whose authors published what a crude model of them lacks (../shared/data).

Each is a model as a user would write it, in a file, and the trials that its log holds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType

import numpy as np

from grounded.model import Model
from grounded.trial import Trial
from shared_data import data


@dataclass(frozen=True)
class RealSystem:
    """`text` is a model.py; `read` gives the trials."""

    text: str
    read: Callable[[], list[Trial]]

    @property
    def model(self) -> Model:
        """What the text defines."""
        module = ModuleType("model")
        exec(self.text, module.__dict__)
        return module.model


def _emps() -> list[Trial]:
    trials = []
    for name in ("emps_estimation", "emps_validation_pulses"):
        log = np.load(data("emps_prismatic_axis", f"{name}.npz"))
        q, u = log["q_m"], log["u_motor_V"]
        smooth = np.convolve(np.pad(q, 4, "edge"), np.ones(9) / 9, "valid")
        v = np.gradient(smooth, 1e-3)
        n = (len(q) - 1) // 10
        states = np.stack([q[::10][: n + 1], v[::10][: n + 1]], axis=1)
        inputs = u[: n * 10].reshape(n, 10).mean(axis=1)[:, None]
        trials.append(Trial(states, inputs, 0.01, ("q", "v"), ("u",), start_inputs=inputs[0]))
    return trials


def _servo() -> list[Trial]:
    log = np.load(data("hobby_servo_real_and_sim_twin", "servo_real_sim.npz"))
    trials = []
    for i in range(32):
        run = log[f"run{i:02d}"].astype(float)
        names = (("position",), ("command",))
        held = np.zeros(1)
        trials.append(Trial(run[:, 1:2], run[:-1, :1], 0.02, *names, start_inputs=held))
    return trials


def _dart_steering() -> list[Trial]:
    log = np.load(data("dart_small_car", "steering_sine_10Hz.npz"), allow_pickle=True)
    trials = []
    for i in range(11):
        run = log[f"run{i:02d}"].astype(float)
        on = np.flatnonzero(run[:, 6] > 0)
        run = run[on[0] + 8 : on[-1] - 4] if len(on) else run[:0]
        if len(run) >= 20:
            u = run[:-1, [8, 5]]
            names = (("w",), ("steering", "speed"))
            trials.append(Trial(run[:, [4]], u, 0.1, *names, start_inputs=u[0]))
    return trials


def _dart_throttle() -> list[Trial]:
    log = np.load(data("dart_small_car", "throttle_steps_rubber_10Hz.npz"), allow_pickle=True)
    trials = []
    for i in range(26):
        run = log[f"run{i:02d}"].astype(float)
        if not 0.19 < run[:, 7].max() < 0.36:
            continue
        on = np.flatnonzero(run[:, 7] > 0.01)
        run = run[max(on[0] - 5, 0) : on[-1]]
        names = (("v",), ("throttle",))
        trials.append(Trial(run[:, [5]], run[:-1, [7]], 0.1, *names, start_inputs=np.zeros(1)))
    return trials


# A motor and a ball screw without friction, 100 Hz (force averaged over a step).
EMPS = RealSystem(
    """from grounded import Model, Param

model = Model(
    name="emps",
    states={"q": "m", "v": "m/s"},
    inputs={"u": "V"},
    params={"M": Param(95.109, "kg", std=5.0), "g": Param(35.1507, "N/V")},
    derivative=lambda s, a, p: {"q": s.v, "v": p.g * a.u / p.M},
    roles={"position": ("q",), "speed": "v"},
)
""",
    _emps,
)

# A servo that goes where it is told within a few hundredths of a second; 50 Hz.
SERVO = RealSystem(
    """from grounded import Model, Param

model = Model(
    name="servo",
    states={"position": "1"},
    inputs={"command": "1"},
    params={"tau": Param(0.02, "s", 0.005, 0.2)},
    derivative=lambda s, a, p: {"position": (a.command - s.position) / p.tau},
)
""",
    _servo,
)

# Heading rate proportional to speed and steering at once; slow runs, 10 Hz. (k by least squares.)
DART_STEERING = RealSystem(
    """from grounded import Model, Param

model = Model(
    name="heading rate",
    states={"w": "rad/s"},
    inputs={"steering": "1", "speed": "m/s"},
    params={"k": Param(2.214, "rad/m", 1.0, 5.0)},
    step=lambda s, a, p, dt: {"w": p.k * a.speed * a.steering + 0 * s.w},
)
""",
    _dart_steering,
)

# A linear motor; straight runs at one throttle each, 10 Hz.
DART_THROTTLE = RealSystem(
    """from grounded import Model, Param

model = Model(
    name="motor",
    states={"v": "m/s"},
    inputs={"throttle": "1"},
    params={"a": Param(17.0, "m/s^2", 5.0, 50.0), "tau": Param(0.8, "s", 0.2, 3.0)},
    derivative=lambda s, a, p: {"v": p.a * a.throttle - s.v / p.tau},
    roles={"speed": "v"},
)
""",
    _dart_throttle,
)
