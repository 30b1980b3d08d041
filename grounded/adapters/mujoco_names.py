"""Names of a MuJoCo model's joints and actuators in a Model, and its parameters by name.

Parameters are named "element.field": "pole.mass", "elbow.frictionloss", "motor.gear".

A parameter is one number in the file. It occurs in one or several places of an MjModel; setting all
of them gives the model that MuJoCo would compile from a file with that number.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from grounded.checks import refused, unknown, wrong
from grounded.model import Param

FREE, BALL, SLIDE, HINGE = 0, 1, 2, 3  # mjtJoint


class Controls(NamedTuple):
    """The inputs: names, units, and indices in ctrl (nu) or in qfrc_applied (nv)."""

    names: Sequence[str]
    units: Sequence[str]
    columns: Sequence[int]
    torques: bool


def states_of(compiled: Any) -> dict[str, str]:
    """Return units by state: positions in the order of qvel, then velocities, activations."""
    positions: dict[str, str] = {}
    velocities: dict[str, str] = {}
    for j in range(compiled.njnt):
        name, kind = joint_name(compiled, j), compiled.jnt_type[j]
        if kind == FREE:
            positions |= {f"{name}_{axis}": "m" for axis in "xyz"}
            velocities |= {f"{name}_v{axis}": "m/s" for axis in "xyz"}
        if kind in (FREE, BALL):
            positions |= {f"{name}_r{axis}": "rad" for axis in "xyz"}
            velocities |= {f"{name}_w{axis}": "rad/s" for axis in "xyz"}
        else:
            unit = "m" if kind == SLIDE else "rad"
            positions[name], velocities[f"{name}_vel"] = unit, f"{unit}/s"
    if not positions:
        raise refused("given.no_input", "MuJoCo model", what="joint")
    activations: dict[str, str] = {}
    for i in range(_actuators(compiled)):
        count = int(compiled.actuator_actnum[i]) if compiled.actuator_actadr[i] >= 0 else 0
        name = f"{_actuator_name(compiled, i)}_act"
        activations |= {f"{name}{k or ''}": "1" for k in range(count)}
    return positions | velocities | activations


def kept_states(compiled: Any, without: Sequence[str]) -> NDArray[np.bool_]:
    """Return which of the file's states are the model's, (nv + nv + na,), `without` some joints."""
    names = [joint_name(compiled, j) for j in range(compiled.njnt)]
    for name in without:
        if name not in names:
            raise unknown("joint", name, names, where="without")
    moving = np.array([names[j] not in without for j in compiled.dof_jntid], bool)
    if not moving.any():
        raise wrong("without", list(names), below=str(len(names)))
    activations = len(states_of(compiled)) - 2 * compiled.nv
    return np.concatenate([moving, moving, np.ones(activations, bool)])


def ranges_of(compiled: Any) -> dict[str, tuple[float, float]]:
    """Return (low, high) by name of every hinge and slide that the file limits."""
    single = (compiled.jnt_type >= SLIDE) & (compiled.jnt_limited != 0)
    return {
        joint_name(compiled, int(j)): (
            float(compiled.jnt_range[j, 0]),
            float(compiled.jnt_range[j, 1]),
        )
        for j in np.flatnonzero(single)
    }


def unmoved_joints(compiled: Any) -> tuple[str, ...]:
    """Return the joints that no actuator can move, see `mujoco.model`."""
    driven = _driven_trees(compiled)
    if not driven.any():
        return ()
    still = [j for j in range(compiled.njnt) if not driven[_tree(compiled, j)]]
    return tuple(joint_name(compiled, j) for j in still)


def _driven_trees(compiled: Any) -> NDArray[np.bool_]:
    """Return which kinematic trees an actuator, a tendon, an equality or a contact may move."""
    driven = np.zeros(compiled.ntree, bool)
    if not compiled.nu:
        return driven
    import mujoco  # type: ignore[import-untyped]

    # what touches, as far as the file lets any geom touch another one
    if not compiled.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT.value:
        touches = (compiled.geom_contype != 0) | (compiled.geom_conaffinity != 0)
        trees = compiled.body_treeid[compiled.geom_bodyid[touches]]
        driven[trees[trees >= 0]] = True
    # what tendons and equalities connect is not followed: all that they name may move
    wrapped = compiled.wrap_type
    of = np.full(compiled.nwrap, -1)  # the body of each
    joints = wrapped == mujoco.mjtWrap.mjWRAP_JOINT.value
    sites = wrapped == mujoco.mjtWrap.mjWRAP_SITE.value
    of[joints] = compiled.jnt_bodyid[compiled.wrap_objid[joints]]
    of[sites] = compiled.site_bodyid[compiled.wrap_objid[sites]]
    trees = compiled.body_treeid[of[of >= 0]]
    driven[trees[trees >= 0]] = True
    if compiled.neq:
        driven[:] = True
    # the slopes of joint torques by the controls
    data = mujoco.MjData(compiled)
    mujoco.mj_forward(compiled, data)
    moment = np.zeros((len(data.moment_rownnz), compiled.nv))
    mujoco.mju_sparse2dense(
        moment, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind
    )
    driven[compiled.dof_treeid[(moment != 0).any(axis=0)]] = True
    return driven


def _tree(compiled: Any, j: int) -> int:
    return int(compiled.dof_treeid[compiled.jnt_dofadr[j]])


def controls_of(compiled: Any, inputs: str | Sequence[str], states: Mapping[str, str]) -> Controls:
    """Return the inputs selected by `inputs`, see `mujoco.model`."""
    single = [j for j in range(compiled.njnt) if compiled.jnt_type[j] >= SLIDE]
    by_name = {joint_name(compiled, j): j for j in single}
    if inputs == "auto":
        inputs = "actuators" if compiled.nu else "torques"
    if inputs == "actuators":
        if not compiled.nu:
            raise refused("given.no_input", "MuJoCo model", what="actuator")
        names: list[str] = []
        units: list[str] = []
        columns: list[int] = []
        for i in range(_actuators(compiled)):
            name = _actuator_name(compiled, i)
            first = int(getattr(compiled, "actuator_ctrladr", range(compiled.nu))[i])
            many = int(getattr(compiled, "actuator_ctrlnum", [1] * compiled.nu)[i])
            name = f"{name}_ctrl" if name in states else name
            names += [f"{name}{k or ''}" for k in range(many)]
            units += [_effort(compiled, i)] * many
            columns += range(first, first + many)
        return Controls(names, units, columns, torques=False)
    chosen = list(by_name) if inputs == "torques" else inputs
    if inputs == "torques" and not chosen:
        raise refused("given.no_input", "MuJoCo model", what="actuator")
    if isinstance(chosen, str) or not chosen:
        raise wrong("inputs", inputs, known=("auto", "actuators", "torques", *by_name))
    for name in chosen:
        if name not in by_name:
            raise unknown("joint", name, by_name)
    slides = [compiled.jnt_type[by_name[name]] == SLIDE for name in chosen]
    return Controls(
        [
            f"{name}_{'force' if slide else 'torque'}"
            for name, slide in zip(chosen, slides, strict=True)
        ],
        ["N" if slide else "N m" for slide in slides],
        [int(compiled.jnt_dofadr[by_name[name]]) for name in chosen],
        torques=True,
    )


def limits_of(compiled: Any, controls: Controls) -> dict[str, tuple[float, float]]:
    """Return (low, high) by name of every input that has limits, see `mujoco.limits`."""
    limited, spans, at = (
        compiled.actuator_ctrllimited,
        compiled.actuator_ctrlrange,
        controls.columns,
    )
    if controls.torques:
        limited, spans = compiled.jnt_actfrclimited, compiled.jnt_actfrcrange
        at = tuple(int(compiled.dof_jntid[column]) for column in at)
    own = {name: spans[i] for name, i in zip(controls.names, at, strict=True) if limited[i]}
    return {name: (float(low), float(high)) for name, (low, high) in own.items()}


def joint_name(compiled: Any, j: int) -> str:
    """Return the joint's name; for an unnamed only joint of a body, the body's name."""
    name, body = compiled.joint(j).name, int(compiled.jnt_bodyid[j])
    if not name and compiled.body_jntnum[body] == 1:
        name = compiled.body(body).name
    return identifier(name or f"joint{j}")


def _actuator_name(compiled: Any, i: int) -> str:
    return identifier(compiled.actuator(i).name or f"actuator{i}")


def _effort(compiled: Any, i: int) -> str:
    """Return the unit of an actuator's control: N m or N if it is the force on a joint, else 1."""
    import mujoco

    single = compiled.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT
    straight = (
        compiled.actuator_dyntype[i] == mujoco.mjtDyn.mjDYN_NONE
        and compiled.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_FIXED
        and compiled.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_NONE
        and compiled.actuator_gainprm[i, 0] == compiled.actuator_gear[i, 0] == 1
    )
    kind = compiled.jnt_type[compiled.actuator_trnid[i, 0]] if single else FREE
    return {SLIDE: "N", HINGE: "N m"}.get(int(kind), "1") if straight else "1"


