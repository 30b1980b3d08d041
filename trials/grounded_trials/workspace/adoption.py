"""Adoption: what a diagnosis found, taken into [model] of grounded.toml, and what is known of it.

Effects that were fitted together are adopted together, in the order of the fit, and values only
hold with the parameters that were estimated beside them: those are adopted, too, unless the trials
do not tell them or a bound cut them.

reports/adoptions.json records [model] before each adoption, so that it can be undone, how sure the
values are that were adopted or fitted, and which effects were undone: they are not suggested again.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

from grounded.checks import refused, unknown
from grounded.diagnosis.causes import sign_only
from grounded.diagnosis.parts import Diagnosis, Estimate
from grounded.effects import param_name
from grounded.errors import GroundedError, NextCommand
from grounded.findings import Finding, Quantity, found, settle
from grounded.result import UNSAID, Document, number
from grounded.result import listed as joined_names
from grounded.search.planner import Planner
from grounded_trials.store.documents import read_as, write_document
from grounded_trials.store.store import made_folder
from grounded_trials.workspace.adopted import in_order, installed_effects, planner_of, settled
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.last_diagnosis import newer_alone, read_diagnosis
from grounded_trials.workspace.new_target import to_plan
from grounded_trials.workspace.readings import taken_out, twice_in_time
from grounded_trials.workspace.user_files.config import (
    Effects,
    ModelTable,
    as_toml,
    listed,
    set_keys,
)

AGAIN, PROPOSE = NextCommand("diagnose"), NextCommand("propose")
KEPT = "adoptions.json"  # in reports/
NEGLIGIBLE_STEP = 0.1  # fraction of a control step: shorter filters and delays make no difference
NO_CHANGE = 1e-3  # relative change of a parameter that counts as none
WRITTEN = 1e-6  # relative difference of a value and what is written of it


@dataclass(frozen=True, eq=False, repr=False)
class Adopted(Document):
    """The model's effects and parameters after an adoption, or after one was undone."""

    effects: tuple[Mapping[str, Any], ...]  # all adopted effects
    params: Mapping[str, float]  # model parameters written with the new effects; undone: all
    claimed: bool = False  # whether the diagnosis claims the new effects
    jointly: tuple[str, ...] = ()  # parameters and effects determined only with the others
    along: tuple[str, ...] = ()  # late and filtering sensors that were adopted without being named
    left: Mapping[str, float] = field(default_factory=dict)  # fitted values that were not adopted
    undone: tuple[str, ...] = ()  # the effects of the adoption that was undone
    findings: tuple[Finding, ...] = ()  # what an adoption leaves to be done or known
    then: NextCommand = field(metadata=UNSAID, default=PROPOSE)

    def summary(self) -> str:
        """Return the effects that the model has now."""
        return ", ".join(str(effect["name"]) for effect in self.effects)


def _numbers(effects: Effects) -> Iterator[tuple[str, str, str, float]]:
    """Yield effect, quantity, name as a parameter and value of each number of some effects."""
    for name, values in effects.items():
        yield from ((name, q, param_name(name, q), value) for q, value in values.items())


# what a diagnosis offers


def late_open(workspace: Folder, diagnosis: Diagnosis) -> tuple[str, ...]:
    """Return the filters and delays of sensors that a diagnosis found and nothing takes out yet."""
    task, late = workspace.config.task, diagnosis.late_sensors
    if not (late and task.target and task.feedback):
        return ()
    known, gone = workspace.config.model.effects, taken_out(workspace)

    def is_open(name: str, own: Mapping[str, float]) -> bool:
        in_log = max(gone.get(one, 0.0) for one in name.partition(":")[2].split("+"))
        least = max(NEGLIGIBLE_STEP * task.dt, 2 * in_log * ("d" in own))
        return name not in known and max(own.values()) > least

    return tuple(name for name, own in late.items() if is_open(name, own))


def to_adopt(workspace: Folder, diagnosis: Diagnosis) -> NextCommand | None:
    """Return the command that acts on the claims of a diagnosis, or None if there is none.

    Filters and delays of sensors are adopted too if states are fed back: feedback gains designed
    without them make the robot oscillate. Nothing is adopted if its trials were all set aside.
    """
    made, here = diagnosis.made, {one.stored.id for one in workspace.whole_trials()}
    if made.trials and here.isdisjoint(made.trials):
        return AGAIN if here else None
    if diagnosis.changed:  # values of two robots together fit neither
        return newer_alone(diagnosis)

    # What is new, but what the user has undone; late sensors are adopted with it, or alone.
    table = workspace.config.model
    new, undone = diagnosis.open(listed(table.effects), table.params), _readable(workspace).undone
    late = tuple(name for name in late_open(workspace, diagnosis) if name not in undone)
    alone = NextCommand("adopt", late) if late else None
    claimed = diagnosis.kind in ("effect", "several") and not diagnosis.doubt
    if not claimed or {*new} <= {*undone}:
        return alone

    # A sign is flipped before anything is adopted, as the diagnosis says.
    rows = (row for row in diagnosis.ranking if row.effect in new)
    if any(sign_only(row.effect, row.params) for row in rows):
        return AGAIN

    return NextCommand("adopt", (*new, *late))


