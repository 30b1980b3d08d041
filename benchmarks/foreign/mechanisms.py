"""Mechanisms in MuJoCo, and the crude models that plan for them.

The crude models of the cart-pole and the two-link arm are their equations of motion in plain NumPy,
with the simulator's own masses and lengths: what a set-up withholds is all that differs.
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
        self.timestep = float(self.model.opt.timestep)
        self.torques = self.model.nu == 0

    def reset(self) -> None:
        self.mj.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = np.split(self.start, [self.model.nq])
        self.mj.mj_forward(self.model, self.data)

    def measure(self) -> np.ndarray:
        return np.concatenate([self.data.qpos, self.data.qvel])

    def advance(self, u: np.ndarray) -> None:
        if self.torques:
            self.data.qfrc_applied[:] = u
        else:
            self.data.ctrl[:] = u
        self.mj.mj_step(self.model, self.data)


def mujoco_setup(task: Task, xml: str, delay: float = 0.0) -> tuple[Robot, Task]:
    """The robot of an XML, and the task planned in the same XML."""
    from grounded.adapters import mujoco

    truth = with_true_model(task, mujoco.model(xml), delay)
    return Robot(MujocoRobot(xml, np.asarray(task.start)), delay), truth


# Cart-pole: from hanging to upright in three seconds.

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


def cart_task() -> Task:
    return task_of(
        cart_model(),
        0.02,
        np.zeros((151, 4)),
        np.array([0.0, np.pi, 0.0, 0.0]),
        12.0,
        state={"x": 0.05, "theta": 0.05, "x_vel": 0.002, "theta_vel": 0.002},
        terminal={"x": 50.0, "theta": 100.0, "x_vel": 10.0, "theta_vel": 10.0},
        input=0.02,
    )


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
    at = lambda u: model.system.step(x, u[None], model.values, 0.001)[0, m:]  # noqa: E731
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