def _actuators(compiled: Any) -> int:
    return int(getattr(compiled, "nactuator", compiled.nu))


def identifier(name: str) -> str:
    """Convert a name in the file to a Python name; invalid characters become underscores."""
    plain = re.sub(r"\W", "_", name)
    return f"_{plain}" if plain[:1].isdigit() else plain


Place = tuple[str, Any, Any]


@dataclass(frozen=True)
class Field:
    """A field of an element: kind of element, unit, and places in MjModel.

    places: (array, column or None for the whole entry, factor); the first one has the value.
    """

    element: str  # body, joint, actuator, geom
    unit: str
    places: tuple[tuple[str, int | None, float], ...]


FIELDS = {
    "mass": Field("body", "kg", (("body_mass", None, 1.0),)),
    "damping": Field("joint", "N m s/rad", (("dof_damping", None, 1.0),)),
    "frictionloss": Field("joint", "N m", (("dof_frictionloss", None, 1.0),)),
    "armature": Field("joint", "kg m^2", (("dof_armature", None, 1.0),)),
    "stiffness": Field("joint", "N m/rad", (("jnt_stiffness", None, 1.0),)),
    "gear": Field("actuator", "1", (("actuator_gear", 0, 1.0),)),
    "gain": Field("actuator", "1", (("actuator_gainprm", 0, 1.0),)),
    "kp": Field("actuator", "1", (("actuator_gainprm", 0, 1.0), ("actuator_biasprm", 1, -1.0))),
    "kv": Field("actuator", "1", (("actuator_biasprm", 2, -1.0),)),
    "tau": Field("actuator", "s", (("actuator_dynprm", 0, 1.0),)),
    "friction": Field("geom", "1", (("geom_friction", 0, 1.0),)),
}
SLIDE_UNITS = {"N m s/rad": "N s/m", "N m": "N", "kg m^2": "kg", "N m/rad": "N/m"}


