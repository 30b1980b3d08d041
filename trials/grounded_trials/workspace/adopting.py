"""Adopt in a workspace: add diagnosed effects to the model of grounded.toml, with their values.

A diagnosis estimates the model's parameters together with the effects, so both are adopted
together. reports/adoptions.json also records how sure the adopted values are (see `adoptable`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from grounded.checks import refused
from grounded.diagnosis.parts import Diagnosis, Estimate
from grounded.errors import GroundedError, NextCommand
from grounded.findings import Finding, Quantity, settle
from grounded.findings import found as found_
from grounded.result import Result, listed
from grounded_trials.store.documents import write_document
from grounded_trials.workspace.adoptable import (
    KEPT,
    adoptions,
    check_adoptable,
    claims_all,
    joined,
    late_open,
    nominal_values,
    with_curves,
)
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.last_diagnosis import made_from, read_diagnosis
from grounded_trials.workspace.next_step import to_plan
from grounded_trials.workspace.off_target import logged_target
from grounded_trials.workspace.user_files.config import ModelTable, as_toml, set_in_model

AGAIN, PROPOSE = NextCommand("diagnose"), NextCommand("propose")
SLIGHT = 1e-3  # relative change of a parameter that counts as none


@dataclass(frozen=True)
class Left:
    """A parameter that changed in the fit of the effects and is not adopted with them."""

    called: str  # `m`, or `k of coupling:w<-th`
    kept: float  # its value in the model
    value: float  # its value in the fit of the effects
    unit: str


@dataclass(frozen=True)
class Rewritten:
    """A quantity of an effect that was part of the model before, with its new value."""

    called: str  # `d of sensor_delay:psi`
    was: float
    now: float
    unit: str


@dataclass(frozen=True, repr=False)
class Adopted(Result):
    """The model's effects and parameters after an adoption."""

    effects: tuple[Mapping[str, Any], ...]  # all adopted effects
    params: Mapping[str, float]  # model parameters written with the new effects
    claimed: bool  # whether the diagnosis claims the new effects; else one was adopted alone
    then: NextCommand = PROPOSE
    beside: tuple[str, ...] = ()  # adopted from the same diagnosis, but fitted instead of these
    left: Mapping[str, Left] = field(default_factory=dict)  # by parameter name
    logged: str = ""  # the trial that target.csv still repeats, if it ran no candidate
    jointly: tuple[str, ...] = ()  # parameters and effects determined only with the others
    rewritten: tuple[Rewritten, ...] = ()  # of effects that were adopted before
    findings: tuple[Finding, ...] = ()  # what an adoption leaves to be done or known
    along: tuple[str, ...] = ()  # late and filtering sensors that were adopted without being named

    def summary(self) -> str:
        """Return the effects that the model has now."""
        return ", ".join(str(effect["name"]) for effect in self.effects)

    def to_json(self) -> dict[str, Any]:
        """Return the document of `adopt --json`."""
        effects = [dict(effect) for effect in self.effects]
        return {
            "effects": effects,
            "params": dict(self.params),
            "claimed": self.claimed,
            "beside": list(self.beside),
            "jointly": list(self.jointly),
            "along": list(self.along),
            "left": {name: one.value for name, one in self.left.items()},
            "findings": [one.to_json() for one in self.findings],
        }


@dataclass(frozen=True, repr=False)
class Undone(Result):
    """The model's effects and parameters after an adoption was undone."""

    undone: tuple[str, ...]  # the effects of the adoption that was undone
    effects: tuple[Mapping[str, Any], ...]  # all adopted effects
    params: Mapping[str, float]  # [model] params
    then: NextCommand = PROPOSE
    rewritten: tuple[Rewritten, ...] = ()  # of effects that stay

    def summary(self) -> str:
        """Return the effects that were removed from the model."""
        return ", ".join(self.undone)

    def to_json(self) -> dict[str, Any]:
        """Return the document of `adopt --undo --json`."""
        effects = [dict(effect) for effect in self.effects]
        params = dict(self.params)
        return {"undone": [*self.undone], "effects": effects, "params": params, "findings": []}


