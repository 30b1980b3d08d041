"""Mechanisms in MuJoCo that act as the real system.

The simulator shares nothing with the diagnosis: it has its own joints, dry friction and integrator.
What a crude model in `grounded.models` lacks is given in the simulator's own terms: `frictionloss`,
`damping`, `armature`, the filter of an actuator, masses. Withheld effects are things that no family
describes: a spring at a joint, or a pendulum that hangs from the tip.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping
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
      <joint name="x" type="slide" axis="1 0 0" frictionloss="{friction[force]}" damping="{b}"
       armature="{armature[force]}" stiffness="{spring}"/>
      <inertial pos="0 0 0" mass="{M}" diaginertia="0.1 0.1 0.1"/>
      <body name="pole">
        <joint name="theta" axis="0 1 0"/>
        <inertial pos="0 0 {l}" mass="{m}" diaginertia="{inertia} {inertia} 0.001"/>
        {hung}
      </body>
    </body>
  </worldbody>
  <actuator><general name="force" joint="x" {lag[force]}/></actuator>
</mujoco>"""

ARM = """
<mujoco model="arm">
  <option timestep="{timestep}" integrator="{integrator}"/>
  <worldbody>
    <body name="upper">
      <joint name="q1" axis="0 -1 0" frictionloss="{friction[tau1]}" armature="{armature[tau1]}"
       damping="{b1}" stiffness="{spring}" springref="-90"/>
      <inertial pos="0.25 0 0" mass="1.5" diaginertia="0.001 0.03125 0.03125"/>
      <body name="fore" pos="0.5 0 0">
        <joint name="q2" axis="0 -1 0" frictionloss="{friction[tau2]}" armature="{armature[tau2]}"
         damping="{b2}"/>
        <inertial pos="0.2 0 0" mass="{m2}" diaginertia="0.001 0.013333333333 0.013333333333"/>
        <body name="tip" pos="0.4 0 0">
          <inertial pos="0 0 0" mass="{load}" diaginertia="1e-9 1e-9 1e-9"/>
          {hung}
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <general name="tau1" joint="q1" gear="{gear}" {lag[tau1]}/>
    <general name="tau2" joint="q2" {lag[tau2]}/>
  </actuator>
</mujoco>"""

HUNG = """<body name="hung" pos="{at}"><joint name="swing" axis="0 1 0" damping="0.005"/>
<inertial pos="0 0 {down}" mass="{mass}" diaginertia="1e-4 1e-4 1e-4"/></body>"""


Part = Mapping[str, Mapping[str, float]]  # {kind: {input or parameter: size}}
NOTHING: Part = {}


def cart_xml(part: Part = NOTHING, *, hung: float = 0.0, **options: Any) -> str:
    """Return the cart-pole; `true` in `part`: other M, m, l, b of `grounded.models.cart_pole`."""
    p = {"M": 1.0, "m": 0.3, "l": 0.5, "b": 0.0} | dict(part.get("true", {}))
    below = HUNG.format(at=f"0 0 {2 * p['l']}", down=0.15, mass=hung) if hung else ""
    own = {"timestep": 0.01, "integrator": "RK4", "inertia": p["m"] * p["l"] ** 2 / 3}
    return _written(CART, part, **own | p | options, hung=below)


def arm_xml(part: Part = NOTHING, *, hung: float = 0.0, **options: Any) -> str:
    """Return the two-link arm; `true`: other m2, b1, b2, load of `grounded.models.arm`."""
    p = {"m2": 1.0, "b1": 0.0, "b2": 0.0, "load": 0.0} | dict(part.get("true", {}))
    below = HUNG.format(at="0 0 0", down=-0.15, mass=hung) if hung else ""
    own = {"timestep": 0.002, "integrator": "implicitfast"}
    p["load"] = max(p["load"], 1e-9)
    return _written(ARM, part, **own | p | options, hung=below)


def _written(template: str, part: Part, **options: Any) -> str:
    """Return the XML with what is withheld: friction, armature and lag [s] by input."""
    kinds = {kind: defaultdict(float, part.get(kind, {})) for kind in ("friction", "armature")}
    lags = {name: lag for name, lag in part.get("lag", {}).items() if lag}
    filters = {name: f'dyntype="filterexact" dynprm="{lag}"' for name, lag in lags.items()}
    given = {"gear": 1.0, "spring": 0.0} | kinds | options
    return template.format(**given, lag=defaultdict(str, filters))


class Mechanism:
    """A running MuJoCo simulation, with the state of actuators, warm start and hanging mass.

    Args:
        built: writes its XML.
        part: what its crude model lacks: friction, armature and lag by input, "true" parameters.
        more: spring, hung.
        fine: time that it advances at once [s].
    """

    def __init__(
        self, built: Callable[..., str], part: Part, more: Mapping[str, float], fine: float
    ) -> None:
        self.mj, self.steps = needs("mujoco"), int(np.ceil(fine / STEP))
        xml = built(part, timestep=fine / self.steps, integrator="implicitfast", **more)
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
