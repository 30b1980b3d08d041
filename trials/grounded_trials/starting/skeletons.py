"""The model skeletons: the simplest equations of each kind of robot, as the text of a model.py."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace


@dataclass(frozen=True)
class Skeleton:
    """A model as text: names with units, parameters, lines of equations."""

    kind: str
    text: str  # description, one line
    states: Mapping[str, str]
    inputs: Mapping[str, str]
    params: Mapping[str, str]  # name -> the arguments of Param
    lines: Sequence[str]  # `"state": expression` of ds/dt
    angles: tuple[str, ...] = ()
    roles: Mapping[str, object] = field(default_factory=dict)
    before: Sequence[str] = ()  # lines of code above the equations

    def source(self) -> str:
        """Return the text of model.py."""
        params = [f'        "{name}": Param({given}),' for name, given in self.params.items()]
        return "\n".join(
            [
                f'"""{self.text}.',
                "",
                "A skeleton written by `grounded init --from`: change it to match your robot.",
                '"""',
                "",
                "import numpy as np",
                "",
                "from grounded import Model, Param",
                "",
                "",
                "def dynamics(s, a, p):",
                '    """ds/dt."""',
                *(f"    {line}" for line in self.before),
                "    return {",
                *(f"        {line}," for line in self.lines),
                "    }",
                "",
                "",
                "# Param(value, unit) is a constant; `fit` may change one that has bounds.",
                "model = Model(",
                f'    name="{self.kind}",',
                f"    states={_dict(self.states)},",
                f"    inputs={_dict(self.inputs)},",
                "    params={",
                *params,
                "    },",
                f"    angles={self.angles!r},",
                f"    roles={dict(self.roles)!r},",
                "    derivative=dynamics,",
                ")",
                "",
            ]
        ).replace("import numpy as np\n\n", "import numpy as np\n\n" if self._numpy() else "")

    def _numpy(self) -> bool:
        return any("np." in line for line in (*self.lines, *self.before))


def _dict(units: Mapping[str, str]) -> str:
    inside = [f'"{name}": "{unit}"' for name, unit in units.items()]
    if len(inside) < 5:
        return "{" + ", ".join(inside) + "}"
    return "{\n" + "".join(f"        {one},\n" for one in inside) + "    }"


