"""diagnose --compare of two models, or sets of values: which one to trust, where, and of what.

A model comes from a workspace (a folder, `.` for this one), a model.py, an MJCF or URDF file, or a
YAML file with values for this workspace's model. Both predict the stored trials as they are
(`grounded.diagnosis.rivals`). Each number in which they differ is then exchanged alone: if neither
model predicts better or worse with the other's value, the trials cannot decide it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from grounded.accounts.sound_trials import sound_trials
from grounded.adapters import mujoco
from grounded.adapters.mujoco import MujocoStepper
from grounded.adapters.mujoco_names import FIELDS, identifier
from grounded.adapters.stepper import library
from grounded.checks import same_names
from grounded.diagnosis.error_report import BRIEF
from grounded.diagnosis.levels import LEAST, SURE
from grounded.diagnosis.rivals import Predicted, predicted
from grounded.errors import GroundedError
from grounded.findings import Finding, Quantity
from grounded.findings import found as finding
from grounded.model import Model
from grounded.result import Document
from grounded_trials.plain_file import unreadable
from grounded_trials.workspace.adopted import planner_of
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.home.held import value_of
from grounded_trials.workspace.home.library import number_in, read_yaml
from grounded_trials.workspace.last_fit import chosen, ids_of
from grounded_trials.workspace.readings import one_message
from grounded_trials.workspace.user_files.model_file import load_module, model_in

Effects = tuple[Mapping[str, Any], ...]


@dataclass(frozen=True, eq=False)
class Rival:
    """One of two models that are compared.

    Attributes:
        label: what the user called it.
        model: with its values.
        effects: as in [model] effects.
        latency: of inputs [s].
        compiled: of MuJoCo, the compiled file with its values.
    """

    label: str
    model: Model
    effects: Effects
    latency: Mapping[str, float]
    compiled: Any = None

    def numbers(self) -> dict[str, Any]:
        """Return what it consists of by name: parameters, latencies, effects (None: without it)."""
        own = {name: param.value for name, param in self.model.params.items()}
        late = {f"latency:{name}": value for name, value in self.latency.items()}
        return {**own, **late, **{str(effect["name"]): effect for effect in self.effects}}

    def having(self, name: str, value: Any) -> Rival:
        """Return it with one number or effect of another model; None removes an effect."""
        if name in self.model.params:
            return replace(self, model=self.model.with_values({name: value}))
        if name.startswith("latency:"):
            late = {**self.latency, name.partition(":")[2]: value or 0.0}
            return replace(self, latency=late)
        effects = [effect for effect in self.effects if effect["name"] != name]
        at = next((i for i, e in enumerate(self.effects) if e["name"] == name), len(effects))
        if value is not None:
            effects.insert(at, value)
        return replace(self, effects=tuple(effects))


@dataclass(frozen=True, eq=False)
class Decided(Document):
    """What the trials say of a state, or of a number, in which two models differ."""

    better: str | None  # the label of the model that predicts better; None if it can't be decided
    values: tuple[str, str] | None = field(metadata=BRIEF, default=None)  # of a number
    errors: tuple[float, float] | None = field(metadata=BRIEF, default=None)  # rms of a state


@dataclass(frozen=True, eq=False, repr=False)
class Compared(Document):
    """Which of two models predicts the stored trials better."""

    models: tuple[str, str]  # what the user called them
    better: str | None  # one of them; None if it can't be decided
    gain: Quantity  # mean log ratio of errors, of the second over the first
    ahead_s: float  # how far ahead the errors are
    where: Mapping[str, Decided]  # by state
    numbers: Mapping[str, Decided]
    trials: tuple[str, ...]
    findings: tuple[Finding, ...]

    def summary(self) -> str:
        """Return what was found."""
        return self.findings[0].sentence


def compare_models(
    workspace: Folder,
    first: str | Path,
    second: str | Path,
    trials: Sequence[str] = (),
    *,
    progress: Callable[[str], None] | None = None,
) -> Compared:
    """Compare two models on the stored trials: which predicts better, where, and which numbers.

    Args:
        workspace: the workspace.
        first: a folder (a workspace; "." for this one), a model.py, an MJCF or URDF file, or a YAML
            file with values of this model.
        second: likewise.
        trials: short names such as t0007; empty: all usable trials.
        progress: called with each stage.

    Raises:
        GroundedError: if one can't be read, or has other states or inputs than this workspace.
    """
    tick = progress or (lambda stage: None)
    one, other = _aligned(workspace, *(_rival(workspace, str(text)) for text in (first, second)))
    used = chosen(workspace, trials).trials
    looked = sound_trials(workspace.task, used, (), None, one_message(workspace)).trials

    def errors(rival: Rival) -> Predicted:
        own = replace(workspace.task, model=rival.model, latency=_latency(rival))
        planner = planner_of(own, rival.effects)
        hidden = planner.plan.model.state_names[own.model.n :]
        return predicted(planner.plan, [planner.lift(trial) for trial in looked], hidden)

    tick("predict")
    a, b = errors(one), errors(other)
    labels = (one.label, other.label)
    mine, theirs = one.numbers(), other.numbers()
    numbers = dict[str, Decided]()
    for name in (n for n in {**mine, **theirs} if not _same(mine.get(n), theirs.get(n))):
        tick(name)
        swapped = one.having(name, theirs.get(name)), other.having(name, mine.get(name))
        votes = {a.better(errors(swapped[0])), -b.better(errors(swapped[1]))} - {0}
        better = None if len(votes) != 1 else labels[1] if 1 in votes else labels[0]
        numbers[name] = Decided(better, values=(_text(mine.get(name)), _text(theirs.get(name))))
    return _result(labels, a, b, numbers, ids_of(used))


def _result(
    labels: tuple[str, str],
    a: Predicted,
    b: Predicted,
    numbers: Mapping[str, Decided],
    trials: tuple[str, ...],
) -> Compared:
    """Return the comparison of two models with the same trials."""
    way, gain = a.better(b), a.gain(b)
    better = {1: labels[1], -1: labels[0]}.get(way)
    ahead = len(a.by_horizon) - 2 if len(a.by_horizon) > 1 else 0  # the last one before the whole
    each = [a.ruler.comparison.of_channel(i) for i in range(len(gain.channels))]
    paired = (one(a.errors, b.errors).paired for one in each)
    sure = [abs(more) > max(SURE * error, LEAST) for more, error in paired]
    (ahead_s, first), (_, second) = a.by_horizon[ahead], b.by_horizon[ahead]
    where = {
        name: Decided(labels[int(more > 0)] if clear else None, errors=(first[name], second[name]))
        for name, more, clear in zip(first, gain.channels, sure, strict=True)
    }
    size = Quantity(gain.paired[0], "1", gain.paired[1])
    if better:
        worse = labels[0] if way > 0 else labels[1]
        ratio = float(np.exp(abs(gain.mean)))
        told = [finding("gap.trusted", better, better=better, worse=worse, ratio=ratio)]
    else:
        told = [finding("gap.undecided", *labels, models=True)]
    if open_ := [name for name, one in numbers.items() if not one.better]:
        told.append(finding("gap.undecided", *open_))
    return Compared(labels, better, size, ahead_s, where, numbers, trials, tuple(told))


def _rival(workspace: Folder, text: str) -> Rival:
    """Return the model that a path names."""
    path, here = Path(text), workspace.config
    if path.is_dir() or path.suffix == ".toml":
        other = workspace if text == "." else Folder(path if path.is_dir() else path.parent)
        late, effects = other.config.task.latency, other.config.model.effects
        return Rival(text, other.base_model, tuple(effects), late)
    if not path.is_file():
        raise GroundedError(finding("file.missing", text))
    if path.suffix == ".py":
        return Rival(
            text, model_in(load_module(path.resolve().parent, path.name)), (), here.task.latency
        )
    if path.suffix in (".yaml", ".yml"):
        return _of_values(workspace, path)
    return _of_file(workspace, path)


def _of_file(workspace: Folder, path: Path) -> Rival:
    """Return the model of an MJCF or URDF file; its delays and lags are latency and effects."""
    compiled, effects = simulated_model(path)
    model = numbers_of_file(workspace, compiled)
    late = getattr(model.step, "latency", {})
    return Rival(str(path), model, effects, late, compiled)


def _of_values(workspace: Folder, path: Path) -> Rival:
    """Return this workspace's model with the values of a YAML file."""
    table, model = read_yaml(path), workspace.base_model
    params = table.pop("params", {}) or {}
    effects = table.pop("effects", None)
    values = {**params, **table}
    given = {str(n): number_in(path, str(n), value)[0] for n, value in values.items()}
    own = tuple(workspace.config.model.effects)
    if effects is not None:
        own = tuple(
            {"name": str(name)} | {q: number_in(path, q, v)[0] for q, v in dict(c).items()}
            for name, c in dict(effects).items()
        )
    return Rival(str(path), model.with_values(given), own, workspace.config.task.latency)


