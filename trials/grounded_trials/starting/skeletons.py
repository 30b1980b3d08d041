"""The model skeletons: the simplest equations of each kind of robot, as the text of a model.py.

Those of fixed form stand in `skeletons.toml`.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.resources import files
from typing import Any

from grounded_trials.starting import template


@dataclass(frozen=True)
class Skeleton:
    """A model as text: names with units, parameters, lines of equations."""

    kind: str
    text: str  # description, one line
    states: Mapping[str, str]
    inputs: Mapping[str, str]
    params: Mapping[str, str]  # name -> the arguments of Param
    lines: Sequence[str]  # `"state": expression` of ds/dt
    angles: tuple[str, ...] = ()
    roles: Mapping[str, object] = field(default_factory=dict)
    before: Sequence[str] = ()  # lines of code above the equations

    def source(self) -> str:
        """Return the text of model.py."""
        uses = any("np." in line for line in (*self.lines, *self.before))
        return template("model.py").format(
            text=self.text,
            numpy="import numpy as np\n\n" * uses,
            before="".join(f"    {line}\n" for line in self.before),
            lines="".join(f"        {line},\n" for line in self.lines),
            kind=self.kind,
            states=_dict(self.states),
            inputs=_dict(self.inputs),
            params="".join(f'        "{n}": Param({given}),\n' for n, given in self.params.items()),
            angles=self.angles,
            roles=dict(self.roles),
        )


def _dict(units: Mapping[str, str]) -> str:
    inside = [f'"{name}": "{unit}"' for name, unit in units.items()]
    if len(inside) < 5:
        return "{" + ", ".join(inside) + "}"
    return "{\n" + "".join(f"        {one},\n" for one in inside) + "    }"


STEADY = 0.3  # rad: if the yaw changes less than this in a log, it is a constant of the skeleton


def fixed(name: str) -> Skeleton:
    """Return a skeleton of `skeletons.toml`."""
    table = _tables()[name]
    own = {**_tables().get(table.get("base", ""), {}), **table}
    roles = own.get("roles", {})
    return Skeleton(
        own.get("base", name),
        own["text"],
        own["states"],
        own["inputs"],
        own["params"],
        own["lines"],
        tuple(own.get("angles", ())),
        {role: tuple(of) if isinstance(of, list) else of for role, of in roles.items()},
        own.get("before", ()),
    )


@cache
def _tables() -> dict[str, Any]:
    return tomllib.loads(files(__package__).joinpath("skeletons.toml").read_text("utf-8"))


def driven_by(plain: Skeleton, commands: Mapping[str, tuple[str, str]], **params: str) -> Skeleton:
    """Return a skeleton with other inputs, name and unit by the old name, and parameters."""
    new = {old: (old, unit) for old, unit in plain.inputs.items()} | dict(commands)

    def written(lines: Sequence[str]) -> list[str]:
        return [re.sub(r"\ba\.(\w+)", lambda m: f"a.{new[m[1]][0]}", line) for line in lines]

    return replace(
        plain,
        inputs=dict(new.values()),
        lines=written(plain.lines),
        before=written(plain.before),
        params={**plain.params, **params},
    )


def drone(low: float, high: float, command: str) -> Skeleton:
    """Return the drone's skeleton for the yaw of a log, from low to high [rad].

    `command` is what the log has: `yaw_command` [rad], `yaw_rate` [rad/s] or "".
    """
    if high - low >= STEADY:
        return fixed(f"drone_{command or 'yaw_rate'}")
    given = f'{(low + high) / 2:.3g}, "rad"'
    return driven_by(fixed("drone"), {}, yaw=given)


def arm(joints: Sequence[str]) -> Skeleton:
    """Return an arm with uncoupled joints and their names, in order from the base."""
    short = [re.sub(r"_?joint_?", "", joint) or joint for joint in joints]
    distinct = len(set(short)) == len(joints)
    bare = [re.sub(r"\W+", "_", joint).strip("_") for joint in (short if distinct else joints)]
    names = [name if name.isidentifier() else f"joint{i}" for i, name in enumerate(bare, start=1)]
    return Skeleton(
        "arm",
        f"An arm of {len(names)} uncoupled joints: replace them by its inertia matrix",
        {f"{n}_position": "rad" for n in names} | {f"{n}_velocity": "rad/s" for n in names},
        {f"{n}_effort": "N m" for n in names},
        {f"inertia_{n}": '0.1, "kg m^2", 0.0001, 10.0' for n in names}
        | {f"b_{n}": '0.1, "N m s", 0.0, 10.0' for n in names},
        [
            *(f'"{n}_position": s.{n}_velocity' for n in names),
            *(
                f'"{n}_velocity": (a.{n}_effort - p.b_{n} * s.{n}_velocity) / p.inertia_{n}'
                for n in names
            ),
        ],
        roles={"level": tuple(f"{n}_position" for n in names)},
    )
