"""Parameters of a MuJoCo model by name: "pole.mass", "elbow.frictionloss", "motor.gear".

A parameter is one number of the file; it stands in one or several places of an MjModel, and setting
it gives the model that MuJoCo would compile from a file with that number.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from grounded.errors import GroundedError, nearest

Place = tuple[str, Any, Any]


@dataclass(frozen=True)
class Field:
    """What a field of an element means: kind of element, unit, and places in MjModel.

    places: (array, column or None for the whole entry, factor), the first one gives the value.
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
    """One parameter: its name in the Model, its unit, the file's value, where it is written."""

    name: str
    unit: str
    nominal: float
    places: tuple[Place, ...]  # array of MjModel, index, factor (of the shape of the entry)

    def write(self, compiled: Any, value: float) -> None:
        """Sets the parameter in an MjModel; `mj_setConst` must follow."""
        for array, index, factor in self.places:
            getattr(compiled, array)[index] = factor * value


def setting_of(mj: Any, compiled: Any, spec: str) -> Setting:
    """The parameter that "element.field" names.

    Raises:
        GroundedError: for a name of another shape, an unknown field, or an unknown element.
    """
    element, dot, name = spec.rpartition(".")
    if not dot or name not in FIELDS:
        raise GroundedError(
            f"a MuJoCo parameter is named element.field, such as pole.mass; found '{spec}': "
            + nearest(name, FIELDS)
        )
    field = FIELDS[name]
    kind = getattr(mj.mjtObj, f"mjOBJ_{field.element.upper()}").value
    at = mj.mj_name2id(compiled, kind, element)
    if at < 0:
        count = {"body": "nbody", "joint": "njnt", "geom": "ngeom"}.get(field.element, "nu")
        known = [mj.mj_id2name(compiled, kind, i) for i in range(getattr(compiled, count))]
        raise GroundedError(
            f"'{spec}': the MuJoCo model has no {field.element} '{element}': "
            + nearest(element, [k for k in known if k])
        )
    places, unit = _places(compiled, field, at), field.unit
    if field.element == "joint" and compiled.jnt_type[at] == 2:
        unit = SLIDE_UNITS[unit]
    array, index, factor = places[0]
    nominal = float(np.ravel(getattr(compiled, array)[index])[0]) / factor
    if name == "mass":
        if nominal <= 0:
            raise GroundedError(f"'{spec}': the body '{element}' has no mass of its own")
        inertia = np.array(compiled.body_inertia[at]) / nominal
        places = (*places, ("body_inertia", at, inertia))
    python = re.sub(r"\W", "_", f"{element}_{name}")
    return Setting(f"_{python}" if python[0].isdigit() else python, unit, nominal, places)


def _places(compiled: Any, field: Field, at: int) -> tuple[Place, ...]:
    """Where MjModel keeps a field of one element; a joint's numbers stand at each dof."""
    index: Any = at
    if field.places[0][0].startswith("dof_"):
        first = int(compiled.jnt_dofadr[at])
        index = slice(first, first + {0: 6, 1: 3}.get(int(compiled.jnt_type[at]), 1))
    return tuple(
        (array, index if column is None else (at, column), factor)
        for array, column, factor in field.places
    )
