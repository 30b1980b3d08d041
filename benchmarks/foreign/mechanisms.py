"""Mechanisms in MuJoCo, and the crude models that plan for them.

The crude models of the cart-pole and the two-link arm are their equations of motion in plain NumPy,
with the simulator's own masses and lengths: what a set-up withholds is all that differs. The
seven-joint arm is planned in MuJoCo itself, the pushed block in a quasi-static model.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.foreign.robots import Robot, minimum_jerk, task_of, with_true_model
from grounded.model import Model, Param
from grounded.task import Task

G = 9.81


class MujocoRobot:
    """MuJoCo, stepped as its users do: it keeps its warm start, its time and its contacts."""

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
    """The robot of an XML, and the task planned in the same XML."""
    from grounded.adapters import mujoco

    truth = with_true_model(task, mujoco.model(xml), delay)
    return Robot(MujocoRobot(xml, np.asarray(task.start)), delay), truth


# Cart-pole: from hanging to upright in three or four seconds.

CART = """
<mujoco model="cart-pole">
  <option timestep="{timestep}" integrator="{integrator}"/>
  <worldbody>
    <body name="cart">
      <joint name="x" type="slide" axis="1 0 0" frictionloss="{friction}"/>
      <inertial pos="0 0 0" mass="1.0" diaginertia="0.1 0.1 0.1"/>
      <body name="pole">
        <joint name="theta" axis="0 1 0"/>
        <inertial pos="0 0 0.5" mass="0.3" diaginertia="0.025 0.025 0.001"/>
      </body>
    </body>
  </worldbody>
  <actuator><general name="force" joint="x" {actuator}/></actuator>
</mujoco>"""


def cart_dynamics(s: Any, a: Any, p: Any) -> dict[str, Any]:
    """ds/dt of a cart and a uniform pole; theta is zero upright."""
    sin, cos = np.sin(s.theta), np.cos(s.theta)
    inertia = p.m * p.l**2 * 4 / 3
    force = a.force - p.b * s.x_vel + p.m * p.l * s.theta_vel**2 * sin
    det = (p.M + p.m) * inertia - (p.m * p.l * cos) ** 2
    return {
        "x": s.x_vel,
        "theta": s.theta_vel,
        "x_vel": (inertia * force - p.m * p.l * cos * p.m * G * p.l * sin) / det,
        "theta_vel": ((p.M + p.m) * p.m * G * p.l * sin - p.m * p.l * cos * force) / det,
    }


def cart_model() -> Model:
    return Model(
        name="cart-pole",
        states={"x": "m", "theta": "rad", "x_vel": "m/s", "theta_vel": "rad/s"},
        inputs={"force": "N"},
        params={
            "M": Param(1.0, "kg", 0.5, 2.0),
            "m": Param(0.3, "kg", 0.1, 0.6),
            "l": Param(0.5, "m", 0.3, 0.8),
            "b": Param(0.0, "N s/m", 0.0, 5.0),
        },
        angles=("theta",),
        derivative=cart_dynamics,
    )


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
    """From hanging to upright at the origin: every column of the target is given.

    "gentle" is solved from the first guess; "smooth" has a first guess from which 100 iterations
    are not enough, though zero inputs are a good start; "hasty" has many local optima.
    """
    H, limit, weights = CART_TASKS[kind]
    start = np.array([0.0, np.pi, 0.0, 0.0])
    return task_of(cart_model(), 0.02, np.zeros((H + 1, 4)), start, limit, **weights)


def cart_xml(
    *, timestep: float = 0.01, integrator: str = "RK4", friction: float = 0.0, lag: float = 0.0
) -> str:
    actuator = f'dyntype="filterexact" dynprm="{lag}"' if lag else ""
    return CART.format(
        timestep=timestep, integrator=integrator, friction=friction, actuator=actuator
    )


# Two-link arm in the vertical plane: a reach of 0.8 s, then hold.

ARM = """
<mujoco model="arm">
  <option timestep="0.002" integrator="{integrator}"/>
  <worldbody>
    <body name="upper">
      <joint name="q1" axis="0 -1 0" frictionloss="{f1}" armature="{armature}"/>
      <inertial pos="0.25 0 0" mass="1.5" diaginertia="0.001 0.03125 0.03125"/>
      <body name="fore" pos="0.5 0 0">
        <joint name="q2" axis="0 -1 0" frictionloss="{f2}" armature="{armature}"/>
        <inertial pos="0.2 0 0" mass="1.0" diaginertia="0.001 0.013333333333 0.013333333333"/>
        <body name="tip" pos="0.4 0 0">
          <inertial pos="0 0 0" mass="{payload}" diaginertia="1e-9 1e-9 1e-9"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="tau1" joint="q1" gear="{gear}"/><motor name="tau2" joint="q2"/></actuator>
