"""export --library: one actuator as a small YAML file, from which another workspace begins.

    actuator: motor
    drives: elbow_vel
    unit: N m
    source: {workspace: arm, date: '2026-11-30', trials: [t0001, t0002]}
    dry_friction: {value: 0.12, std: 0.004, unit: N m}
    delay: {value: 0.021, std: 0.001, unit: s}

Each number is a quantity of an effect (`KEYS`), in the unit of the command, so that it does not
depend on the robot that the actuator is in. `init --actuators FILE` writes them as [model] effects,
and their +- as [model] priors.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from grounded import places
from grounded.adapters.mujoco import MujocoStepper
from grounded.checks import unknown, wrong
from grounded.diagnosis.parts import Estimate
from grounded.effects import param_name
from grounded.effects.joint import alone, pairs_of
from grounded.errors import GroundedError
from grounded.findings import Finding
from grounded.findings import found as finding
from grounded.model import Model
from grounded.result import Document
from grounded_trials.plain_file import open_file, unreadable
from grounded_trials.store.store import write_atomically
from grounded_trials.workspace.adoption import known_values
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.home.held import Held
from grounded_trials.workspace.last_diagnosis import usable_ids
from grounded_trials.workspace.user_files.config import listed, set_keys

# what each number of the file is: an effect of the input, its quantity
KEYS = {
    "gain": ("input_gain", "g"),
    "dry_friction": ("joint_friction", "c"),
    "viscous_friction": ("joint_friction", "b"),
    "load_dependence": ("load_friction", "k"),
    "inertia": ("added_inertia", "J"),
    "delay": ("delay", "d"),
    "lag": ("first_order_lag", "tau"),
    "dead_zone": ("dead_zone", "c"),
    "play": ("backlash", "b"),
    "rate_limit": ("rate_limit", "r"),
}
LARGEST = 2**20  # [bytes] of a YAML file
DRIVES = ("joint_friction", "load_friction", "added_inertia")  # with the speed that it drives
HELD = {"frictionloss": "dry_friction", "damping": "viscous_friction", "armature": "inertia"}
RATES = {"coulomb_friction": ("c", "dry_friction"), "viscous_friction": ("k", "viscous_friction")}


@dataclass(frozen=True, eq=False, repr=False)
class Shelved(Document):
    """An actuator written as a file."""

    file: Path
    actuator: str
    values: Mapping[str, Mapping[str, Any]]  # as `as_table`
    findings: tuple[Finding, ...] = ()


def as_table(one: Estimate) -> dict[str, Any]:
    """Return a number as the file has it; the std only if it is known."""
    std = {"std": float(f"{one.std:.4g}")} if math.isfinite(one.std) else {}
    return {"value": float(f"{one.value:.8g}"), **std, "unit": one.unit or "1"}


def export_actuator(workspace: Folder, path: str | Path, actuator: str | None = None) -> Shelved:
    """Write what is known of one actuator as a YAML file that another workspace begins from.

    Args:
        workspace: the workspace.
        path: the file.
        actuator: the input; None: the only one.

    Raises:
        GroundedError: if the model has several inputs and none is named, or nothing is known of it.
    """
    model, path, name = workspace.base_model, Path(path), actuator
    if name is None and model.m == 1:
        name = model.input_names[0]
    if name not in model.input_names:
        raise unknown("input", name or "", model.input_names)
    drives = _driven(model).get(name, "")
    values = dict(_found(workspace, name, drives))
    if not values:
        raise GroundedError(finding("model.nothing_found", name))
    about = {
        "workspace": workspace.folder.resolve().name,
        "date": datetime.datetime.now(tz=datetime.UTC).date().isoformat(),
        "trials": usable_ids(workspace),
    }
    head = {"actuator": name, "drives": drives, "unit": model.inputs[name], "source": about}
    tables = {key: as_table(one) for key, one in values.items()}
    write_atomically(path, as_yaml(head | tables))
    return Shelved(path, name, tables)


def begin_with(workspace: Folder, *actuators: str) -> tuple[dict[str, Any], ...]:
    """Begin with actuators that were exported: their values as effects, their +- as priors.

    Args:
        workspace: the workspace, just made.
        actuators: FILE for the inputs with the unit of its actuator, or FILE:INPUT,INPUT.

    Returns:
        The effects.

    Raises:
        GroundedError: if a file is no actuator, or no input takes its commands.
    """
    model, effects, priors = workspace.base_model, dict[str, dict[str, float]](), dict[str, float]()
    driven = _driven(model)
    for text in actuators:
        file, _, names = text.rpartition(":") if not Path(text).is_file() else (text, "", "")
        path = Path(file or text)
        table = read_yaml(path)
        if "actuator" not in table:
            raise wrong(path.name, must="actuator")
        alike = [n for n, unit in model.inputs.items() if unit == table.get("unit")]
        inputs = names.split(",") if names else alike
        if not inputs or not {*inputs} <= {*model.input_names}:
            raise unknown("input", names, model.input_names)
        for name in inputs:
            _begin(path, table, name, driven.get(name, ""), effects, priors)
    set_keys(workspace.config.file, "model", effects=listed(effects), priors=priors)
    workspace.forget()
    _ = workspace.planner  # raises if the model can't be built from them
    return tuple(listed(effects))


def _begin(
    path: Path,
    table: Mapping[str, Any],
    name: str,
    drives: str,
    effects: dict[str, dict[str, float]],
    priors: dict[str, float],
) -> None:
    """Add the effects of one input by their names, and how sure their values are."""
    for key, (family, q) in KEYS.items():
        if key not in table:
            continue
        if family == "joint_friction" and "load_dependence" in table:
            family = "load_friction"
        if family in DRIVES and not drives:
            continue
        value, std = number_in(path, key, table[key])
        effect = f"{family}:{name}<-{drives}" if family in DRIVES else f"{family}:{name}"
        rubs = {"c": 0.0, "b": 0.0} if family.endswith("_friction") else {}
        one = effects.setdefault(effect, rubs)
        one[q] = value - 1 if key == "gain" else value
        if math.isfinite(std) and std > 0 and family != "delay":
            priors[param_name(effect, q)] = std


def _driven(model: Model) -> dict[str, str]:
    """Return the velocity that each input drives."""
    pairs = (pair.partition("<-") for pair in pairs_of(model))
    return {tau: w for tau, _, w in pairs}


def _found(workspace: Folder, name: str, drives: str) -> Iterator[tuple[str, Estimate]]:
    """Yield what is known of an actuator, in the order of KEYS."""
    known, model = known_values(workspace), workspace.base_model
    found = dict[str, Estimate]()
    if isinstance(model.step, MujocoStepper) and model.step.source is not None:
        found |= dict(_of_file(workspace, known, name, drives))
    by_unit = _gain(model, name, drives)
    for effect, values in workspace.config.model.effects.items():
        family, _, target = effect.partition(":")
        if name in target.partition("<-")[0].split("+"):
            for key, (own, q) in KEYS.items():
                same = family == own or (family == "load_friction" and own == "joint_friction")
                if same and q in values:
                    one = known[param_name(effect, q)]
                    found.setdefault(key, replace(one, value=one.value + (key == "gain")))
        elif target == drives and family in RATES and by_unit:
            q, key = RATES[family]
            one, unit = known[param_name(effect, q)], model.inputs[name]
            speed = model.states[drives].removesuffix("/s")
            unit = unit if q == "c" else f"{unit} s/{speed}"
            found.setdefault(key, Estimate(one.value / by_unit, one.std / by_unit, unit=unit))
    if late := workspace.config.task.latency.get(name):
        one = found.get("delay", Estimate(0.0, 0.0, unit="s"))
        found["delay"] = Estimate(one.value + late, one.std, unit="s")
    yield from ((key, found[key]) for key in KEYS if key in found)


def _of_file(
    workspace: Folder, known: Mapping[str, Estimate], name: str, drives: str
) -> Iterator[tuple[str, Estimate]]:
    """Yield the changed numbers of an actuator's joint in an MJCF, in the unit of its command."""
    held = Held(workspace, known)
    dof, push = held.dof(drives) if drives else -1, held.push(name)
    for one in held.numbers if dof >= 0 and push else ():
        if one.kind == "joint" and one.index == held.file.dof_jntid[dof] and one.field in HELD:
            std = one.std / abs(push)
            yield HELD[one.field], Estimate(one.value / push, std, unit=one.unit)