def adopt_effects(workspace: Folder, names: Sequence[str], *, parameters: bool = True) -> Adopted:
    """Add diagnosed effects to [model] effects, see `Workspace.adopt`; write nothing on an error.

    If the diagnosis calibrated the model's own parameters together with the effects that it claims,
    these parameters are adopted too, since the effects' values are only valid with them. An effect
    that it does not claim was fitted instead of those, without parameters.
    """
    from grounded_trials.workspace.adopted import in_order, planner_of

    found = read_diagnosis(workspace.reports)
    if found is None:
        raise refused("search.undiagnosed", then=AGAIN)
    asked = names = with_curves(found, list(dict.fromkeys(names)))
    before = {} if found.made is None else found.made.effects
    check_adoptable(names, found, workspace, before)
    physics = [name for name in names if name not in found.late_sensors]
    claimed = not physics or claims_all(found, physics)
    if physics and {*found.effects} <= {*physics}:
        names = list(dict.fromkeys([*names, *late_open(workspace, found)]))
    # Values of the effects only hold with the parameters that were fitted beside them.
    whole_fit = parameters and bool(physics) and claimed
    calibrated = found.known_parameters if whole_fit else {}
    nominal = nominal_values(found, workspace, names)
    old = workspace.config.model.effects
    own, both = joined(found, names, old, nominal, calibrated)
    adopted = in_order(both[: len(old)], both[len(old) :])
    whole = dict(workspace.config.model.params) | own
    earlier, _ = adoptions(workspace)  # raises before anything is written, as does
    planner_of(workspace.task, adopted)  # a model that can't be built from these effects

    # Write it, and how it can be undone.
    set_in_model(workspace.config.file, params=whole if own else None, effects=adopted or None)
    model = workspace.config.model
    after = {"effects": adopted or model.effects, "params": whole if own else model.params}
    step = {"names": names, "before": _written(model), "after": after}
    step |= _of_diagnosis(found, names, own, _as_estimated(found, names, nominal, calibrated))
    write_document(workspace.reports / KEPT, {"adoptions": [*earlier, step], "undone": []})

    # What differs from the fit in which the values were found.
    fitted = {*names, *before, *(found.effects if claimed else ()), *found.late_sensors}
    jointly = [name for name in own if name in {*calibrated} & {*found.jointly}]
    left = left_behind(found) if whole_fit else {}
    done = Adopted(
        tuple(adopted),
        own,
        claimed,
        then=to_plan(workspace),
        logged=logged_target(workspace) if not workspace.candidate_ids() else "",
        beside=tuple(n for n in (str(effect["name"]) for effect in adopted) if n not in fitted),
        left={n: one for n, one in left.items() if n not in own},
        jointly=(*jointly, *(name for name in names if name in found.combined)),
        rewritten=_rewritten(workspace, old, adopted),
        along=tuple(name for name in names if name not in asked),
    )
    units = workspace.base_model.states
    told = _told(done, asked, units, found.parameters if whole_fit else {})
    return replace(done, findings=settle(told))


def _of_diagnosis(
    found: Diagnosis,
    names: Sequence[str],
    own: Mapping[str, float],
    known: Mapping[str, Sequence[float]],
) -> dict[str, Any]:
    """Return what reports/adoptions.json keeps of the diagnosis that effects are adopted from."""
    ties = {name: others for name in names if (others := _beside(found.indistinguishable, name))}
    adopted = {*names, *own}
    return {
        "known": dict(known),
        "ties": ties,
        "equivalent": {name: _beside(found.equivalent, name) for name in ties},
        "given": {name: [*on] for name, on in found.conditions.items() if name in adopted},
    }


