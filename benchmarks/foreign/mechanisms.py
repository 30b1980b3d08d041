"""Mechanisms in MuJoCo, and the crude models that plan for them.

The crude models of the cart-pole and the two-link arm are their equations of motion in plain NumPy
(`grounded.models`), with the simulator's masses and lengths, so that only what a set-up withholds
differs. The seven-joint arm is planned in MuJoCo itself.
"""

from __future__ import annotations

import numpy as np

from benchmarks.foreign.robots import Robot, minimum_jerk, task_of, with_true_model
from grounded.model import Model
from grounded.models import arm, cart_pole
from grounded.task import Task


class MujocoRobot:
    """MuJoCo, stepped as users do: it keeps its warm start, its time and its contacts."""

    def __init__(self, xml: str, start: np.ndarray, columns: list[int] | None = None) -> None:
        import mujoco

        self.mj = mujoco
        self.model = mujoco.MjModel.from_xml_string(xml)
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET.value
        mujoco.set_mju_user_warning(lambda _: None)  # or a file MUJOCO_LOG.TXT appears
        self.data = mujoco.MjData(self.model)
        self.start = start
        self.columns = slice(None) if columns is None else columns
        self.timestep = float(self.model.opt.timestep)

    def reset(self) -> None:
        self.mj.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = np.split(self.start, [self.model.nq])
        self.mj.mj_forward(self.model, self.data)

    def measure(self) -> np.ndarray:
        return np.concatenate([self.data.qpos, self.data.qvel])[self.columns]

    def advance(self, u: np.ndarray) -> None:
        self.data.ctrl[:] = u
        self.mj.mj_step(self.model, self.data)


def mujoco_setup(task: Task, xml: str, delay: float = 0.0) -> tuple[Robot, Task]:
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
    "hasty": (200, 30.0, {"state": {"x": 1.0, "theta": 1.0}, "terminal": END, "input": 0.002}),
}  # fmt: skip


def cart_task(kind: str) -> Task:
    """Return the task from hanging to upright at the origin, with every target column given.

    "gentle" is solved from the first guess; "smooth" has a first guess from which 100 iterations
    are not enough, though zero inputs are a good start; "hasty" has many local optima.
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


def holding(model: Model, q: np.ndarray) -> np.ndarray:
    """Return the torques that hold an arm still (accelerations are linear in them)."""
    n, m = model.n, model.m
    x = np.append(q, np.zeros(n - m))[None]
    at = lambda u: model.system.step(x, u[None], model.values, 0.005)[0, m:]  # noqa: E731
    free = at(np.zeros(m))
    return np.linalg.solve(np.column_stack([at(e) - free for e in np.eye(m)]), -free)


# Seven joints: MuJoCo itself is the crude model, through the adapter.

LINKS = (  # axis, offset [m], mass [kg]
    ("0 0 1", 0.16, 4.0), ("0 1 0", 0.18, 4.0), ("0 0 1", 0.18, 3.0), ("0 -1 0", 0.22, 2.7),
    ("0 0 1", 0.18, 1.7), ("0 1 0", 0.22, 1.8), ("0 0 1", 0.08, 0.4),
)  # fmt: skip
TORQUES = np.array([176.0, 176.0, 110.0, 110.0, 110.0, 40.0, 40.0])


def arm7_xml(payload: float = 0.1, friction: float = 0.0, timestep: float = 0.005) -> str:
    """Return a chain of seven links with alternating axes, masses and lengths about an iiwa's."""
    body = end = ""
    for i, (axis, offset, mass) in enumerate(LINKS, start=1):
        body += (
            f'<body name="link{i}" pos="0 0 {offset}">'
            f'<joint name="q{i}" axis="{axis}" damping="0.5" armature="0.05" '
            f'frictionloss="{friction}"/>'
            f'<inertial pos="0 0.01 0.09" mass="{mass}" '
            f'diaginertia="{0.006 * mass} {0.006 * mass} {0.003 * mass}"/>'
        )
        end += "</body>"
    hand = f'<inertial pos="0 0 0" mass="{payload}" diaginertia="1e-4 1e-4 1e-4"/>'
    motors = "".join(f'<motor name="tau{i}" joint="q{i}"/>' for i in range(1, 8))
    return (
        f'<mujoco model="arm7"><option timestep="{timestep}" integrator="implicitfast"/>'
        f'<worldbody>{body}<body name="hand" pos="0 0 0.1">{hand}</body>{end}</worldbody>'
        f"<actuator>{motors}</actuator></mujoco>"
    )


def arm7_task() -> Task:
    from grounded.adapters import mujoco

    model = mujoco.model(arm7_xml(), params=("hand.mass", "q2.damping", "q4.damping"))
    start = np.array([0.0, 0.4, 0.0, -1.2, 0.0, 0.8, 0.0])
    end = np.array([0.8, 0.9, 0.4, -0.6, -0.5, 1.2, 0.6])
    t = 0.02 * np.arange(61)
    path = minimum_jerk(start, end, t / 0.9)
    return task_of(
        model,
        0.02,
        np.hstack([path, np.full((61, 7), np.nan)]),
        np.append(start, np.zeros(7)),
        TORQUES,
        state=dict.fromkeys(model.state_names[:7], 20.0),
        input=(2e-2 / TORQUES**2).tolist(),
        change=(2e-1 / TORQUES**2).tolist(),
        past=holding(model, start),
    )