def _gain(model: Model, name: str, drives: str) -> float:
    """Return by how much a unit of an input accelerates what it alone drives; 0 if that varies."""
    if not drives or "+" in drives or not alone(model, name, drives):
        return 0.0
    dt, (x, u) = places.probe(model, 1e-5), places.samples(model, 2)
    _, f_u = model.system.linearise(x, u, model.values, dt)
    by = f_u[0, model.state_names.index(drives), model.input_names.index(name)]
    return float(np.asarray(by)) / dt


# small YAML files: plain tables, lists, texts and numbers, nothing executable


def read_yaml(path: Path) -> dict[str, Any]:
    """Return the table that a YAML file holds."""
    try:
        with open_file(path) as stream:
            text = stream.read(LARGEST).decode("utf-8")
        table = YAML(typ="safe", pure=True).load(text)
    except (OSError, UnicodeDecodeError, YAMLError, RecursionError, ValueError) as error:
        raise unreadable(path, str(error), kind="YAML file") from None
    if not isinstance(table, dict):
        raise wrong(path.name, must="dict")
    return {str(key): value for key, value in table.items()}


def as_yaml(table: Mapping[str, Any]) -> bytes:
    """Return a table as YAML, innermost tables on one line."""
    yaml: Any = YAML(typ="safe", pure=True)
    stream = StringIO()
    yaml.default_flow_style, yaml.width, yaml.sort_base_mapping_type_on_output = None, 1000, False
    yaml.dump(dict(table), stream)
    return stream.getvalue().encode()


def number_in(path: Path, key: str, value: Any) -> tuple[float, float]:
    """Return a value and its std (NaN if not given): a number, or a table of both."""
    table = value if isinstance(value, Mapping) else {"value": value}
    numbers: list[Any] = [table.get("value"), table.get("std", float("nan"))]
    if not all(isinstance(n, int | float) and not isinstance(n, bool) for n in numbers):
        raise wrong(key, value, must="number", where=path.name)
    return float(numbers[0]), float(numbers[1])
