"""An MJCF or URDF file from elsewhere as a Model: its lags taken out, its numbers named.

A log has no column for an actuator's activation, so a filter becomes a first-order lag.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from grounded.adapters import mujoco
from grounded.adapters.mujoco import MujocoStepper
from grounded.adapters.mujoco_names import FIELDS, identifier
from grounded.adapters.stepper import library
from grounded.model import Model
from grounded_trials.plain_file import unreadable
from grounded_trials.workspace.home.held import value_of

Effects = tuple[Mapping[str, Any], ...]
FILTERS = (2, 3)  # mjDYN_FILTER, mjDYN_FILTEREXACT
AFFINE = 1  # mjBIAS_AFFINE


def simulated_model(path: Path) -> tuple[Any, Effects]:
    """Return a file, compiled without lags, and these as effects.

    Raises:
        GroundedError: if MuJoCo can't load it.
    """
    mj = library("mujoco")
    try:
        spec = mj.MjSpec.from_file(str(path))
        whole = spec.compile()
    except ValueError as error:
        raise unreadable(path, str(error), kind="MuJoCo model") from None
    effects = list[Mapping[str, Any]]()
    for i, one in enumerate(spec.actuators):
        name = identifier(one.name or f"actuator{i}")
        if int(whole.actuator_dyntype[i]) in FILTERS:
            tau = float(whole.actuator_dynprm[i, 0])
            effects.append({"name": f"first_order_lag:{name}", "tau": tau})
            one.dyntype = mj.mjtDyn.mjDYN_NONE
    return spec.compile(), tuple(effects)


def numbers_of_file(
    compiled: Any, others: Sequence[Any] = (), like: MujocoStepper | None = None
) -> Model:
    """Return the Model of a compiled file, with the numbers as parameters that files differ in.

    Args:
        compiled: the file.
        others: files that are compared.
        like: a stepper whose inputs, time step and parameters it has.
    """
    each = [dict(_numbers(one)) for one in others]
    shared = set(each[0]).intersection(*each[1:]) if each else set[str]()
    specs = {
        n for n in shared if not math.isclose(min(e[n] for e in each), max(e[n] for e in each))
    }
    specs |= {setting.spec for setting in like.settings} if like else set()
    inputs: str | list[str] = "auto"
    if like is not None:
        joints = [name.rpartition("_")[0] for name in like.controls.names]
        inputs = joints if like.controls.torques else "actuators"
    known = dict(_numbers(compiled))
    params = {spec: known[spec] for spec in sorted(specs) if spec in known}
    step, without = (None, ()) if like is None else (like.timestep, like.without)
    return mujoco.model(compiled, params=params, inputs=inputs, without=without, timestep=step)


def _numbers(compiled: Any) -> Iterator[tuple[str, float]]:
    """Yield the named numbers of a compiled file."""
    mj = library("mujoco")
    counts = {"body": compiled.nbody, "joint": compiled.njnt, "geom": 0, "actuator": compiled.nu}
    for field, about in FIELDS.items():
        kind = int(getattr(mj.mjtObj, f"mjOBJ_{about.element.upper()}"))
        for i in range(counts[about.element]):
            name = mj.mj_id2name(compiled, kind, i)
            if not name or name == "world" or (field == "mass" and not compiled.body_mass[i]):
                continue
            servo = about.element == "actuator" and compiled.actuator_biastype[i] == AFFINE
            if (
                field == "tau"
                or (field in ("kp", "kv") and not servo)
                or (field == "gain" and servo)
            ):
                continue
            yield f"{name}.{field}", value_of(compiled, about.element, i, field)
