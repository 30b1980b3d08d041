"""Mechanisms in MuJoCo that act as the real system.

The simulator shares nothing with the diagnosis: it has its own joints, dry friction and integrator.
What a crude model in `grounded.models` lacks is given in the simulator's own terms: `frictionloss`,
`damping`, `armature`, the filter of an actuator, masses. Withheld effects are things that no family
describes: a spring at a joint, or a pendulum that hangs from the tip.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from grounded.errors import needs
from grounded.frozen import Array

STEP = 1e-4  # longest step of the simulator [s], since its positions are early by a part of it

CART = """
<mujoco model="cart-pole">
  <option timestep="{timestep}" integrator="{integrator}"/>
  <worldbody>
    <body name="cart">
      <joint name="x" type="slide" axis="1 0 0" frictionloss="{friction}" damping="{b}"
       armature="{armature}" stiffness="{spring}"/>
      <inertial pos="0 0 0" mass="{M}" diaginertia="0.1 0.1 0.1"/>
      <body name="pole">
        <joint name="theta" axis="0 1 0"/>
        <inertial pos="0 0 {l}" mass="{m}" diaginertia="{inertia} {inertia} 0.001"/>
        {hung}
      </body>
    </body>
  </worldbody>
  <actuator><general name="force" joint="x" {actuator}/></actuator>
</mujoco>"""

ARM = """
<mujoco model="arm">
  <option timestep="{timestep}" integrator="{integrator}"/>
  <worldbody>
    <body name="upper">
      <joint name="q1" axis="0 -1 0" frictionloss="{f1}" armature="{a1}" damping="{b1}"
       stiffness="{spring}" springref="-90"/>
      <inertial pos="0.25 0 0" mass="1.5" diaginertia="0.001 0.03125 0.03125"/>
      <body name="fore" pos="0.5 0 0">
        <joint name="q2" axis="0 -1 0" frictionloss="{f2}" armature="{a2}" damping="{b2}"/>
        <inertial pos="0.2 0 0" mass="{m2}" diaginertia="0.001 0.013333333333 0.013333333333"/>
        <body name="tip" pos="0.4 0 0">
          <inertial pos="0 0 0" mass="{payload}" diaginertia="1e-9 1e-9 1e-9"/>
          {hung}
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <general name="tau1" joint="q1" gear="{gear}" {act1}/>
    <general name="tau2" joint="q2" {act2}/>
  </actuator>
</mujoco>"""

HUNG = """<body name="hung" pos="{at}"><joint name="swing" axis="0 1 0" damping="0.005"/>
<inertial pos="0 0 {down}" mass="{mass}" diaginertia="1e-4 1e-4 1e-4"/></body>"""


def _filter(lag: float) -> str:
    """Return the XML attributes of an actuator's first-order lag [s]."""
    return f'dyntype="filterexact" dynprm="{lag}"' if lag else ""


def cart_xml(
    *,
    timestep: float = 0.01,
    integrator: str = "RK4",
    friction: float = 0.0,
    lag: float = 0.0,
    armature: float = 0.0,
    spring: float = 0.0,
    hung: float = 0.0,
    true: Mapping[str, float] | None = None,
) -> str:
    """Return the cart-pole; `true`: differing M, m, l, b of `grounded.models.cart_pole`."""
    p = {"M": 1.0, "m": 0.3, "l": 0.5, "b": 0.0} | dict(true or {})
    return CART.format(
        timestep=timestep,
        integrator=integrator,
        friction=friction,
        armature=armature,
        spring=spring,
        hung=HUNG.format(at=f"0 0 {2 * p['l']}", down=0.15, mass=hung) if hung else "",
        actuator=_filter(lag),
        inertia=p["m"] * p["l"] ** 2 / 3,
        **p,
    )


def arm_xml(
    *,
    payload: float = 1e-9,
    f1: float = 0.0,
    f2: float = 0.0,
    armature: float | tuple[float, float] = 0.0,
    gear: float = 1.0,
    timestep: float = 0.002,
    integrator: str = "implicitfast",
    lag: tuple[float, float] = (0.0, 0.0),
    spring: float = 0.0,
    hung: float = 0.0,
    true: Mapping[str, float] | None = None,
) -> str:
    """Return the two-link arm; `true`: differing m2, b1, b2 of `grounded.models.arm`."""
    a1, a2 = np.broadcast_to(armature, 2)
    return ARM.format(
        payload=payload,
        f1=f1,
        f2=f2,
        a1=a1,
        a2=a2,
        gear=gear,
        timestep=timestep,
        integrator=integrator,
        act1=_filter(lag[0]),
        act2=_filter(lag[1]),
        spring=spring,
        hung=HUNG.format(at="0 0 0", down=-0.15, mass=hung) if hung else "",
        **({"m2": 1.0, "b1": 0.0, "b2": 0.0} | dict(true or {})),
    )


def cart_built(part: Mapping[str, Mapping[str, float]], **more: Any) -> str:
    """Return the cart-pole with the effects of a case, {kind: {input or parameter: size}}."""
    at = {kind: values.get("force", 0.0) for kind, values in part.items() if kind != "true"}
    return cart_xml(integrator="implicitfast", true=part["true"], **at, **more)


def arm_built(part: Mapping[str, Mapping[str, float]], **more: Any) -> str:
    """Return the arm with the effects of a case, {kind: {input or parameter: size}}."""
    two = {k: (v.get("tau1", 0.0), v.get("tau2", 0.0)) for k, v in part.items() if k != "true"}
    f1, f2 = two["friction"]
    true = dict(part["true"])
    load = max(true.pop("load"), 1e-9)
    return arm_xml(
        payload=load, f1=f1, f2=f2, armature=two["armature"], lag=two["lag"], true=true, **more
    )


@dataclass(frozen=True, eq=False)
class Mechanism:
    """A mechanism with what its crude model lacks.

    `built` writes its XML. `part` is {kind: {input: size}} with kinds friction, armature and lag,
    and the "true" parameters.
    """

    built: Callable[..., str]
    part: Mapping[str, Mapping[str, float]]
    more: Mapping[str, float] = field(default_factory=dict)  # spring, hung

    def plant(self, fine: float) -> Plant:
        """Return the mechanism at rest, which advances by `fine` seconds at a time."""
        return Plant(self, fine)


class Plant:
    """A running MuJoCo simulation, with the state of actuators, warm start and hanging mass."""

    def __init__(self, of: Mechanism, fine: float) -> None:
        self.mj, self.steps = simulator(), int(np.ceil(fine / STEP))
        xml = of.built(of.part, timestep=fine / self.steps, **of.more)
        self.model = self.mj.MjModel.from_xml_string(xml)
        self.data = self.mj.MjData(self.model)
        self.filtered = np.flatnonzero(self.model.actuator_actadr >= 0)  # that have a state
        self.started = False

    def advance(self, x: Array, u: Array) -> Array:
        """Return the state (n,), positions then velocities, after the steps with inputs u (m,)."""
        data, half = self.data, len(x) // 2
        data.qpos[:half], data.qvel[:half], data.ctrl[:] = x[:half], x[half:], u
        if not self.started and self.model.na:  # actuators start settled
            data.act[self.model.actuator_actadr[self.filtered]] = u[self.filtered]
        self.started = True
        for _ in range(self.steps):
            self.mj.mj_step(self.model, data)
        return np.concatenate([data.qpos[:half], data.qvel[:half]])


def simulator() -> Any:
    """Import MuJoCo.

    Raises:
        GroundedError: if it is not installed, with what to install.
    """
    return needs("mujoco", "mujoco")