PLANE = {"position": ("x", "y"), "heading": "psi", "speed": "v"}
CAR = Skeleton(
    "car",
    "A kinematic car: rear axle at (x, y), speed v, steering without lag",
    {"v": "m/s", "x": "m", "y": "m", "psi": "rad"},
    {"steering": "rad", "speed": "m/s"},
    {
        "L": '0.3, "m", 0.1, 3.0',
        "tau": '0.3, "s", 0.02, 3.0',
        "gain": '1.0, "1", 0.2, 5.0',
        "trim": '0.0, "rad", -0.2, 0.2',
    },
    (
        '"v": (p.gain * a.speed - s.v) / p.tau',
        '"x": s.v * np.cos(s.psi)',
        '"y": s.v * np.sin(s.psi)',
        '"psi": s.v * np.tan(a.steering + p.trim) / p.L',
    ),
    ("psi",),
    PLANE,
)
ROVER = Skeleton(
    "rover",
    "A robot on two driven wheels: speed and turn rate follow their commands with a lag",
    {"v": "m/s", "omega": "rad/s", "x": "m", "y": "m", "psi": "rad"},
    {"speed": "m/s", "turn": "rad/s"},
    {"tau_v": '0.2, "s", 0.01, 2.0', "tau_w": '0.2, "s", 0.01, 2.0', "gain": '1.0, "1", 0.3, 2.0'},
    (
        '"v": (p.gain * a.speed - s.v) / p.tau_v',
        '"omega": (a.turn - s.omega) / p.tau_w',
        '"x": s.v * np.cos(s.psi)',
        '"y": s.v * np.sin(s.psi)',
        '"psi": s.omega',
    ),
    ("psi",),
    PLANE | {"heading_rate": "omega"},
)
DIFFERENTIAL = Skeleton(
    "differential",
    "A robot on two driven wheels, one command each: speed and turn rate follow with their lags",
    ROVER.states,
    {"left": "1", "right": "1"},
    {
        "gain": '1.0, "m/s", 0.02, 20.0',
        "track": '0.3, "m", 0.05, 2.0',
        **{"tau_v": ROVER.params["tau_v"], "tau_w": ROVER.params["tau_w"]},
    },
    (
        '"v": (p.gain * (a.right + a.left) / 2 - s.v) / p.tau_v',
        '"omega": (p.gain * (a.right - a.left) / p.track - s.omega) / p.tau_w',
        *ROVER.lines[2:],
    ),
    ROVER.angles,
    ROVER.roles,
)
BOAT = Skeleton(
    "boat",
    "A boat with a thruster on each side: u forwards, v to the left, r the turn rate, over ground",
    {"u": "m/s", "v": "m/s", "r": "rad/s", "x": "m", "y": "m", "psi": "rad"},
    {"left": "1", "right": "1"},
    {
        "push": '1.0, "m/s^2", 0.01, 50.0',
        "turn": '1.0, "rad/s^2", 0.01, 50.0',
        "drag_u": '0.5, "1/s", 0.0, 10.0',
        "drag_v": '1.0, "1/s", 0.0, 20.0',
        "drag_r": '1.0, "1/s", 0.0, 20.0',
    },
    (
        '"u": p.push * (a.right + a.left) / 2 - p.drag_u * s.u + s.v * s.r',
        '"v": -p.drag_v * s.v - s.u * s.r',
        '"r": p.turn * (a.right - a.left) / 2 - p.drag_r * s.r',
        '"x": s.u * np.cos(s.psi) - s.v * np.sin(s.psi)',
        '"y": s.u * np.sin(s.psi) + s.v * np.cos(s.psi)',
        '"psi": s.r',
    ),
    ("psi",),
    {"position": ("x", "y"), "heading": "psi", "speed": "u", "heading_rate": "r"},
)
DRONE = Skeleton(
    "drone",
    "A hovering drone: attitude follows its commands with a lag, thrust acts along its axis",
    {
        **dict.fromkeys("xyz", "m"),
        **{f"v{axis}": "m/s" for axis in "xyz"},
        **{"roll": "rad", "pitch": "rad"},
    },
    {"roll_command": "rad", "pitch_command": "rad", "thrust": "1"},
    {
        "g": '9.81, "m/s^2"',
        "hover": '0.5, "1", 0.1, 1.0',
        "tau": '0.15, "s", 0.02, 1.0',
        "drag": '0.2, "1/s", 0.0, 2.0',
    },
    (
        '"x": s.vx',
        '"y": s.vy',
        '"z": s.vz',
        '"vx": lift * (ahead * np.cos(yaw) - left * np.sin(yaw)) - p.drag * s.vx',
        '"vy": lift * (ahead * np.sin(yaw) + left * np.cos(yaw)) - p.drag * s.vy',
        '"vz": lift * np.cos(s.roll) * np.cos(s.pitch) - p.g - p.drag * s.vz',
        '"roll": (a.roll_command - s.roll) / p.tau',
        '"pitch": (a.pitch_command - s.pitch) / p.tau',
    ),
    (),
    {"position": ("x", "y", "z")},
    before=(
        "lift = p.g * a.thrust / p.hover  # acceleration along the drone's own axis",
        "ahead, left = np.sin(s.pitch) * np.cos(s.roll), -np.sin(s.roll)  # its part in the plane",
        "yaw = p.yaw",
    ),
)
STEADY = 0.3  # rad: if the yaw changes less than this in a log, it is a constant of the skeleton


def drone(low: float, high: float, command: str) -> Skeleton:
    """Return the drone's skeleton for the yaw of a log.

    Args:
        low: smallest yaw in the log [rad].
        high: largest yaw in the log [rad].
        command: what the log has as its command: `yaw_command` [rad], `yaw_rate` [rad/s] or "".
    """
    if high - low < STEADY:
        given = f'{(low + high) / 2:.3g}, "rad"'
        return replace(DRONE, params={**DRONE.params, "yaw": given})
    params, line = DRONE.params, '"yaw": a.yaw_rate'
    if command == "yaw_command":
        params = {**params, "tau_yaw": '0.5, "s", 0.02, 5.0'}
        line = '"yaw": np.arctan2(np.sin(turn), np.cos(turn)) / p.tau_yaw'
    turn = ("turn = a.yaw_command - s.yaw",) * (command == "yaw_command")
    return replace(
        DRONE,
        states={**DRONE.states, "yaw": "rad"},
        inputs={**DRONE.inputs, command or "yaw_rate": "rad" if turn else "rad/s"},
        params=params,
        lines=(*DRONE.lines, line),
        angles=("yaw",),
        before=(*DRONE.before[:-1], "yaw = s.yaw", *turn),
    )


PENDULUM = Skeleton(
    "pendulum",
    "One joint under gravity, theta = 0 hanging down",
    {"theta": "rad", "omega": "rad/s"},
    {"torque": "N m"},
    {
        "inertia": '0.1, "kg m^2", 0.0001, 10.0',
        "damping": '0.01, "N m s", 0.0, 5.0',
        "weight": '0.5, "N m", 0.0, 50.0',
    },
    (
        '"theta": s.omega',
        '"omega": (a.torque - p.damping * s.omega - p.weight * np.sin(s.theta)) / p.inertia',
    ),
    roles={"hanging": "theta"},
)


