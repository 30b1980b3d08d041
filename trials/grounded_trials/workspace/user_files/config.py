"""grounded.toml: the task, the search, how to reach the real system, how to read its logs.

Only checks that need no model are made here; names of states and inputs are checked in `folder`,
once the model is loaded. docs/configuration.md lists every key. Changes are made with tomlkit,
which keeps the user's comments and layout.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from grounded.checks import refused
from grounded.errors import GroundedError
from grounded.search.step_size import SearchOptions
from grounded_trials.store.store import write_atomically
from grounded_trials.toml_table import MUST_BE, Table, read_toml

FILE = "grounded.toml"
DRIVE = "drive.py"  # the robot's program, as `init` writes it
UNWRITTEN = "drive.py: complete measure() and send() for your robot"  # in it until the user does
NOISES = ("start", "process", "measurement")  # of a simulated system
Effects = Mapping[str, Mapping[str, float]]  # quantities by the effect's name, as they act
OFFERED = 10  # terminal weights in the comment that `init` writes, as multiples of `state`


@dataclass(frozen=True)
class ModelTable:
    """[model]: where the crude model is, and changes to its parameters and effects."""

    file: str = ""
    module: str = ""
    params: Mapping[str, float] = field(default_factory=dict)
    effects: Effects = field(default_factory=dict)
    priors: Mapping[str, float] = field(default_factory=dict)
    smoothing: float = field(default=0.05, metadata=MUST_BE["natural"])


@dataclass(frozen=True)
class TaskTable:
    """[task]: the time grid, the target and the start."""

    start: Mapping[str, float]
    latency: Mapping[str, float]
    dt: float = field(metadata=MUST_BE["positive"])
    horizon: int = field(default=1, metadata=MUST_BE["positive"])
    target: str = ""  # none: logs can be fitted and diagnosed, but nothing can be proposed
    feedback: bool = True


@dataclass(frozen=True)
class SystemTable:
    """[system]: the user's command, or a simulated system."""

    command: str = ""
    model: str = ""
    noise: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    seed: int = field(default=0, metadata=MUST_BE["natural"])


@dataclass(frozen=True)
class Config:
    """A checked grounded.toml; tables with names of states or inputs stay unchecked tables."""

    file: Path
    model: ModelTable
    task: TaskTable
    reward: Table
    limits: Table
    seen_in: str  # file name of the log that [limits] were taken from; "" if the user set them
    safety: Table
    search: SearchOptions
    system: SystemTable
    log: Table
    estimate: Table

    @property
    def reachable(self) -> bool:
        """Whether `run` can reach the system; otherwise the user runs candidates by hand.

        A program that `init` wrote can't before the user has completed it.
        """
        program, command = self.file.with_name(DRIVE), self.system.command
        if DRIVE in command and program.is_file():
            return UNWRITTEN not in program.read_text("utf-8", "replace")
        return bool(command or self.system.model)


def read_config(folder: Path) -> Config:
    """Read and check the workspace's grounded.toml."""
    table = read_toml(folder / FILE)
    table.expect({*Config.__annotations__} - {"file", "seen_in"})
    limits = table.sub("limits")
    seen_in = limits.take("seen_in", str, "")
    limits.values.pop("seen_in", None)
    return Config(
        file=folder / FILE,
        model=_model(table.sub("model")),
        task=table.sub("task").into(TaskTable),
        reward=table.sub("reward"),
        limits=limits,
        seen_in=seen_in,
        safety=table.sub("safety"),
        search=_search(table.sub("search")),
        system=_system(table.sub("system")),
        log=_log(table.sub("log")),
        estimate=table.sub("estimate"),
    )


def _model(table: Table) -> ModelTable:
    effects = dict[str, Mapping[str, float]]()
    for one in table.take("effects", list, []):
        name = one.get("name") if isinstance(one, dict) else None
        if not isinstance(name, str):
            raise table.error("effects", "effects", one)
        if name in effects:
            raise refused("given.twice", f"{table.file.name}: [model] effects", name=name)
        rest = {q: value for q, value in one.items() if q != "name"}
        effects[name] = Table(rest, table.file, f"model.effects.{name}").numbers()
    found = table.into(ModelTable, effects=effects)
    if bool(found.file) == bool(found.module):
        raise table.error("file", "one", found.file or found.module)
    return found


def _search(table: Table) -> SearchOptions:
    try:
        return table.into(SearchOptions)
    except GroundedError as error:
        raise error.at(table.file.name) from None


def _system(table: Table) -> SystemTable:
    noise = table.sub("noise")
    noise.expect(NOISES)
    kinds = dict[str, Mapping[str, float]]()
    for kind in NOISES:
        kinds[kind] = noise.sub(kind).numbers()
        for name, std in kinds[kind].items():
            if std < 0:
                raise noise.sub(kind).error(name, "natural", std)
    found = table.into(SystemTable, noise=kinds)
    if found.command and found.model:
        raise table.error("command", "alone", found.command)
    return found


def _log(table: Table) -> Table:
    """Check that each entry of [log] has a path; its other keys would have no effect without."""
    for group in map(table.sub, ("state", "input")):
        for name in group.values:
            if "path" not in (one := group.sub(name)):
                raise one.error("path", "path")
    return table


def listed(effects: Effects) -> list[dict[str, Any]]:
    """Return effects as grounded.toml and JSON list them."""
    return [{"name": name, **values} for name, values in effects.items()]


def as_toml(value: Any) -> Any:
    """Return a value for tomlkit: tables inline, several in a list on a line each."""
    import tomlkit

    if isinstance(value, Mapping):
        table = tomlkit.inline_table()
        table.update(dict(value))
        return table
    if isinstance(value, list | tuple):
        array = tomlkit.array()
        for one in value:
            array.append(as_toml(one))
        return array.multiline(len(value) > 1)
    return value


def set_keys(file: Path, table: str, **values: Any) -> None:
    """Replace keys in a table of grounded.toml; the rest of the file is unchanged.

    A value of None leaves the old one, an empty one removes the key.
    """
    import tomlkit

    document = tomlkit.parse(file.read_text(encoding="utf-8-sig"))
    put(document, table, values)
    write_atomically(file, tomlkit.dumps(document).encode())


def put(document: Any, where: str, values: Mapping[str, Any]) -> None:
    """Replace keys in a table of a parsed grounded.toml, see `set_keys`."""
    import tomlkit

    table: Any = document.setdefault(where, tomlkit.table())
    for name, value in values.items():
        if value:
            table[name] = as_toml(value)
        elif value is not None:
            table.pop(name, None)  # an empty value is equivalent to a missing key