@dataclass(frozen=True, eq=False)
class Setting:
    """A parameter: its name in the Model, its unit, its value in the file, and its places."""

    spec: str  # "element.field"
    name: str
    unit: str
    nominal: float
    places: tuple[Place, ...]  # array of MjModel, index, factor (of the shape of the entry)

    def write(self, compiled: Any, value: float) -> None:
        """Set the parameter in an MjModel; call `mj_setConst` afterwards."""
        for array, index, factor in self.places:
            getattr(compiled, array)[index] = factor * value

    def param(self, given: float | tuple[float, ...] | None) -> Param:
        """Return the Param: a number gives a constant, a tuple bounds, None a lower bound of 0."""
        if given is None:
            return Param(self.nominal, self.unit, 0.0)
        if isinstance(given, int | float):
            return Param(float(given), self.unit)
        if len(given) not in (2, 3):
            raise wrong(f"parameter '{self.name}'", given, like="(value, low, high)")
        value, low, high = (self.nominal, *given) if len(given) == 2 else given
        return Param(value, self.unit, low, high)


def setting_of(mj: Any, compiled: Any, spec: str) -> Setting:
    """Return the parameter named "element.field"."""
    element, dot, name = spec.rpartition(".")
    if not dot or name not in FIELDS:
        raise unknown("parameter", spec, [f"{element or 'pole'}.{one}" for one in FIELDS])
    field = FIELDS[name]
    kind = getattr(mj.mjtObj, f"mjOBJ_{field.element.upper()}").value
    at = mj.mj_name2id(compiled, kind, element)
    if at < 0:
        count = {"body": "nbody", "joint": "njnt", "geom": "ngeom"}.get(field.element, "nu")
        known = [mj.mj_id2name(compiled, kind, i) for i in range(getattr(compiled, count))]
        raise unknown(field.element, element, [k for k in known if k], where=spec)
    places, unit = _places(compiled, field, at), field.unit
    if field.element == "joint" and compiled.jnt_type[at] == 2:
        unit = SLIDE_UNITS[unit]
    array, index, factor = places[0]
    nominal = float(np.ravel(getattr(compiled, array)[index])[0]) / factor
    if name == "mass" and nominal > 0:  # else a payload, taken as a point at the body's centre
        inertia = np.array(compiled.body_inertia[at]) / nominal
        places = (*places, ("body_inertia", at, inertia))
    return Setting(spec, identifier(f"{element}_{name}"), unit, nominal, places)


def _places(compiled: Any, field: Field, at: int) -> tuple[Place, ...]:
    """Return where MjModel stores a field of an element; a joint has an entry for each dof."""
    index: Any = at
    if field.places[0][0].startswith("dof_"):
        first = int(compiled.jnt_dofadr[at])
        index = slice(first, first + {0: 6, 1: 3}.get(int(compiled.jnt_type[at]), 1))
    return tuple(
        (array, index if column is None else (at, column), factor)
        for array, column, factor in field.places
    )