BALANCE = Skeleton(
    "balance",
    "A robot balancing on two wheels: pitch = 0 upright, forwards > 0; enter its masses",
    {"x": "m", "v": "m/s", "pitch": "rad", "pitch_rate": "rad/s"},
    {"voltage": "V"},
    {
        "body": '1.0, "kg"',  # to be weighed: motion identifies only ratios of masses and torques
        "wheels": '0.15, "kg"',  # 1.5 times their mass, to include their rotational inertia
        "l": '0.1, "m", 0.01, 1.0',
        "I": '0.005, "kg m^2", 0.00001, 5.0',
        "r": '0.035, "m"',
        "kt": '0.05, "N m/V", 0.0001, 5.0',
        "ke": '0.3, "V s/rad", 0.0, 5.0',
        "g": '9.81, "m/s^2"',
    },
    (
        '"x": s.v',
        '"v": (inertia * push - coupled * fall) / det',
        '"pitch": s.pitch_rate',
        '"pitch_rate": (mass * fall - coupled * push) / det',
    ),
    ("pitch",),
    {"rail": "x", "upright": ("pitch",), "speed": "v"},
    before=(
        "torque = p.kt * (a.voltage - p.ke * (s.v / p.r - s.pitch_rate))  # of both motors",
        "mass, inertia = p.body + p.wheels, p.I + p.body * p.l**2  # l: axle to body's centre",
        "coupled = p.body * p.l * np.cos(s.pitch)",
        "push = torque / p.r + p.body * p.l * np.sin(s.pitch) * s.pitch_rate**2",
        "fall = p.body * p.g * p.l * np.sin(s.pitch) - torque  # I: of the body about its centre",
        "det = mass * inertia - coupled**2",
    ),
)


def against_the_body(plain: Skeleton) -> Skeleton:
    """Return the balancing robot as encoders see it: wheels turn against the body, which leans."""
    old, new = "coupled * fall) / det", "coupled * fall) / det - p.r * turn"
    lines = [line.replace(old, new) for line in plain.lines]
    lines[-1] = '"pitch_rate": turn'
    before = [line.replace("s.v / p.r - s.pitch_rate", "s.v / p.r") for line in plain.before]
    before.append("turn = (mass * fall - coupled * push) / det")
    text = "A robot balancing on two wheels, x and v by their encoders; enter its masses"
    return replace(plain, text=text, lines=lines, before=before)


CRANE = Skeleton(
    "crane",
    "A trolley on a rail with a load below it at x + L sin(theta): theta = 0 hanging down",
    {"x": "m", "v": "m/s", "theta": "rad", "omega": "rad/s"},
    {"force": "N"},
    {
        "gain": '0.5, "m/s^2/N", 0.001, 100.0',  # without the load
        "damping": '0.5, "1/s", 0.0, 50.0',
        "ratio": '0.3, "1", 0.0, 10.0',
        "L": '1.0, "m", 0.05, 20.0',
        "g": '9.81, "m/s^2"',  # -9.81 makes it a pole on a cart, theta = 0 upright
    },
    (
        '"x": s.v',
        '"v": acc',
        '"theta": s.omega',
        '"omega": -(acc * cs + p.g * sn) / p.L',
    ),
    ("theta",),
    {"rail": "x", "hanging": ("theta",)},
    before=(
        "sn, cs = np.sin(s.theta), np.cos(s.theta)",
        "pull = p.ratio * sn * (p.L * s.omega**2 + p.g * cs)  # ratio: mass of load / trolley",
        "acc = (p.gain * a.force - p.damping * s.v + pull) / (1 + p.ratio * sn**2)",
    ),
)


def arm(joints: Sequence[str]) -> Skeleton:
    """Return an arm with uncoupled joints and their names, in order from the base."""
    short = [re.sub(r"_?joint_?", "", joint) or joint for joint in joints]
    distinct = len(set(short)) == len(joints)
    bare = [re.sub(r"\W+", "_", joint).strip("_") for joint in (short if distinct else joints)]
    names = [name if name.isidentifier() else f"joint{i}" for i, name in enumerate(bare, start=1)]
    return Skeleton(
        "arm",
        f"An arm of {len(names)} uncoupled joints: replace them by its inertia matrix",
        {f"{n}_position": "rad" for n in names} | {f"{n}_velocity": "rad/s" for n in names},
        {f"{n}_effort": "N m" for n in names},
        {f"inertia_{n}": '0.1, "kg m^2", 0.0001, 10.0' for n in names}
        | {f"b_{n}": '0.1, "N m s", 0.0, 10.0' for n in names},
        [
            *(f'"{n}_position": s.{n}_velocity' for n in names),
            *(
                f'"{n}_velocity": (a.{n}_effort - p.b_{n} * s.{n}_velocity) / p.inertia_{n}'
                for n in names
            ),
        ],
        roles={"level": tuple(f"{n}_position" for n in names)},
    )