def joined(
    diagnosis: Diagnosis,
    names: Iterable[str],
    effects: Effects,
    nominal: Mapping[str, float],
    calibrated: Mapping[str, Estimate],
) -> tuple[dict[str, float], Effects]:
    """Return the parameters to set and all effects, after adding diagnosed effects to a model."""
    before, fitted = diagnosis.made.effects, [*diagnosis.joining]
    old, new = {name: dict(values) for name, values in effects.items()}, dict[str, Any]()
    params = {name: _rounded(estimate.value) for name, estimate in calibrated.items()}
    last = len(fitted)
    for name in sorted(names, key=lambda n: fitted.index(n) if n in fitted else last):
        values = diagnosis.values(name)
        family, _, target = name.partition(":")
        if family == "parameter":
            params[target] = _rounded(nominal.get(target, math.nan) + values["d"])
        elif name in before:  # a further delay adds to the adopted one, if that still is
            old.get(name, {})["d"] = _rounded(float(before[name]["d"]) + values["d"])
        else:
            new[name] = {q: _rounded(value) for q, value in values.items()}
    own, settled_old = settled(params, old)
    own, settled_new = settled(own, new)
    return own, in_order(settled_old, settled_new)


def _rounded(value: float) -> float:
    if not math.isfinite(value):
        raise refused("model.not_adoptable", "it", why="unvalued", then=AGAIN)
    return float(f"{float(value):.8g}")


def _nominal(workspace: Folder, diagnosis: Diagnosis) -> dict[str, float]:
    """Return the values that parameters had when the diagnosis was made; else those of now."""
    own = {name: float(one.value) for name, one in workspace.base_model.params.items()}
    return own | dict(diagnosis.made.nominal)


# adopting


def adopt_effects(workspace: Folder, *effects: str, parameters: bool = True) -> Adopted:
    """Add effects of the last diagnosis to the model in grounded.toml, or raise and write nothing.

    If the diagnosis calibrated the model's own parameters together with the effects that it claims,
    these parameters are adopted too. An effect that it does not claim was fitted instead of those,
    without parameters.

    Args:
        workspace: the workspace.
        effects: `family:target` names of effects that were claimed together, or of one effect.
        parameters: also take over the model parameters that were calibrated together with them.
    """
    diagnosis = read_diagnosis(workspace.reports)
    if diagnosis is None:
        raise refused("search.undiagnosed", then=AGAIN)
    asked = names = _with_curves(diagnosis, list(dict.fromkeys(effects)))
    claimed = _claims_all(workspace, diagnosis, names)
    physics = [name for name in names if name not in diagnosis.late_sensors]
    if physics and {*diagnosis.effects} <= {*physics}:
        names = list(dict.fromkeys([*names, *late_open(workspace, diagnosis)]))

    # The model with them.
    whole_fit = parameters and bool(physics) and claimed
    calibrated = diagnosis.adoptable if whole_fit else {}
    file, model, known = workspace.config.file, workspace.config.model, diagnosis.made
    nominal = _nominal(workspace, diagnosis)
    own, adopted = joined(diagnosis, names, model.effects, nominal, calibrated)
    if twice := twice_in_time(workspace, adopted):
        raise GroundedError(twice)
    params = dict(model.params) | own
    earlier = kept(workspace).adoptions  # raises before anything is written, as does
    planner_of(workspace.task, adopted)  # a model that can't be built from these effects

    # Write it, how it can be undone, and how sure the values are.
    every = listed(adopted)
    set_keys(file, "model", params=params if own else None, effects=every or None)
    after = {"effects": every, "params": params}
    step = Step(tuple(names), _written(model), after)
    now = own | {name: value for _, _, name, value in _numbers(adopted)}
    std = {name: e.std for name, e in calibrated.items()}
    for row in (row for row in diagnosis.ranking if row.effect in names):
        family, _, target = row.effect.partition(":")
        for q, e in row.params.items():
            std[target if family == "parameter" else param_name(row.effect, q)] = e.std
    sure = {n: (now[n], s) for n, s in std.items() if n in now and math.isfinite(s)}
    keep(workspace, sure, adoptions=(*earlier, step))

    # What changed in the fit, so that its prediction errors include it, but is not adopted.
    left = {
        name: e
        for name, e in (diagnosis.parameters if whole_fit else {}).items()
        if name not in {*calibrated, *own} and (old := known.nominal.get(name)) is not None
        if abs(e.value - old) > NO_CHANGE * max(abs(old), e.std)
    }
    called = {name: f"{q} of {effect}" for effect, q, name, _ in _numbers(model.effects)}
    told = list[Finding]()
    for name, e in left.items():
        was, value = Quantity(nominal[name], e.unit), Quantity(e.value, e.unit)
        told.append(found("model.not_told", called.get(name, name), kept=was, value=value))
    return Adopted(
        effects=tuple(every),
        params=own,
        claimed=claimed,
        jointly=(
            *(name for name in own if name in {*calibrated} & {*diagnosis.jointly}),
            *(name for name in names if name in diagnosis.combined),
        ),
        along=tuple(name for name in names if name not in asked),
        left={name: one.value for name, one in left.items()},
        findings=settle(told),
        then=to_plan(workspace),
    )