def _aligned(workspace: Folder, one: Rival, other: Rival) -> tuple[Rival, Rival]:
    """Return two models with the same states, and of files with the numbers they differ in."""
    if one.compiled is not None or other.compiled is not None:
        pair = [
            replace(rival, compiled=rival.compiled or _compiled(rival)) for rival in (one, other)
        ]
        files = [rival.compiled for rival in pair if rival.compiled is not None]
        if len(files) == len(pair):
            models = (numbers_of_file(workspace, rival.compiled, files) for rival in pair)
            one, other = (replace(r, model=m) for r, m in zip(pair, models, strict=True))
    base = workspace.base_model
    for rival in (one, other):
        same_names(rival.label, "states", rival.model.state_names, base.state_names)
        same_names(rival.label, "inputs", rival.model.input_names, base.input_names)
    return one, other


def _compiled(rival: Rival) -> Any:
    """Return the compiled file of a model with its values; None if it is not MuJoCo's."""
    step = rival.model.step
    return step.compiled(rival.model.values) if isinstance(step, MujocoStepper) else None


def _latency(rival: Rival) -> Any:
    return np.array([rival.latency.get(name, 0.0) for name in rival.model.input_names])


def _same(one: Any, other: Any) -> bool:
    """Return whether two numbers, or the values of two effects, are equal."""
    if isinstance(one, float | int) and isinstance(other, float | int):
        return math.isclose(one, other, rel_tol=1e-9)
    return bool(one == other)


