"""The set-ups by name: a task with the crude model, and a robot that differs from it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.foreign import aircraft, cars, pushing
from benchmarks.foreign import mechanisms as mech
from benchmarks.foreign.robots import Robot, with_true_model
from grounded.adapters import mujoco
from grounded.challenge.mechanism import arm_xml, cart_xml
from grounded.policy import Policy
from grounded.task import Task
from grounded.trial import Trial


@dataclass(frozen=True, eq=False)
class Setup:
    """One system and what is withheld from its crude model.

    truth: the same task planned in the simulator, where the simulator can be a Model.
    cause: pattern of the names that a diagnosis may give to what is withheld.
    """

    name: str
    withheld: str
    task: Task
    robot: Robot
    truth: Task | None = None
    cause: str = ""

    def run(self, policy: Policy) -> Trial:
        """Run a policy on the robot; every run is the same, but for its noise."""
        return self.robot.run(policy)


def cart(name: str, withheld: str, kind: str = "gentle", **xml: object) -> Setup:
    task = mech.cart_task(kind)
    return Setup(name, withheld, task, *mech.mujoco_setup(task, cart_xml(**xml)))


def arm(name: str, withheld: str, delay: float = 0.0, **xml: object) -> Setup:
    task = mech.arm_task()
    return Setup(name, withheld, task, *mech.mujoco_setup(task, arm_xml(**xml), delay))


def shipped(
    name: str, withheld: str, system: str, cause: str, delay: float = 0.0, noise: float = 0.0,
    **what: float,
) -> Setup:  # fmt: skip
    task = mech.shipped_task(system)
    compiled = mech.shipped_model(system, **what)
    joints = [compiled.joint(n).id for n in task.model.state_names[: task.model.n // 2]]
    columns = [*joints, *(compiled.nq + j for j in joints)]  # hinges and slides only
    simulator = mech.MujocoRobot(compiled, np.asarray(task.start), columns)
    scatter = noise * np.repeat([1.0, 10.0], len(joints)) if noise else None  # [rad], [rad/s]
    truth = None
    if not noise:
        model = mujoco.model(compiled, without="unmoved")
        truth = with_true_model(task, model, delay)
    return Setup(name, withheld, task, Robot(simulator, delay, scatter), truth, cause)


def block(name: str, withheld: str, **what: float) -> Setup:
    return Setup(name, withheld, *pushing.setup(**what))


def cessna(name: str, withheld: str, **what: float) -> Setup:
    return Setup(name, withheld, aircraft.task(), aircraft.robot(**what))


def car(name: str, withheld: str, kind: str, acceleration: float) -> Setup:
    return Setup(name, withheld, cars.task(acceleration), cars.robot(kind, acceleration))


EULER = {"timestep": 0.002, "integrator": "implicitfast"}
FRICTION = {**EULER, "part": {"friction": {"force": 0.8}}}
LAG = {"part": {"lag": {"force": 0.05}}}
LOAD, DRY = {"true": {"load": 0.5}}, {"friction": {"tau1": 0.6, "tau2": 0.6}}
HEAVY = {"armature": {"tau1": 0.15, "tau2": 0.15}, "lag": {"tau1": 0.02, "tau2": 0.02}}
SLIP = "slip, tyres, load"
SETUPS: dict[str, tuple[Callable[..., Setup], str, dict[str, object]]] = {
    "cart-pole": (cart, "nothing", {}),
    "cart-pole-integrator": (cart, "implicit Euler of 2 ms", EULER),
    "cart-pole-friction": (cart, "cart friction 0.8 N", FRICTION),
    "cart-pole-lag": (cart, "activation filter 50 ms", LAG),
    "swing-up": (cart, "nothing", {"kind": "smooth"}),
    "swing-up-friction": (cart, "cart friction 0.8 N", FRICTION | {"kind": "smooth"}),
    "swing-up-lag": (cart, "activation filter 50 ms", LAG | {"kind": "smooth"}),
    "arm": (arm, "nothing", {"integrator": "RK4"}),
    "arm-payload": (arm, "payload 0.5 kg", {"part": LOAD}),
    "arm-friction": (arm, "joint friction 0.6 N m", {"part": DRY}),
    "arm-friction-1": (arm, "friction 0.6 N m in joint 1", {"part": {"friction": {"tau1": 0.6}}}),
    "arm-both": (arm, "payload and joint friction", {"part": LOAD | DRY}),
    "arm-delay": (arm, "delay 30 ms", {"delay": 0.03}),
    "arm-armature": (
        arm, "armature 0.1 kg m2", {"part": {"armature": {"tau1": 0.1, "tau2": 0.1}}},
    ),
    "arm-armature-lag": (arm, "armature 0.15 kg m2, filter 20 ms", {"part": HEAVY}),
    "arm-gear": (arm, "gear 0.8 of joint 1", {"gear": 0.8}),
    "block": (block, "inertia, contact, pressure, friction", {}),
    "cessna": (cessna, "sideslip, speed, engine", {}),
    "cessna-wind": (cessna, "the same and a cross-wind of 3 m/s", {"wind": 3.0}),
    "drift-car-3": (car, f"{SLIP}, 3.2 m/s2", {"kind": "drift", "acceleration": 3.2}),
    "drift-car-7": (car, f"{SLIP}, 7 m/s2", {"kind": "drift", "acceleration": 7.0}),
    "multi-body-3": (car, f"{SLIP}, 3.2 m/s2", {"kind": "multi-body", "acceleration": 3.2}),
    "multi-body-5": (car, f"{SLIP}, 5 m/s2", {"kind": "multi-body", "acceleration": 5.0}),
}  # fmt: skip

# what is withheld of each shipped system, and the names that a diagnosis may give it
WITHHELD: dict[str, tuple[str, dict[str, float]]] = {
    "friction": ("(joint|coulomb|dry)_friction:.*{joint}_vel", {"friction": 1.0}),
    "delay": ("delay:", {"delay": 0.04}),
    "lag": ("first_order_lag:", {"lag": 0.04}),
    "gear": ("input_gain:", {"gear": 0.8}),
    "payload": ("parameter:.*_mass", {"payload": 1.0}),
    "mixed": ("crosstalk:|coupling:", {"mixed": 0.3}),
    "noise": ("(joint|coulomb|dry)_friction:.*{joint}_vel", {"friction": 1.0, "noise": 1e-3}),
}
ONE_MOTOR = ("pendulum", "double-pendulum", "acrobot")  # has no axes to mix
for system, one in mech.SHIPPED.items():
    for what, (cause, sizes) in WITHHELD.items():
        unknown = what == "mixed" and system in ONE_MOTOR
        stiff = "friction" in sizes and system == "acrobot"  # whose file disables dry friction
        if not (unknown or stiff):
            named = {"system": system, "cause": cause.format(joint=one.friction[0]), **sizes}
            SETUPS[f"{system}-{what}"] = (shipped, what, named)


def setup(name: str) -> Setup:
    """Return the set-up of that name."""
    make, withheld, what = SETUPS[name]
    return make(name, withheld, **what)
