"""Which number of an MJCF file holds which value of the model: a parameter, or an adopted effect.

An effect that acts where an input enters is a torque of the joint that the input drives: a unit of
the input is `push` = gain gear [N m] there, and T = c sign(w) + b w is frictionloss and damping.
One that acts on the rate of a joint with a constant inertia M of its own is M times as much.
`RULES` lists them. Everything else is told with its equation.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from grounded.adapters.files import load
from grounded.adapters.mujoco import MujocoStepper
from grounded.adapters.mujoco_names import FIELDS, SLIDE_UNITS, states_of
from grounded.diagnosis.parts import Estimate
from grounded.effects import param_name
from grounded.errors import needs
from grounded.result import UNSAID, Document
from grounded_trials.workspace.folder import Folder

Key = tuple[str, int, str]  # kind of element, its index in MjModel, field
# relative change of a joint's inertia with the pose below which it is constant
INERTIA_CONSTANT = 2e-3
POSES = 8  # poses at which that is looked at
HINGE, SLIDE, JOINT = 3, 2, 0  # mjtJoint, mjTRN_JOINT


@dataclass(frozen=True, eq=False)
class Value(Document):
    """A number of the exported file, and what it was in the file that the model came from."""

    value: float
    std: float  # NaN if it is not known
    unit: str
    was: float

    @property
    def text(self) -> str:
        """The value with its +-."""
        return Estimate(self.value, self.std, unit=self.unit).text


@dataclass(frozen=True, eq=False)
class Number(Value):
    """A number of an MJCF or URDF file."""

    kind: str = dataclasses.field(metadata=UNSAID)  # body, joint, actuator or geom
    index: int = dataclasses.field(metadata=UNSAID)  # of the element in MjModel
    name: str = dataclasses.field(metadata=UNSAID)  # of the element and the field, `elbow.damping`
    field: str = dataclasses.field(metadata=UNSAID)


class Held:
    """Collects the numbers of a file that parameters and effects change."""

    def __init__(self, workspace: Folder, values: Mapping[str, Estimate]) -> None:
        """Collect what the file of a workspace's model holds now; `lost` are effects that it can't.

        Args:
            workspace: the workspace, whose model MuJoCo computes from a file.
            values: parameters and quantities of effects by name, with their +-.
        """
        step, latency = workspace.base_model.step, workspace.config.task.latency
        assert isinstance(step, MujocoStepper) and step.source is not None
        self.mj, self.stepper, self.file = needs("mujoco"), step, load(step.source)
        self.now = copy.deepcopy(self.file)
        self._delta = dict[Key, tuple[float, float]]()  # what is added, and its variance
        for setting in step.settings:
            one = values[setting.name]
            setting.write(self.now, one.value)
            element, _, field = setting.spec.rpartition(".")
            kind = FIELDS[field].element
            index = self.mj.mj_name2id(self.file, _object(self.mj, kind), element)
            if one.value != setting.nominal:
                self.add(kind, index, field, one.value - setting.nominal, one.std)
        self.mj.mj_setConst(self.now, self.mj.MjData(self.now))
        pairs = [
            (f"delay:{name}", {"d": Estimate(late, 0.0, unit="s")})
            for name in {**step.latency, **latency}
            if (late := latency.get(name, 0.0) - step.latency.get(name, 0.0))
        ]
        for name, its in workspace.config.model.effects.items():
            pairs.append((name, {q: values[param_name(name, q)] for q in its}))
        self.lost = [(name, c) for name, c in pairs if not self.adopt(name, c)]

    def add(self, kind: str, index: int, field: str, by: float, std: float) -> None:
        """Add to a number."""
        value, variance = self._delta.get((kind, index, field), (0.0, 0.0))
        self._delta[kind, index, field] = value + by, variance + std**2

    def adopt(self, effect: str, values: Mapping[str, Estimate]) -> bool:
        """Add an effect's values; return whether the format can hold it."""
        family, _, target = effect.partition(":")
        found = list[tuple[str, int, str, float, Estimate]]()
        for q, field, factors in RULES.get(family, ()):
            places = factors(self, target)
            if not places:
                return False
            if (one := values.get(q)) and one.value:
                found += [(*place[:2], place[2] or field, place[3], one) for place in places]
        for kind, index, field, factor, one in found:
            if field == "armature":  # frictions on rates are of the inertia with it
                dof, by = self.file.jnt_dofadr[index], factor * one.value
                if self.now.dof_armature[dof] + by < 0:
                    return False
                self.now.dof_armature[dof] += by
            self.add(kind, index, field, factor * one.value, abs(factor) * one.std)
        return bool(found)

    @property
    def numbers(self) -> tuple[Number, ...]:
        """The numbers that differ from those of the file."""
        found = []
        for (kind, index, field), (by, variance) in self._delta.items():
            was, std = value_of(self.file, kind, index, field), math.sqrt(variance)
            name = f"{self._called(kind, index)}.{field}"
            unit = self._unit(kind, index, field)
            found.append(Number(was + by, std, unit, was, kind, index, name, field))
        return tuple(found)

    # -- where an effect acts

    def dof(self, state: str) -> int:
        """Return the degree of freedom of a hinge's or slide's velocity or position, else -1."""
        names, nv = list(states_of(self.file)), self.file.nv
        dof = names.index(state) % nv if state in names[: 2 * nv] else -1
        single = dof >= 0 and self.file.jnt_type[self.file.dof_jntid[dof]] >= SLIDE
        return dof if single else -1

    def actuator(self, name: str) -> int:
        """Return the index of the actuator of an input, -1 for the torque of a joint."""
        controls = self.stepper.controls
        one = controls.columns[controls.names.index(name)]
        plain = getattr(self.file, "nactuator", self.file.nu) == self.file.nu
        return int(one) if plain and not controls.torques else -1

    def push(self, name: str) -> float:
        """Return the torque on its joint by a unit of an input; 0 if it is not proportional."""
        i = self.actuator(name)
        if i < 0:
            return float(self.stepper.controls.torques)
        single = self.now.actuator_trntype[i] == JOINT and self.now.actuator_dyntype[i] == 0
        if not single or self.now.actuator_gaintype[i]:
            return 0.0
        return float(self.now.actuator_gainprm[i, 0] * self.now.actuator_gear[i, 0])

    def inertia(self, dof: int) -> float:
        """Return a joint's inertia if it is constant and its own, else 0."""
        mj, model = self.mj, self.now
        rng, data, unit = np.random.default_rng(0), mj.MjData(model), np.eye(model.nv)[[dof]]
        pushed = np.zeros((POSES, model.nv))  # rates by a unit of torque
        for row in pushed:
            data.qpos[:] = model.qpos0
            mj.mj_integratePos(model, data.qpos, rng.uniform(-2, 2, model.nv), 1.0)
            mj.mj_forward(model, data)
            mj.mj_solveM(model, data, row[None], unit)
        own = pushed[0, dof]
        apart = np.abs(pushed - own * unit).max()
        return float(1 / own) if apart < INERTIA_CONSTANT * own else 0.0

    def _called(self, kind: str, index: int) -> str:
        name = self.mj.mj_id2name(self.file, _object(self.mj, kind), index)
        return name or f"{kind}{index}"

    def _unit(self, kind: str, index: int, field: str) -> str:
        unit = FIELDS[field].unit if field in FIELDS else MORE[field][1]
        slides = kind == "joint" and self.file.jnt_type[index] == SLIDE
        return SLIDE_UNITS.get(unit, unit) if slides else unit