def _text(value: Any) -> str:
    """Return a number or an effect's values for a table."""
    if value is None:
        return "-"
    if isinstance(value, Mapping):
        return ", ".join(f"{q} {v:.4g}" for q, v in value.items() if q != "name")
    return f"{value:.4g}"


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


def numbers_of_file(workspace: Folder, compiled: Any, others: Sequence[Any] = ()) -> Model:
    """Return the Model of a compiled file, with the numbers as parameters that files differ in.

    Args:
        workspace: if its model is MuJoCo's, the file's has its inputs, time step and parameters.
        compiled: the file.
        others: files that are compared.
    """
    step = workspace.base_model.step
    like = step if isinstance(step, MujocoStepper) else None
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
    every, without = (None, ()) if like is None else (like.timestep, like.without)
    return mujoco.model(compiled, params=params, inputs=inputs, without=without, timestep=every)


def _numbers(compiled: Any) -> Iterator[tuple[str, float]]:
    """Yield the named numbers of a compiled file."""
    mj = library("mujoco")
    counts = {"body": compiled.nbody, "joint": compiled.njnt, "geom": 0, "actuator": compiled.nu}
    for name_of, about in FIELDS.items():
        kind = int(getattr(mj.mjtObj, f"mjOBJ_{about.element.upper()}"))
        for i in range(counts[about.element]):
            name = mj.mj_id2name(compiled, kind, i)
            if not name or name == "world" or (name_of == "mass" and not compiled.body_mass[i]):
                continue
            servo = about.element == "actuator" and compiled.actuator_biastype[i] == AFFINE
            if (
                name_of == "tau"
                or (name_of in ("kp", "kv") and not servo)
                or (name_of == "gain" and servo)
            ):
                continue
            yield f"{name}.{name_of}", value_of(compiled, about.element, i, name_of)
