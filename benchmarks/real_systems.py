"""Real systems whose authors published what their crude model lacks (../shared/data)."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType

import numpy as np

from grounded.model import Model
from grounded.trial import Trial
from shared_data import data


@dataclass(frozen=True)
class RealSystem:
    """A system: `text` is its model.py, `read` returns its trials."""

    text: str
    read: Callable[[], list[Trial]]

    @property
    def model(self) -> Model:
        """The model that the text defines."""
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


def _dart_steered(name: str, most: int | None = None) -> Callable[[], list[Trial]]:
    def read() -> list[Trial]:
        log = np.load(data("dart_small_car", f"{name}.npz"), allow_pickle=True)
        trials = []
        for i in range(11):
            run = log[f"run{i:02d}"].astype(float)
            on = np.flatnonzero(run[:, 6] > 0)
            run = run[on[0] + 8 : on[-1] - 4][:most] if len(on) else run[:0]
            if len(run) >= 20:
                u = run[:-1, [8, 5]]
                names = (("w",), ("steering", "speed"))
                trials.append(Trial(run[:, [4]], u, 0.1, *names, start_inputs=u[0]))
        return trials

    return read


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


def _resampled(t: np.ndarray, values: np.ndarray, dt: float, hold: bool = False) -> np.ndarray:
    """Resample columns at every dt, linearly or held."""
    at = np.arange(t[0], t[-1], dt)
    if hold:
        return values[np.searchsorted(t, at, side="right") - 1]
    return np.stack([np.interp(at, t, column) for column in values.T], axis=1)


def _bam(speed: bool) -> Callable[[], list[Trial]]:
    """Read the runs with motor volts as input whose torque was never switched off."""

    def read() -> list[Trial]:
        log = np.load(data("bam_xl330_servo", "bam_xl330_pendulum.npz"))
        about = json.loads(data("bam_xl330_servo", "runs.json").read_text())
        gain, trials = (4096 / (2 * np.pi)) / (256 * 885), []
        for i, run in enumerate(about):
            rows, t = log[f"run{i:02d}"].astype(float), log[f"run{i:02d}_t"]
            if run["trajectory"] == "lift_and_drop":
                continue
            duty = np.clip((rows[:, 5] - rows[:, 0]) * run["kp"] * gain, -1, 1)
            u = _resampled(t, (duty * run["vin"])[:, None], 0.01)
            x = _resampled(t, rows[:, :2], 0.01)
            x[:, 1] = x[:, 1] if speed else np.nan
            names = (("q", "w"), ("volts",))
            trials.append(Trial(x, u[:-1], 0.01, *names, start_inputs=u[0]))
        return trials

    return read


def _bam_servo() -> list[Trial]:
    """Read all runs with the servo's commands as inputs: goal, gain kp, torque_enable."""
    log = np.load(data("bam_xl330_servo", "bam_xl330_pendulum.npz"))
    about = json.loads(data("bam_xl330_servo", "runs.json").read_text())
    trials = []
    for i, run in enumerate(about):
        rows, t = log[f"run{i:02d}"].astype(float), log[f"run{i:02d}_t"]
        x, told = _resampled(t, rows[:, :2], 0.01), _resampled(t, rows[:, 5:7], 0.01, hold=True)
        u = np.column_stack([told[:, 0], np.full(len(told), float(run["kp"])), told[:, 1]])
        names = (("q", "w"), ("goal", "kp", "torque_enable"))
        trials.append(Trial(x, u[:-1], 0.01, *names, start_inputs=u[0]))
    return trials


def _double(name: str, dt: float, most: int) -> Callable[[], list[Trial]]:
    def read() -> list[Trial]:
        log = np.load(data("dfki_double_pendulum", f"{name}.npz"), allow_pickle=True)
        trials = []
        for i in range(len(log["files"]))[:most]:
            rows, t = log[f"run{i:02d}"].astype(float), log[f"run{i:02d}_t"]
            x, u = _resampled(t, rows[:, :4], dt), _resampled(t, rows[:, 4:6], dt, hold=True)
            names = (("q1", "q2", "w1", "w2"), ("tau1", "tau2"))
            trials.append(Trial(x, u[:-1], dt, *names, start_inputs=u[0]))
        return trials

    return read


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

