"""Mechanisms in MuJoCo, and the crude models that plan for them.

The crude models of the cart-pole and the two-link arm are their equations of motion in plain NumPy
(`grounded.models`), with the simulator's masses and lengths, so that only what a set-up withholds
differs.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.foreign.robots import Robot, minimum_jerk, task_of, with_true_model
from grounded.model import Model
from grounded.models import arm, cart_pole
from grounded.task import Task


class MujocoRobot:
    """MuJoCo, stepped as users do: it keeps its warm start, its time and its contacts."""

    def __init__(self, xml: Any, start: np.ndarray, columns: list[int] | None = None) -> None:
        import mujoco

        self.mj = mujoco
        self.model = mujoco.MjModel.from_xml_string(xml) if isinstance(xml, str) else xml
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET.value
        mujoco.set_mju_user_warning(lambda _: None)  # or a file MUJOCO_LOG.TXT appears
        self.data = mujoco.MjData(self.model)
        self.start = start
        self.columns = slice(None) if columns is None else columns
        self.timestep = float(self.model.opt.timestep)

    def reset(self) -> None:
        self.mj.mj_resetData(self.model, self.data)
        whole = np.concatenate([self.data.qpos, self.data.qvel])
        whole[self.columns] = self.start
        self.data.qpos[:], self.data.qvel[:] = np.split(whole, [self.model.nq])
        self.mj.mj_forward(self.model, self.data)

    def measure(self) -> np.ndarray:
        return np.concatenate([self.data.qpos, self.data.qvel])[self.columns]

    def advance(self, u: np.ndarray) -> None:
        self.data.ctrl[:] = u
        self.mj.mj_step(self.model, self.data)


def mujoco_setup(task: Task, xml: Any, delay: float = 0.0) -> tuple[Robot, Task]:
    """Return the robot of an XML, and the task planned in the same XML."""
    from grounded.adapters import mujoco

    truth = with_true_model(task, mujoco.model(xml), delay)
    return Robot(MujocoRobot(xml, np.asarray(task.start)), delay), truth


# Cart-pole: from hanging to upright in three or four seconds.

END = {"x": 100.0, "theta": 100.0, "x_vel": 10.0, "theta_vel": 10.0}
CART_TASKS = {  # steps, limit [N], weights
    "gentle": (
        150, 12.0,
        {
            "state": {"x": 0.05, "theta": 0.05, "x_vel": 0.002, "theta_vel": 0.002},
            "terminal": {"x": 50.0, "theta": 100.0, "x_vel": 10.0, "theta_vel": 10.0},
            "input": 0.02,
        },
    ),
    "smooth": (200, 30.0, {"state": {"theta": 0.1}, "terminal": END, "input": 0.01, "change": 0.1}),
}  # fmt: skip


def cart_task(kind: str) -> Task:
    """Return the task from hanging to upright at the origin, with every target column given.

    "gentle" is solved from the first guess; "smooth" has a first guess from which 100 iterations
    are not enough, though zero inputs are a good start.
    """
    H, limit, weights = CART_TASKS[kind]
    start = np.array([0.0, np.pi, 0.0, 0.0])
    return task_of(cart_pole.model, 0.02, np.zeros((H + 1, 4)), start, limit, **weights)


# Two-link arm in the vertical plane: a reach of 0.8 s, then hold.


def arm_task() -> Task:
    start, end = np.array([-1.4, 0.3]), np.array([0.5, 1.0])
    t = 0.02 * np.arange(61)
    target = np.hstack([minimum_jerk(start, end, t / 0.8), np.full((61, 2), np.nan)])
    return task_of(
        arm.model,
        0.02,
        target,
        np.append(start, [0.0, 0.0]),
        40.0,
        state={"q1": 20.0, "q2": 20.0},
        terminal={"q1": 50.0, "q2": 50.0},
        input=2e-5,
        change=2e-4,
        past=holding(arm.model, start),
    )


def holding(model: Model, q: np.ndarray, dt: float = 0.005) -> np.ndarray:
    """Return the torques that hold an arm still for `dt` (accelerations are linear in them)."""
    n, m = model.n, model.m
    x = np.append(q, np.zeros(n - m))[None]
    at = lambda u: model.system.step(x, u[None], model.values, dt)[0, m:]  # noqa: E731
    free = at(np.zeros(m))
    return np.linalg.solve(np.column_stack([at(e) - free for e in np.eye(m)]), -free)


# Systems that others ship as MJCF: the file is the crude model, and what is withheld is changed in
# a copy of it. Each moves some joints from rest to rest, and the others stay or swing.


@dataclass(frozen=True)
class Shipped:
    """A file of a package, and a motion by joint: (from, to); `held`: weights of other states.

    The other fields say how large what is withheld is: dry friction of a joint, a body's mass as a
    factor or, without one in the file, in kg.
    """

    file: str
    dt: float  # [s]
    steps: int
    motion: Mapping[str, tuple[float, float]]
    friction: tuple[str, float]
    payload: tuple[str, float]
    held: Mapping[str, float] = field(default_factory=dict)
    start: Mapping[str, float] = field(default_factory=dict)
    holds: bool = False  # whether gravity must be held before the start

    @property
    def path(self) -> Path:
        """Where the file is; ImportError if its package is not installed."""
        package, _, rest = self.file.partition("/")
        spec = importlib.util.find_spec(package)
        if spec is None or not spec.submodule_search_locations:
            raise ImportError(f"No module named '{package}'")
        return Path(spec.submodule_search_locations[0], rest)


ARMS, GYM, SUITE = (
    "robosuite/models/assets/robots/",
    "gymnasium/envs/mujoco/assets/",
    "dm_control/suite/",
)
SHIPPED = {
    "ur5e": Shipped(
        ARMS + "ur5e/robot.xml", 0.02, 60,
        {
            "shoulder_pan_joint": (0.0, 0.5), "shoulder_lift_joint": (-1.2, -0.9),
            "elbow_joint": (1.5, 1.1), "wrist_1_joint": (-0.3, 0.0),
            "wrist_2_joint": (0.5, 0.2), "wrist_3_joint": (0.0, 0.4),
        },
        ("shoulder_lift_joint", 8.0), ("right_hand", 1.5), holds=True,
    ),
    "panda": Shipped(
        ARMS + "panda/robot.xml", 0.02, 60,
        {
            "joint1": (0.0, 0.4), "joint2": (0.2, 0.5), "joint3": (0.0, -0.3),
            "joint4": (-1.8, -1.3), "joint5": (0.0, 0.3), "joint6": (2.0, 1.7),
            "joint7": (0.5, 0.9),
        },
        ("joint2", 4.0), ("right_hand", 3.0), holds=True,
    ),
    "reacher": Shipped(
        GYM + "reacher.xml", 0.02, 60, {"joint0": (0.0, 1.0), "joint1": (0.0, 0.8)},
        ("joint0", 5.0), ("body1", 20.0),
    ),
    "swimmer": Shipped(
        GYM + "swimmer.xml", 0.04, 60, {"motor1_rot": (0.0, 0.8), "motor2_rot": (0.0, -0.8)},
        ("motor1_rot", 6.0), ("back", 1.3),
    ),
    "pendulum": Shipped(
        GYM + "inverted_pendulum.xml", 0.04, 60, {"slider": (0.0, 0.4)},
        ("slider", 8.0), ("pole", 1.3), {"hinge": 5.0},
    ),
    "double-pendulum": Shipped(
        GYM + "inverted_double_pendulum.xml", 0.02, 100, {"slider": (0.0, 0.4)},
        ("slider", 8.0), ("pole", 1.36), {"hinge": 5.0, "hinge2": 5.0},
    ),
    "acrobot": Shipped(
        SUITE + "acrobot.xml", 0.02, 100, {"elbow": (0.0, 0.3)},
        ("elbow", 0.3), ("lower_arm", 1.3), {"shoulder": 1.0}, {"shoulder": np.pi},
    ),
    "ball-in-cup": Shipped(
        SUITE + "ball_in_cup.xml", 0.02, 60, {"cup_x": (0.0, 0.12), "cup_z": (0.0, 0.05)},
        ("cup_x", 0.4), ("ball", 1.5), {"ball_x": 1.0}, {"ball_z": -0.009},
    ),
}  # fmt: skip


def shipped_task(system: str) -> Task:
    """Return the task of a shipped system; its crude model has the payload's mass uncertain."""
    from grounded.adapters import mujoco

    one = SHIPPED[system]
    compiled = mujoco.load(one.path)
    body, factor = one.payload
    mass = float(compiled.body(body).mass[0])
    given = {
        f"{body}.mass": (mass, 0.2 * mass, 2.0 * max(factor, 2.0) * mass)
        if mass
        else (0.0, 0.0, 2.0 * factor)
    }
    model = mujoco.model(one.path, params=given, without="unmoved")
    names, part = model.state_names, one.dt * np.arange(one.steps + 1) / (0.7 * one.dt * one.steps)
    ends = [{name: at[k] for name, at in one.motion.items()} for k in (0, 1)]
    begin, end = (np.array([{**one.start, **e}.get(n, 0.0) for n in names]) for e in ends)
    target = minimum_jerk(begin, end, part)
    weights = dict.fromkeys(one.motion, 20.0) | dict(one.held)
    target[:, [name not in weights for name in names]] = np.nan
    high = np.array([mujoco.limits(one.path)[name][1] for name in model.input_names])
    return task_of(
        model,
        one.dt,
        target,
        begin,
        high,
        state=weights,
        input=(2e-2 / high**2).tolist(),
        change=(2e-1 / high**2).tolist(),
        past=holding(model, begin[: model.m], 0.002) if one.holds else None,
    )