def _told(
    done: Adopted,
    asked: Sequence[str],
    units: Mapping[str, str],
    known: Mapping[str, Estimate],
) -> Iterator[Finding]:
    """Yield what an adoption leaves to be done or known.

    Args:
        done: the adoption.
        asked: the effects that the user named.
        units: of the states.
        known: the parameters that were calibrated beside the effects.
    """
    for effect in done.effects:
        name = str(effect["name"])
        family, _, state = name.partition(":")
        if name not in asked or family not in ("sensor_bias", "sensor_scale", "sensor_delay"):
            continue
        if family == "sensor_bias":
            b = effect["b"]
            bias, way = Quantity(abs(b), units[state]), "low" if b < 0 else "high"
            yield found_("model.readings", state, bias=bias, way=way, offset=-b)
        elif family == "sensor_scale":
            k = effect["k"]
            way = "low" if k < 0 else "high"
            yield found_("model.readings", state, by=abs(k), way=way)
        else:
            yield found_("model.readings", *state.split("+"), age=Quantity(effect["d"], "s"))
    if done.along:
        yield found_("model.along", *done.along)
    if not done.claimed:
        yield found_("model.beside", asked[0])
    if done.beside:
        yield found_("model.beside", *done.beside)
    for one in done.left.values():
        ends = (Quantity(value, one.unit) for value in (one.kept, one.value))
        kept, value = ends
        yield found_("model.not_told", one.called, kept=kept, value=value)
    if stopped := [name for name, e in known.items() if e.stopped]:
        yield found_("model.at_bound", *stopped)
    if done.logged:
        yield found_("model.logged_target", done.logged)


def _as_estimated(
    found: Diagnosis,
    names: Sequence[str],
    nominal: Mapping[str, float],
    calibrated: Mapping[str, Estimate],
) -> dict[str, list[float]]:
    """Return [value, std] of what is adopted, by its name as a parameter of the model.

    Args:
        found: the diagnosis.
        names: its effects that are adopted.
        nominal: see `joined`.
        calibrated: see `joined`.
    """
    from grounded.effects import param_name

    known, before = dict(calibrated), {} if found.made is None else found.made.effects
    for row in (row for row in found.ranking if row.effect in names):
        family, _, target = row.effect.partition(":")
        for q, estimate in row.params.items():
            if family == "parameter":
                known[target] = estimate.moved(nominal[target])
            else:
                at = float(before.get(row.effect, {}).get(q, 0.0))
                known[param_name(row.effect, q)] = estimate.moved(at)
    return {
        name: [one.value, one.std]
        for name, one in known.items()
        if math.isfinite(one.value) and math.isfinite(one.std)
    }


def as_adopted(workspace: Folder) -> dict[str, Estimate]:
    """Return the values that were adopted last, as parameters of the model, without units.

    Empty if reports/adoptions.json is missing or can't be read: how sure they are is lost then.
    """
    found = dict[str, Estimate]()
    try:
        for step in adoptions(workspace)[0]:
            known = step.get("known", {}).items()
            found |= {str(name): Estimate(float(v), float(std)) for name, (v, std) in known}
    except (GroundedError, AttributeError, TypeError, ValueError):
        return {}
    return found


def _beside(groups: Sequence[Sequence[str]], name: str) -> list[str]:
    """Return the other effects of the groups that an effect is in."""
    own = [group for group in groups if name in group]
    return list(dict.fromkeys(other for group in own for other in group if other != name))


def _kept(workspace: Folder, key: str) -> dict[str, tuple[str, ...]]:
    """Return the names that the last adoption of each effect or parameter kept under a key.

    Empty if reports/adoptions.json is missing or can't be read. Steps that were written before the
    key was kept have none.
    """
    found = dict[str, Any]()
    try:
        for step in adoptions(workspace)[0]:
            again = (*step["names"], *step.get("known", {}))
            found |= dict.fromkeys(again, ()) | dict(step.get(key, {}))
        return {name: tuple(map(str, others)) for name, others in found.items() if others}
    except (GroundedError, AttributeError, KeyError, TypeError, ValueError):
        return {}