def value_of(model: Any, kind: str, index: int, field: str) -> float:
    """Return a number of a compiled model."""
    if field in MORE:
        return float(MORE[field][0](model, index))
    array, column, factor = FIELDS[field].places[0]
    at: Any = index if column is None else (index, column)
    at = int(model.jnt_dofadr[index]) if array.startswith("dof_") else at
    return float(np.ravel(getattr(model, array)[at])[0]) / factor


def _tau(model: Any, i: int) -> float:
    return float(model.actuator_dynprm[i, 0]) * bool(model.actuator_dyntype[i])


# fields that no parameter of the adapter names: how to read them, and their units
MORE: dict[str, tuple[Callable[[Any, int], float], str]] = {
    "delay": (lambda m, i: float(getattr(m, "actuator_delay", np.zeros(m.nu))[i]), "s"),
    "lag": (_tau, "s"),
}


def _object(mj: Any, kind: str) -> int:
    return int(getattr(mj.mjtObj, f"mjOBJ_{kind.upper()}"))


# an element and its index, another field than the rule's or "", and the factor of its number
Place = tuple[str, int, str, float]


def _driven(held: Held, target: str) -> list[Place]:
    """Return the joint whose velocity an input drives, and the torque by a unit of that input."""
    tau, _, w = target.partition("<-")
    return _joint(held, held.dof(w), held.push(tau))


def _of_rate(held: Held, target: str) -> list[Place]:
    """Return the joint of a rate, and its inertia."""
    dof = held.dof(target)
    return _joint(held, dof, held.inertia(dof) if dof >= 0 else 0.0)


def _joint(held: Held, dof: int, factor: float) -> list[Place]:
    return [("joint", int(held.file.dof_jntid[dof]), "", factor)] if dof >= 0 and factor else []


def _actuators(held: Held, target: str) -> list[Place]:
    """Return the actuators of inputs joined by "+"; none if one of them is not an actuator."""
    found = [held.actuator(name) for name in target.split("+")]
    return [("actuator", i, "", 1.0) for i in found] if min(found) >= 0 else []


def _delayed(held: Held, target: str) -> list[Place]:
    return _actuators(held, target) if hasattr(held.file, "actuator_delay") else []


def _lagged(held: Held, target: str) -> list[Place]:
    """Return the actuators, unless one has a lag: there is no second one in a row."""
    each = _actuators(held, target)
    return [] if any(held.file.actuator_dyntype[i] for _, i, *_ in each) else each


def _amplified(held: Held, target: str) -> list[Place]:
    """Return the actuators with their gears, or gains where a force is limited or fed back."""
    now, found = held.now, list[Place]()
    for kind, i, *_ in _actuators(held, target):
        gear = not (now.actuator_biastype[i] or now.actuator_forcelimited[i])
        was = now.actuator_gear[i, 0] if gear else now.actuator_gainprm[i, 0]
        found.append((kind, i, "" if gear else "gain", float(was)))
    return found


Rule = tuple[str, str, Callable[[Held, str], list[Place]]]
# of a family, each quantity with the field that holds it, and where that is
RULES: dict[str, tuple[Rule, ...]] = {
    "joint_friction": (("c", "frictionloss", _driven), ("b", "damping", _driven)),
    "coulomb_friction": (("c", "frictionloss", _of_rate),),
    "viscous_friction": (("k", "damping", _of_rate),),
    "added_inertia": (("J", "armature", _driven),),
    "input_gain": (("g", "gear", _amplified),),
    "delay": (("d", "delay", _delayed),),
    "first_order_lag": (("tau", "lag", _lagged),),
}
