"""A block pushed over a floor with dry friction, in MuJoCo, and a crude model of it.

A box that is free to tilt lies on a plane, under Coulomb friction at the contacts. The crude model
is the quasi-static pusher-slider of the literature: an ellipsoidal limit surface (Lynch, Maekawa &
Tanie 1992) and Coulomb friction at the pusher (Hogan & Rodriguez 2016), smooth.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.foreign.mechanisms import MujocoRobot
from benchmarks.foreign.robots import Robot, minimum_jerk, task_of, with_true_model
from grounded.model import Model, Param
from grounded.task import Task

HALF, RADIUS, GAP = 0.05, 0.02, 0.07  # [m] half a side of the block, the pusher's tip, their sum
SOFT = 0.002  # [m] over which the crude contact builds up

# The block's joints are a slide along each axis and three turns, the yaw among the first three: a
# free body whose first states are those of the task.
PLANE = """
<mujoco model="block on a plane">
  <option timestep="0.002" cone="elliptic" impratio="10"/>
  <worldbody>
    <geom name="floor" type="plane" size="2 2 0.1" contype="0" conaffinity="0"/>
    <body name="pusher" pos="-0.07 0 0.05">
      <joint name="px" type="slide" axis="1 0 0" damping="1"/>
      <joint name="py" type="slide" axis="0 1 0" damping="1"/>
      <geom name="tip" type="sphere" size="0.02" mass="0.5" contype="0" conaffinity="0"/>
    </body>
    <body name="block" pos="0 0 0.05">
      <joint name="bx" type="slide" axis="1 0 0"/>
      <joint name="by" type="slide" axis="0 1 0"/>
      <joint name="byaw" axis="0 0 1"/>
      <joint name="bz" type="slide" axis="0 0 1"/>
      <joint name="bpitch" axis="0 1 0"/>
      <joint name="broll" axis="1 0 0"/>
      <geom name="box" type="box" size="0.05 0.05 0.05" mass="{mass}" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <contact>
    <pair geom1="box" geom2="floor" friction="{floor} {floor} 0 0 0"
      solimp="0.3 0.3 0.001" solreffriction="0.1 1"/>
    <pair geom1="box" geom2="tip" friction="{tip} {tip} 0 0 0"
      solimp="0.3 0.3 0.001" solreffriction="0.1 1"/>
  </contact>
  <actuator>
    <velocity name="vx" joint="px" kv="100"/><velocity name="vy" joint="py" kv="100"/>
  </actuator>
</mujoco>"""


def slider_dynamics(s: Any, a: Any, p: Any) -> dict[str, Any]:
    """Return ds/dt of a quasi-static pusher-slider, pushed by its left face.

    A force (fn, ft) at (-HALF, aside) of the block moves it by (fn, ft, moment / c^2), in units of
    speed, on an ellipsoidal limit surface. fn keeps the bodies apart. ft is what sticking asks,
    within the friction cone.
    """
    cos, sin = np.cos(s.byaw), np.sin(s.byaw)
    dx, dy = s.px - GAP - s.bx, s.py - s.by
    ahead, aside = cos * dx + sin * dy, cos * dy - sin * dx
    fn = p.k * SOFT * np.log1p(np.exp((ahead + HALF + RADIUS) / SOFT))
    along = cos * a.vy - sin * a.vx
    sticking = (along - HALF * aside * fn / p.c**2) / (1.0 + (HALF / p.c) ** 2)
    cone = p.mu * fn + 1e-6
    ft = cone * np.tanh(sticking / cone)
    return {
        "px": a.vx,
        "py": a.vy,
        "bx": cos * fn - sin * ft,
        "by": sin * fn + cos * ft,
        "byaw": -(HALF * ft + aside * fn) / p.c**2,
    }


def model() -> Model:
    """Return the pusher-slider; c is that of even pressure (in MuJoCo the corners carry)."""
    return Model(
        name="pusher-slider",
        states={"px": "m", "py": "m", "bx": "m", "by": "m", "byaw": "rad"},
        inputs={"vx": "m/s", "vy": "m/s"},
        params={
            "k": Param(20.0, "1/s", 5.0, 60.0),
            "c": Param(0.038, "m", 0.02, 0.1),
            "mu": Param(0.3, "", 0.1, 1.0),
        },
        derivative=slider_dynamics,
    )


def task() -> Task:
    """Return the task: forward by 0.3 m with a turn of a quarter radian, in 2.5 s."""
    t = 0.05 * np.arange(61)
    block = minimum_jerk(np.zeros(3), np.array([0.3, 0.04, 0.25]), t / 2.5)
    return task_of(
        model(),
        0.05,
        np.hstack([np.full((61, 2), np.nan), block]),
        np.zeros(5),
        0.4,
        state={"bx": 100.0, "by": 100.0, "byaw": 5.0},
        input=0.05,
        change=0.2,
    )


def setup(**what: float) -> tuple[Task, Robot, Task]:
    """Return the task, the robot, and the task planned in MuJoCo.

    Velocities, the block's height and tilt are not measured.
    """
    from grounded.adapters import mujoco

    asked, xml = task(), PLANE.format(**{"mass": 0.5, "floor": 0.35, "tip": 0.4} | what)
    truth = mujoco.model(xml)
    robot = Robot(MujocoRobot(xml, np.zeros(5), columns=list(range(5))))
    return asked, robot, with_true_model(asked, truth)