</mujoco>"""


def arm_dynamics(s: Any, a: Any, p: Any) -> dict[str, Any]:
    """ds/dt of two uniform rods and a mass at the tip; angles from the horizontal, upwards."""
    l1, c1, c2, m1, l2 = 0.5, 0.25, 0.2, 1.5, 0.4
    cos, sin = np.cos(s.q2), np.sin(s.q2)
    first, second = p.m2 * c2 + p.load * l2, p.m2 * c2**2 + p.load * l2**2 + 0.013333333333
    h = l1 * first
    m11 = m1 * c1**2 + 0.03125 + (p.m2 + p.load) * l1**2 + second + 2 * h * cos
    m12 = second + h * cos
    g2 = G * first * np.cos(s.q1 + s.q2)
    g1 = G * (m1 * c1 + (p.m2 + p.load) * l1) * np.cos(s.q1) + g2
    w1, w2 = s.q1_vel, s.q2_vel
    r1 = a.tau1 - p.b1 * w1 + h * sin * (2 * w1 * w2 + w2**2) - g1
    r2 = a.tau2 - p.b2 * w2 - h * sin * w1**2 - g2
    det = m11 * second - m12**2
    return {
        "q1": w1,
        "q2": w2,
        "q1_vel": (second * r1 - m12 * r2) / det,
        "q2_vel": (m11 * r2 - m12 * r1) / det,
    }


def arm_model() -> Model:
    return Model(
        name="arm",
        states={"q1": "rad", "q2": "rad", "q1_vel": "rad/s", "q2_vel": "rad/s"},
        inputs={"tau1": "N m", "tau2": "N m"},
        params={
            "m2": Param(1.0, "kg", 0.5, 2.0),
            "load": Param(0.0, "kg", 0.0, 1.0),
            "b1": Param(0.0, "N m s/rad", 0.0, 2.0),
            "b2": Param(0.0, "N m s/rad", 0.0, 2.0),
        },
        derivative=arm_dynamics,
    )


def arm_task() -> Task:
    start, end = np.array([-1.4, 0.3]), np.array([0.5, 1.0])
    t = 0.02 * np.arange(61)
    target = np.hstack([minimum_jerk(start, end, t / 0.8), np.full((61, 2), np.nan)])
    model = arm_model()
    return task_of(
        model,
        0.02,
        target,
        np.append(start, [0.0, 0.0]),
        40.0,
        state={"q1": 20.0, "q2": 20.0},
        terminal={"q1": 50.0, "q2": 50.0},
        input=2e-5,
        change=2e-4,
        past=holding(model, start),
    )


def holding(model: Model, q: np.ndarray) -> np.ndarray:
    """Torques that hold an arm still: tau at which the accelerations vanish (linear in tau)."""
    n, m = model.n, model.m
    x = np.append(q, np.zeros(n - m))[None]
    at = lambda u: model.system.step(x, u[None], model.values, 0.005)[0, m:]  # noqa: E731
    free = at(np.zeros(m))
    return np.linalg.solve(np.column_stack([at(e) - free for e in np.eye(m)]), -free)


def arm_xml(
    *,
    payload: float = 1e-9,
    f1: float = 0.0,
    f2: float = 0.0,
    armature: float = 0.0,
    gear: float = 1.0,
    integrator: str = "implicitfast",
) -> str:
    return ARM.format(
        payload=payload, f1=f1, f2=f2, armature=armature, gear=gear, integrator=integrator
    )


# Seven joints: MuJoCo itself is the crude model, through the adapter.

LINKS = (  # axis, offset [m], mass [kg]
    ("0 0 1", 0.16, 4.0), ("0 1 0", 0.18, 4.0), ("0 0 1", 0.18, 3.0), ("0 -1 0", 0.22, 2.7),
    ("0 0 1", 0.18, 1.7), ("0 1 0", 0.22, 1.8), ("0 0 1", 0.08, 0.4),
)  # fmt: skip
TORQUES = np.array([176.0, 176.0, 110.0, 110.0, 110.0, 40.0, 40.0])


def arm7_xml(payload: float = 0.1, friction: float = 0.0, timestep: float = 0.005) -> str:
    """A chain of seven links with alternating axes, masses and lengths about an iiwa's."""
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