def tied_when_adopted(workspace: Folder) -> dict[str, tuple[str, ...]]:
    """Return the effects that the trials could not tell from an adopted one, by its name.

    Nothing compares them again, so a tie lasts as long as the one is part of the model and the
    other is not.
    """
    now, ties = (
        [str(one["name"]) for one in workspace.config.model.effects],
        _kept(workspace, "ties"),
    )
    rest = {name: tuple(o for o in ties.get(name, ()) if o not in now) for name in now}
    return {name: others for name, others in rest.items() if others}


def equivalent_when_adopted(workspace: Folder) -> set[str]:
    """Return the adopted effects whose ties (`tied_when_adopted`) no trial can tell from them."""
    same = _kept(workspace, "equivalent")
    ties = tied_when_adopted(workspace).items()
    return {name for name, others in ties if {*others} <= {*same.get(name, ())}}


def conditions_when_adopted(workspace: Folder) -> dict[str, tuple[str, ...]]:
    """Return the parameters that adopted values rest on, by effect or parameter."""
    return _kept(workspace, "given")


def _rewritten(
    workspace: Folder, before: Sequence[Mapping[str, Any]], after: Sequence[Mapping[str, Any]]
) -> tuple[Rewritten, ...]:
    """Return the quantities of effects in both lists that differ, in the order of the effects."""
    from grounded_trials.workspace.adopted import installed_effects

    library, model = installed_effects(), workspace.base_model
    now = {str(effect["name"]): effect for effect in after}

    def unit(effect: str, key: str) -> str:
        try:
            known = library.effect(effect, model).quantities
        except GroundedError:  # of a package that is not installed
            return ""
        return next((q.unit for q in known if q.name == key), "")

    return tuple(
        Rewritten(f"{key} of {name}", float(was), float(now[name][key]), unit(name, key))
        for old in before
        if (name := str(old["name"])) in now
        for key, was in old.items()
        if key != "name" and now[name].get(key, was) != was
    )


def left_behind(found: Diagnosis) -> dict[str, Left]:
    """Return the parameters, also of adopted effects, that changed in the fit but are not adopted.

    The trials do not identify them, but the prediction errors of the diagnosis include their
    changes.
    """
    from grounded.effects import param_name

    made = made_from(found)
    called = {
        param_name(effect, key): f"{key} of {effect}"
        for effect, values in made.effects.items()
        for key in values
    }
    return {
        name: Left(called.get(name, name), old, e.value, e.unit)
        for name, e in found.parameters.items()
        if name not in found.known_parameters and (old := made.nominal.get(name)) is not None
        if abs(e.value - old) > SLIGHT * max(abs(old), e.std)
    }


def undo_adoption(workspace: Folder) -> Undone:
    """Restore [model] as it was before the last adoption, see `Workspace.undo_adoption`.

    Raises:
        GroundedError: if nothing is left to undo, or [model] was changed since.
    """
    kept, undone = adoptions(workspace)
    file, model = workspace.config.file, workspace.config.model
    if not kept:
        has = ", ".join(str(effect["name"]) for effect in model.effects) or "none"
        raise refused("model.edited", file, effects=has)
    *earlier, last = kept
    names, before = [str(name) for name in last["names"]], last["before"]
    if _written(model) != last["after"]:
        was = as_toml(before["params"], before["effects"])
        had = listed(f"{name} = {value.as_string()}" for name, value in was.items())
        raise refused("model.edited", file, adopted=tuple(names), had=had)
    set_in_model(file, params=before["params"], effects=before["effects"])
    write_document(workspace.reports / KEPT, {"adoptions": earlier, "undone": [*undone, *names]})
    return Undone(
        tuple(names),
        tuple(before["effects"]),
        before["params"],
        then=to_plan(workspace),
        rewritten=_rewritten(workspace, last["after"]["effects"], before["effects"]),
    )


def _written(model: ModelTable) -> dict[str, Any]:
    """Return the parts of [model] that an adoption may change, for JSON."""
    return {"effects": [dict(e) for e in model.effects], "params": dict(model.params)}