def _with_curves(diagnosis: Diagnosis, names: list[str]) -> list[str]:
    """Replace `correction:v`, or some of its curves, by all of them."""
    one, curves = diagnosis.correction, _curves(diagnosis)
    asked = [n for n in names if n.startswith("correction:")]
    if one is None or not asked or not {*asked} <= {f"correction:{one.channel}", *curves}:
        return names
    if not one.adoptable:
        raise refused("model.not_adoptable", asked[0], why="worse")
    if missing := tuple(name for name in diagnosis.effects if name not in names):
        then = NextCommand("adopt", (*missing, asked[0]))
        raise refused("model.not_adoptable", asked[0], why="together", effect=missing, then=then)
    return [name for name in names if name not in asked] + curves


def _curves(diagnosis: Diagnosis) -> list[str]:
    one = diagnosis.correction
    return [] if one is None else [curve.effect for curve in one.curves]


def _claims_all(workspace: Folder, diagnosis: Diagnosis, names: Sequence[str]) -> bool:
    """Return whether the verdict claims all the effects, but for late sensors."""
    physics = [name for name in names if name not in diagnosis.late_sensors]
    if diagnosis.changed and physics:
        raise refused("gap.next.changed", then=newer_alone(diagnosis))
    before, own = diagnosis.made.effects, [*diagnosis.effects, *_curves(diagnosis)]
    known = {*(row.effect for row in diagnosis.ranking), *own, *diagnosis.late_sensors}
    adopted = {*workspace.config.model.effects} - {*before}.intersection(known)
    for name in names:
        if name not in known | adopted:
            raise unknown("effect", name, known, "the last diagnosis")
        if name in adopted:
            raise refused("model.not_adoptable", name, why="adopted")
    if diagnosis.no_cause and physics:
        raise refused("gap.too_few", then=AGAIN)
    rivals = [name for name in physics if name not in own]
    if rivals and len(physics) > 1:
        then = NextCommand("adopt", diagnosis.effects or (rivals[0],))
        raise refused("model.not_adoptable", *rivals, why="rival", then=then)
    return not rivals


def undo_adoption(workspace: Folder) -> Adopted:
    """Undo the last `adopt`: restore the effects and params of grounded.toml.

    Raises:
        GroundedError: if nothing is left to undo, or [model] was changed since.
    """
    known, file, model = kept(workspace), workspace.config.file, workspace.config.model
    if not known.adoptions:
        raise refused("model.edited", file, effects=", ".join(model.effects) or "none")
    last = known.adoptions[-1]
    params, effects = last.before["params"], last.before["effects"]
    if _written(model) != last.after:
        had = joined_names(f"{name} = {as_toml(v).as_string()}" for name, v in last.before.items())
        raise refused("model.edited", file, adopted=last.names, had=had)
    set_keys(file, "model", params=params, effects=effects)
    keep(workspace, adoptions=known.adoptions[:-1], undone=(*known.undone, *last.names))
    then = to_plan(workspace)
    return Adopted(effects=tuple(effects), params=params, undone=last.names, then=then)


def _written(model: ModelTable) -> dict[str, Any]:
    """Return the parts of [model] that an adoption may change, for JSON."""
    return {"effects": listed(model.effects), "params": dict(model.params)}


# what is kept of the model beside grounded.toml