# A block pushed over a floor with dry friction.

BLOCK = """
<mujoco model="block">
  <option timestep="0.002" cone="elliptic" impratio="10"/>
  <worldbody>
    <body name="pusher" pos="-0.07 0 0">
      <joint name="px" type="slide" axis="1 0 0" damping="1"/>
      <joint name="py" type="slide" axis="0 1 0" damping="1"/>
      <geom type="cylinder" size="0.02 0.05" mass="0.5" friction="0.4"/>
    </body>
    <body name="block">
      <joint name="bx" type="slide" axis="1 0 0" frictionloss="1.5"/>
      <joint name="by" type="slide" axis="0 1 0" frictionloss="1.5"/>
      <joint name="byaw" axis="0 0 1" frictionloss="0.05"/>
      <geom type="box" size="0.05 0.05 0.05" mass="{mass}" friction="0.4"/>
    </body>
  </worldbody>
  <actuator>
    <velocity name="vx" joint="px" kv="100"/><velocity name="vy" joint="py" kv="100"/>
  </actuator>
</mujoco>"""
HALF, RADIUS, GAP = 0.05, 0.02, 0.07


def push_dynamics(s: Any, a: Any, p: Any) -> dict[str, Any]:
    """ds/dt of quasi-static pushing by the left face: what overlaps moves away, and turns."""
    cos, sin = np.cos(s.byaw), np.sin(s.byaw)
    dx, dy = s.px - GAP - s.bx, s.py - s.by
    ahead, aside = cos * dx + sin * dy, cos * dy - sin * dx
    overlap = ahead + HALF + RADIUS
    push = p.k * 0.002 * np.logaddexp(0.0, overlap / 0.002)
    return {
        "px": a.vx,
        "py": a.vy,
        "bx": cos * push,
        "by": sin * push,
        "byaw": -push * aside / p.c,
    }


def push_model() -> Model:
    return Model(
        name="pushed block",
        states={"px": "m", "py": "m", "bx": "m", "by": "m", "byaw": "rad"},
        inputs={"vx": "m/s", "vy": "m/s"},
        params={"k": Param(20.0, "1/s", 5.0, 60.0), "c": Param(0.002, "m^2", 0.0005, 0.01)},
        derivative=push_dynamics,
    )


def push_task() -> Task:
    """Forward by 0.3 m with a turn of a quarter radian, in 2.5 s."""
    t = 0.05 * np.arange(61)
    block = minimum_jerk(np.zeros(3), np.array([0.3, 0.04, 0.25]), t / 2.5)
    return task_of(
        push_model(),
        0.05,
        np.hstack([np.full((61, 2), np.nan), block]),
        np.zeros(5),
        0.4,
        state={"bx": 100.0, "by": 100.0, "byaw": 5.0},
        input=0.05,
        change=0.2,
    )


def push_setup(task: Task, mass: float = 0.5) -> tuple[Robot, Task]:
    """The block in MuJoCo; its velocities and the pusher's are not measured."""
    from grounded.adapters import mujoco

    xml = BLOCK.format(mass=mass)
    robot = Robot(MujocoRobot(xml, np.zeros(10), columns=list(range(5))))
    return robot, with_true_model(task, mujoco.model(xml))
