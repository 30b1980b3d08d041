"""Real systems whose authors published what their crude model lacks (../shared/data)."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from types import ModuleType

import numpy as np

from grounded.model import Model
from grounded.trial import Trial
from shared_data import data

Run = tuple[np.ndarray, np.ndarray]  # states (T + 1, n), inputs (T, m)


@dataclass(frozen=True)
class RealSystem:
    """A system: `text` is its model.py, `runs` yields its trials' states and inputs every dt [s].

    rests: whether its inputs were 0 before each run; else the first ones were held.
    """

    text: str
    dt: float
    runs: Callable[[], Iterable[Run]]
    rests: bool = False

    @property
    def model(self) -> Model:
        """The model that the text defines."""
        module = ModuleType("model")
        exec(self.text, module.__dict__)
        return module.model

    def read(self) -> list[Trial]:
        """Return its trials."""
        names = self.model.state_names, self.model.input_names
        return [
            Trial(x, u, self.dt, *names, start_inputs=np.zeros(u.shape[1]) if self.rests else u[0])
            for x, u in self.runs()
        ]


def _logged(folder: str, file: str) -> list[tuple[np.ndarray, np.ndarray | None]]:
    """Return each run of a file, rows (T, columns), and their times."""
    log = np.load(data(folder, f"{file}.npz"), allow_pickle=True)
    names = sorted(name for name in log.files if re.fullmatch(r"run\d\d", name))
    return [(log[name].astype(float), log.get(f"{name}_t")) for name in names]


def _emps() -> Iterator[Run]:
    for name in ("emps_estimation", "emps_validation_pulses"):
        log = np.load(data("emps_prismatic_axis", f"{name}.npz"))
        q, u = log["q_m"], log["u_motor_V"]
        smooth = np.convolve(np.pad(q, 4, "edge"), np.ones(9) / 9, "valid")
        v = np.gradient(smooth, 1e-3)
        n = (len(q) - 1) // 10
        states = np.stack([q[::10][: n + 1], v[::10][: n + 1]], axis=1)
        yield states, u[: n * 10].reshape(n, 10).mean(axis=1)[:, None]


def _servo() -> Iterator[Run]:
    for run, _ in _logged("hobby_servo_real_and_sim_twin", "servo_real_sim"):
        yield run[:, 1:2], run[:-1, :1]


def _dart_steered(name: str, most: int | None = None) -> Iterator[Run]:
    for run, _ in _logged("dart_small_car", name):
        on = np.flatnonzero(run[:, 6] > 0)
        run = run[on[0] + 8 : on[-1] - 4][:most] if len(on) else run[:0]
        if len(run) >= 20:
            yield run[:, [4]], run[:-1, [8, 5]]


def _dart_throttle() -> Iterator[Run]:
    for run, _ in _logged("dart_small_car", "throttle_steps_rubber_10Hz"):
        if 0.19 < run[:, 7].max() < 0.36:
            on = np.flatnonzero(run[:, 7] > 0.01)
            run = run[max(on[0] - 5, 0) : on[-1]]
            yield run[:, [5]], run[:-1, [7]]


def _resampled(t: np.ndarray, values: np.ndarray, dt: float, hold: bool = False) -> np.ndarray:
    """Resample columns at every dt, linearly or held."""
    at = np.arange(t[0], t[-1], dt)
    if hold:
        return values[np.searchsorted(t, at, side="right") - 1]
    return np.stack([np.interp(at, t, column) for column in values.T], axis=1)


def _bam(inputs: str, speed: bool = True) -> Iterator[Run]:
    """Yield runs with motor volts as input whose torque was never switched off.

    Or all runs with the servo's commands as inputs: goal, gain kp, torque_enable.
    """
    about = json.loads(data("bam_xl330_servo", "runs.json").read_text())
    gain = (4096 / (2 * np.pi)) / (256 * 885)
    for run, (rows, t) in zip(about, _logged("bam_xl330_servo", "bam_xl330_pendulum"), strict=True):
        x, told = _resampled(t, rows[:, :2], 0.01), _resampled(t, rows[:, 5:7], 0.01, hold=True)
        if inputs == "commands":
            kp = np.full(len(told), float(run["kp"]))
            yield x, np.column_stack([told[:, 0], kp, told[:, 1]])[:-1]
        elif run["trajectory"] != "lift_and_drop":
            duty = np.clip((rows[:, 5] - rows[:, 0]) * run["kp"] * gain, -1, 1)
            x[:, 1] = x[:, 1] if speed else np.nan
            yield x, _resampled(t, (duty * run["vin"])[:, None], 0.01)[:-1]


def _double(name: str, dt: float, most: int) -> Iterator[Run]:
    for rows, t in _logged("dfki_double_pendulum", name)[:most]:
        yield _resampled(t, rows[:, :4], dt), _resampled(t, rows[:, 4:6], dt, hold=True)[:-1]


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
    0.01,
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
    0.02,
    _servo,
    rests=True,
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
    0.1,
    partial(_dart_steered, "steering_sine_10Hz"),
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
    0.1,
    _dart_throttle,
    rests=True,
)

DART_STEPS = RealSystem(DART_STEERING.text, 0.1, partial(_dart_steered, "steering_steps_10Hz", 600))

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
BAM_Q = RealSystem(_BAM_TEXT, 0.01, partial(_bam, "volts", speed=False))
BAM_QW = RealSystem(_BAM_TEXT, 0.01, partial(_bam, "volts"))

# The same as a position servo, its goal in place of the volts; without torque its motor is open.
BAM_KP = RealSystem(
    _BAM_TEXT.replace(
        "    torque = p.kt / p.R * (a.volts - p.kt * s.w)\n",
        "    duty = np.clip((a.goal - s.q) * a.kp * 4096 / (2 * np.pi) / (256 * 885), -1, 1)\n"
        "    torque = a.torque_enable * p.kt / p.R * (7.4 * duty - p.kt * s.w)\n",
    ).replace('{"volts": "V"}', '{"goal": "rad", "kp": "1", "torque_enable": "1"}'),
    0.01,
    partial(_bam, "commands"),
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
ACROBOT = RealSystem(_DOUBLE_TEXT, 0.03, partial(_double, "acrobot_mcpilco", 0.03, 10))
SYSID = RealSystem(_DOUBLE_TEXT, 0.01, partial(_double, "sysid_C1", 0.01, 8))