def shipped_model(
    system: str,
    friction: float = 0.0,
    gear: float = 1.0,
    payload: float = 0.0,
    lag: float = 0.0,
    mixed: float = 0.0,
) -> Any:
    """Return the compiled file with what is withheld.

    Args:
        system: its name in SHIPPED.
        friction: share of the system's dry friction.
        gear: factor on the gear of the first motor.
        payload: share of the system's payload.
        lag: time constant of the motors [s].
        mixed: share of the first motor's force that reaches the second motor's joint.
    """
    import mujoco as mj

    one = SHIPPED[system]
    spec = mj.MjSpec.from_file(str(one.path))
    joint, loss = one.friction
    spec.joint(joint).frictionloss += friction * loss
    motors = spec.actuators
    motors[0].gear = np.array(motors[0].gear) * gear
    for motor in motors if lag else ():
        motor.dyntype, motor.dynprm[0] = mj.mjtDyn.mjDYN_FILTEREXACT, lag
    if mixed:
        both = spec.add_tendon(name="mixed")
        both.wrap_joint(motors[0].target, 1.0)
        both.wrap_joint(motors[1].target, mixed)
        motors[0].trntype, motors[0].target = mj.mjtTrn.mjTRN_TENDON, "mixed"
    compiled = spec.compile()
    if payload:
        body, factor = one.payload
        i = compiled.body(body).id
        if compiled.body_mass[i]:
            compiled.body_mass[i] *= factor
            compiled.body_inertia[i] *= factor
        else:
            compiled.body_mass[i], compiled.body_inertia[i] = factor, 1e-4
        mj.mj_setConst(compiled, mj.MjData(compiled))
    return compiled