@dataclass(frozen=True, eq=False, repr=False)
class Step(Document):
    """One adoption: [model] before and after it."""

    names: tuple[str, ...]
    before: Mapping[str, Any]
    after: Mapping[str, Any]


@dataclass(frozen=True, eq=False, repr=False)
class Kept(Document):
    """What is known of the model's values, and of how they were found."""

    adoptions: tuple[Step, ...] = ()  # those that can be undone, oldest first
    undone: tuple[str, ...] = ()  # effects that were undone since the last diagnosis
    values: Mapping[str, tuple[float, ...]] = field(default_factory=dict)  # with their std


def kept(workspace: Folder) -> Kept:
    """Read what is kept of a workspace's model."""
    return read_as(workspace.reports / KEPT, Kept, mend="delete") or Kept()


def keep(
    workspace: Folder, values: Mapping[str, tuple[float, ...]] = MappingProxyType({}), **more: Any
) -> None:
    """Keep values of the model with their +-, and change other fields of `Kept`."""
    made_folder(workspace.reports)
    before = kept(workspace)
    after = replace(before, values={**before.values, **values}, **more)
    write_document(workspace.reports / KEPT, after.to_json())


def _readable(workspace: Folder) -> Kept:
    """Read what is kept; a damaged file counts as none."""
    try:
        return kept(workspace)
    except GroundedError:
        return Kept()


def diagnosed_again(workspace: Folder) -> None:
    """Forget which effects were undone: a newer diagnosis may claim them again."""
    if kept(workspace).undone:
        keep(workspace, undone=())


# the model as it is now


def numbers_in(workspace: Folder) -> dict[str, tuple[float, str]]:
    """Return the numbers of the adopted effects with their units, as they are called."""
    known = known_values(workspace)
    return {
        f"{q} of {effect}": (value, known[name].unit)
        for effect, q, name, value in _numbers(workspace.config.model.effects)
    }


def known_values(workspace: Folder) -> dict[str, Estimate]:
    """Return the values of parameters and adopted effects, by parameter name, with their +-.

    The +- is that of the adoption or the fit that wrote this value, else NaN. Units are "" beside
    another adopted effect, and of a package that is not installed.
    """
    kept, model = _readable(workspace).values, workspace.base_model
    now = {name: (one.value, one.unit) for name, one in model.params.items()}
    for effect, q, name, value in _numbers(workspace.config.model.effects):
        units = dict[str, str]()
        with suppress(GroundedError):
            units = {one.name: one.unit for one in installed_effects().effect(effect, model).free}
        now[name] = value, units.get(q, "")
    found_values = dict[str, Estimate]()
    for name, (value, unit) in now.items():
        at, std = kept[name] if len(kept.get(name, ())) == 2 else (math.nan, math.nan)
        same = math.isclose(at, value, rel_tol=WRITTEN, abs_tol=1e-12)
        found_values[name] = Estimate(value, std if same else math.nan, unit=unit)
    return found_values


@dataclass(frozen=True, eq=False)
class Better:
    """A model to compare the crude one with, and its name in a legend."""

    planner: Planner
    name: str


def better_model(workspace: Folder, diagnosis: Diagnosis | None) -> Better | None:
    """Return the diagnosed model, else the one with adopted effects; None if there is neither."""
    table, task = workspace.config.model, workspace.task
    if diagnosis is not None:
        new = diagnosis.open(listed(table.effects), table.params)
        names = [name for name in diagnosis.joining if name in new and diagnosis.ranked(name)]
        known = {n: e for n, e in diagnosis.adoptable.items() if math.isfinite(e.value)}
        nominal = _nominal(workspace, diagnosis)
        params, effects = joined(diagnosis, names, table.effects, nominal, known)
        own = {name: value for name, value in params.items() if name in task.model.params}
        if own or names:
            estimated = task.with_model(task.model.with_values(own))
            return Better(planner_of(estimated, effects), "as diagnosed")
    return Better(workspace.planner, "with adopted effects") if table.effects else None


def adopted_rows(workspace: Folder) -> tuple[tuple[str, str], ...]:
    """Return name and values of each adopted effect, then of each changed parameter.

    That is how a workspace's model differs from model.py.
    """
    table, found = workspace.config.model, list[tuple[str, str]]()
    known = known_values(workspace) if table.effects or table.params else {}
    for name, values in table.effects.items():
        numbers = (f"{q} = {known[param_name(name, q)].text}" for q in values)
        found.append((name, ", ".join(numbers)))
    for name, param in workspace.origin.model.params.items() if table.params else ():
        if table.params.get(name, param.value) != param.value:
            found.append((name, f"{known[name].text}, was {number(param.value)}"))
    return tuple(found)