# A servo that reaches its command within a few hundredths of a second; 50 Hz.
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
    _dart_steered("steering_sine_10Hz"),
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

DART_STEPS = RealSystem(DART_STEERING.text, _dart_steered("steering_steps_10Hz", 600))

# A geared motor with back electromotive force that swings a mass; no friction.
_BAM_TEXT = """import numpy as np

from grounded import Model, Param


def swing(s, a, p):
    torque = p.kt / p.R * (a.volts - p.kt * s.w)
    inertia = p.mass * p.l**2 + p.armature
    return {"q": s.w, "w": (torque - p.mass * 9.81 * p.l * np.sin(s.q)) / inertia}


model = Model(
    name="servo pendulum",
    states={"q": "rad", "w": "rad/s"},
    inputs={"volts": "V"},
    params={
        "kt": Param(0.39, "N m/A", std=0.05),
        "R": Param(4.0, "Ohm"),
        "armature": Param(0.0018, "kg m^2", 0.0005, 0.006),
        "mass": Param(0.49, "kg"),
        "l": Param(0.1, "m", std=0.01),
    },
    roles={"position": ("q",), "speed": "w"},
    derivative=swing,
    substeps=2,
)
"""
BAM_Q = RealSystem(_BAM_TEXT, _bam(speed=False))
BAM_QW = RealSystem(_BAM_TEXT, _bam(speed=True))

# The same as a position servo, its goal in place of the volts; without torque its motor is open.
BAM_KP = RealSystem(
    _BAM_TEXT.replace(
        "    torque = p.kt / p.R * (a.volts - p.kt * s.w)\n",
        "    duty = np.clip((a.goal - s.q) * a.kp * 4096 / (2 * np.pi) / (256 * 885), -1, 1)\n"
        "    torque = a.torque_enable * p.kt / p.R * (7.4 * duty - p.kt * s.w)\n",
    ).replace('{"volts": "V"}', '{"goal": "rad", "kp": "1", "torque_enable": "1"}'),
    _bam_servo,
)

# Two links, relative elbow angle, no friction; numbers of the authors' model 1.0 of design C.1.
_DOUBLE_TEXT = """import numpy as np

from grounded import Model, Param


def swing(s, a, p):
    c, h = np.cos(s.q2), p.m2 * 0.2 * p.r2
    M11, M12 = p.I1 + p.I2 + p.m2 * 0.04 + 2 * h * c, p.I2 + h * c
    bend = h * np.sin(s.q2)
    low = 9.81 * p.m2 * p.r2 * np.sin(s.q1 + s.q2)
    t1 = a.tau1 + bend * (2 * s.w1 * s.w2 + s.w2**2)
    t1 = t1 - 9.81 * (p.m1 * p.r1 + p.m2 * 0.2) * np.sin(s.q1) - low
    t2 = a.tau2 - bend * s.w1**2 - low
    det = M11 * p.I2 - M12**2
    return {
        "q1": s.w1,
        "q2": s.w2,
        "w1": (p.I2 * t1 - M12 * t2) / det,
        "w2": (M11 * t2 - M12 * t1) / det,
    }


model = Model(
    name="double pendulum",
    states={"q1": "rad", "q2": "rad", "w1": "rad/s", "w2": "rad/s"},
    inputs={"tau1": "N m", "tau2": "N m"},
    params={
        "m1": Param(0.523, "kg"),
        "m2": Param(0.626, "kg"),
        "r1": Param(0.2, "m", std=0.02),
        "r2": Param(0.256, "m", std=0.025),
        "I1": Param(0.0319, "kg m^2", std=0.004),
        "I2": Param(0.0509, "kg m^2", std=0.005),
    },
    derivative=swing,
    substeps=2,
)
"""
ACROBOT = RealSystem(_DOUBLE_TEXT, _double("acrobot_mcpilco", 0.03, 10))
SYSID = RealSystem(_DOUBLE_TEXT, _double("sysid_C1", 0.01, 8))
