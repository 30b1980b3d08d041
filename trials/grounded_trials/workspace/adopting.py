"""Adopt in a workspace: add diagnosed effects to the model of grounded.toml, with their values.

A diagnosis estimates the model's parameters together with the effects, so both are adopted
together. reports/adoptions.json records [model] before each adoption, so that it can be undone, and
how sure the adopted values are.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from grounded.diagnosis.cause_words import wider
from grounded.diagnosis.report import Diagnosis, Estimate, Made
from grounded.errors import GroundedError, NextCommand, nearest
from grounded.result import Result, listed, percent
from grounded_trials.store.documents import read_document, write_document
from grounded_trials.workspace.config import ModelTable, as_toml, set_in_model
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.intake.where_to_mend import in_time_now
from grounded_trials.workspace.last_diagnosis import read_diagnosis

Effect = dict[str, Any]  # {"name": "dead_zone:throttle", "c": 0.146}
AGAIN, PROPOSE = NextCommand("diagnose"), NextCommand("propose")
KEPT = "adoptions.json"  # in reports/
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
    stopped: str = ""  # what to do about parameters that reached their bounds

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
            "left": {name: one.value for name, one in self.left.items()},
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
        return {"undone": list(self.undone), "effects": effects, "params": dict(self.params)}


def adopt_effects(workspace: Folder, names: Sequence[str], *, parameters: bool = True) -> Adopted:
    """Add diagnosed effects to [model] effects, see `Workspace.adopt`; write nothing on an error.

    If the diagnosis calibrated the model's own parameters together with the effects that it claims,
    these parameters are adopted too, since the effects' values are only valid with them. An effect
    that it does not claim was fitted instead of those, without parameters.
    """
    from grounded_trials.workspace.adopted import in_order
    from grounded_trials.workspace.next_step import late_open, to_plan
    from grounded_trials.workspace.off_target import logged_target

    found = read_diagnosis(workspace.reports)
    if found is None:
        raise GroundedError("nothing was diagnosed yet: run a diagnosis first", then=AGAIN)
    names = _corrections(found, list(dict.fromkeys(names)))
    before = {} if found.made is None else found.made.effects
    _check(names, found, workspace, before)
    physics = [name for name in names if name not in found.late_sensors]
    claimed = not physics or _claimed(found, physics)
    if physics and {*found.effects} <= {*physics}:
        names += [name for name in late_open(workspace, found) if name not in names]
    calibrated = found.known_parameters if parameters and physics and claimed else {}
    nominal = nominal_values(found, workspace, names)
    old = workspace.config.model.effects
    own, both = joined(found, names, old, nominal, calibrated)
    adopted = in_order(both[: len(old)], both[len(old) :])
    whole = dict(workspace.config.model.params) | own
    earlier, _ = _kept(workspace)  # raises before anything is written
    set_in_model(workspace.config.file, params=whole if own else None, effects=adopted or None)
    model = workspace.config.model
    after = {"effects": adopted or model.effects, "params": whole if own else model.params}
    known = _as_estimated(found, names, nominal, calibrated)
    step = {"names": names, "before": _written(model), "after": after, "known": known}
    write_document(workspace.reports / KEPT, {"adoptions": [*earlier, step], "undone": []})
    fitted = {*names, *before, *(found.effects if claimed else ()), *found.late_sensors}
    beside = (str(effect["name"]) for effect in adopted)
    return Adopted(
        tuple(adopted),
        own,
        claimed,
        then=to_plan(workspace),
        logged=logged_target(workspace) if not workspace.candidate_ids() else "",
        beside=tuple(n for n in beside if n not in fitted),
        left=left_behind(found) if parameters and physics and claimed else {},
        jointly=(
            *(name for name in own if name in calibrated and name in found.jointly),
            *(name for name in names if name in found.combined),
        ),
        rewritten=_rewritten(workspace, old, adopted),
        stopped=wider(found.parameters) if parameters and physics and claimed else "",
    )


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
        for step in _kept(workspace)[0]:
            known = step.get("known", {}).items()
            found |= {str(name): Estimate(float(v), float(std)) for name, (v, std) in known}
    except (GroundedError, AttributeError, TypeError, ValueError):
        return {}
    return found


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

    made = found.made or Made()
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
    from grounded_trials.workspace.next_step import to_plan

    kept, undone = _kept(workspace)
    file, model = workspace.config.file, workspace.config.model
    if not kept:
        has = ", ".join(str(effect["name"]) for effect in model.effects) or "none"
        raise GroundedError(
            f"no adoption is left to undo; [model] effects in {file}: {has}. Remove effects that "
            "were written by hand there"
        )
    *earlier, last = kept
    names, before = [str(name) for name in last["names"]], last["before"]
    if _written(model) != last["after"]:
        was = as_toml(before["params"], before["effects"])
        had = listed(f"{name} = {value.as_string()}" for name, value in was.items())
        raise GroundedError(
            f"[model] in {file} was changed after {', '.join(names)} was adopted, by `fit --apply` "
            f"or by hand, and undoing would lose that. Edit [model] by hand instead; before the "
            f"adoption it had {had}"
        )
    set_in_model(file, params=before["params"], effects=before["effects"])
    write_document(workspace.reports / KEPT, {"adoptions": earlier, "undone": [*undone, *names]})
    return Undone(
        tuple(names),
        tuple(before["effects"]),
        before["params"],
        then=to_plan(workspace),
        rewritten=_rewritten(workspace, last["after"]["effects"], before["effects"]),
    )


def declined(workspace: Folder) -> tuple[str, ...]:
    """Return the effects of the last diagnosis that were adopted and undone since."""
    return tuple(str(name) for name in _kept(workspace)[1])


def _kept(workspace: Folder) -> tuple[list[dict[str, Any]], list[str]]:
    """Read the adoptions that can be undone, oldest first, and those undone since a diagnosis."""
    path = workspace.reports / KEPT
    try:
        document = read_document(path)
        return list(document["adoptions"]), list(document["undone"])
    except FileNotFoundError:
        return [], []
    except (ValueError, KeyError, TypeError, RecursionError, GroundedError) as error:
        raise GroundedError(
            f"{path} can't be read ({error}): delete it; earlier adoptions can't be undone then"
        ) from None


def diagnosed_again(workspace: Folder) -> None:
    """Forget which effects were undone: a newer diagnosis may claim them again."""
    kept, undone = _kept(workspace)
    if undone:
        write_document(workspace.reports / KEPT, {"adoptions": kept, "undone": []})


def _written(model: ModelTable) -> dict[str, Any]:
    """Return the parts of [model] that an adoption may change, for JSON."""
    return {"effects": [dict(e) for e in model.effects], "params": dict(model.params)}


def joined(
    found: Diagnosis,
    names: Sequence[str],
    effects: Sequence[Mapping[str, Any]],
    nominal: Mapping[str, float],
    calibrated: Mapping[str, Estimate],
) -> tuple[dict[str, float], list[Effect]]:
    """Return the parameters to set and all effects, after adding diagnosed effects to a model.

    Args:
        found: the diagnosis.
        names: its effects to add, in any order: they are added in the order of the fit.
        effects: the effects that the model has already; they stay in front.
        nominal: the value to which the change of each parameter among `names` is added.
        calibrated: the parameters that are adopted with the effects.
    """
    from grounded_trials.workspace.adopted import settled

    before = {} if found.made is None else found.made.effects
    adopted, new = [dict(effect) for effect in effects], list[Effect]()
    params = {key: _rounded(estimate.value) for key, estimate in calibrated.items()}
    fitted = {name: k for k, name in enumerate(found.joining)}
    for name in sorted(names, key=lambda name: fitted.get(name, len(fitted))):
        values = {key: _rounded(value) for key, value in found.values(name).items()}
        family, _, target = name.partition(":")
        if family == "parameter":
            params[target] = _rounded(nominal[target] + values["d"])
        elif name in before:  # a further delay adds to the adopted one
            values["d"] = _rounded(float(before[name]["d"]) + values["d"])
            adopted = [e | values if e["name"] == name else e for e in adopted]
        else:
            new.append({"name": name, **values})
    return settled(params, [*adopted, *new])


def _curves(found: Diagnosis) -> list[str]:
    return [] if found.correction is None else [curve.effect for curve in found.correction.curves]


def _corrections(found: Diagnosis, names: list[str]) -> list[str]:
    """Replace `correction:v` by its curves.

    Raises:
        GroundedError: if the correction is not adoptable, or claimed effects are not adopted too.
    """
    curves, asked = _curves(found), [n for n in names if n.startswith("correction:")]
    if found.correction is None or asked not in (
        [f"correction:{found.correction.channel}"],
        curves,
    ):
        return names
    if not found.correction.adoptable:
        raise GroundedError(
            f"'{asked[0]}' is not adoptable: it does not predict trials better that it was not "
            "fitted to; run more trials and diagnose again"
        )
    missing = [name for name in found.effects if name not in names]
    if missing:
        raise GroundedError(
            f"'{asked[0]}' was fitted together with {', '.join(missing)}: adopt them together",
            then=NextCommand("adopt", (*missing, asked[0])),
        )
    return [name for name in names if name not in asked] + curves


def nominal_values(found: Diagnosis, workspace: Folder, names: Iterable[str]) -> dict[str, float]:
    """Return the values that parameters among the effects had when the diagnosis was made.

    Raises:
        GroundedError: if neither the diagnosis nor the model has a value.
    """
    made, base = found.made or Made(), workspace.base_model.params
    nominal = {}
    for name in (n.removeprefix("parameter:") for n in names if n.startswith("parameter:")):
        if name not in made.nominal and name not in base:
            raise GroundedError(
                f"the last diagnosis does not state the value of '{name}' that it started from: "
                "diagnose again",
                then=AGAIN,
            )
        nominal[name] = made.nominal[name] if name in made.nominal else float(base[name].value)
    return nominal


def _check(
    names: Sequence[str], found: Diagnosis, workspace: Folder, before: Mapping[str, Any]
) -> None:
    """Check that each effect is in the diagnosis and was not adopted since.

    Raises:
        GroundedError: if not, or if [log] already corrects the delay that it describes.
    """
    from grounded_trials.workspace.next_step import newer_alone

    if found.changed and not set(names) <= {*found.late_sensors}:
        raise GroundedError(
            "the last diagnosis compared two groups of trials between which the robot changed: no "
            "value of both is right for either",
            newer_alone(found),
        )
    known = [row.effect for row in found.ranking] + _curves(found) + [*found.late_sensors]
    effects = [str(effect["name"]) for effect in workspace.config.model.effects]
    adopted = [name for name in effects if name not in before or name not in known]
    in_log = in_time_now(workspace, found.preflight)
    for name in names:
        if name not in known and name not in adopted:
            _check_alike(name, found)
            family = [one for one in known if one.startswith(f"{name}:")]
            there = f"did you mean '{family[0]}'?" if family else nearest(name, known)
            raise GroundedError(f"'{name}' is not among the effects of the last diagnosis: {there}")
        if name in in_log:
            _, _, state = name.partition(":")
            raise GroundedError(
                f"'{name}': [log.state.{state}] delay_s = {in_log[name]:g} already removes that "
                "delay from every log that is read, so the model must not have it as well. Either "
                "remove delay_s again, as it was for the diagnosed trials, so that plans allow for "
                "the delay that the robot's program sees; or keep delay_s and let that program "
                "predict the state ahead by as much"
            )
        if name in adopted:
            raise GroundedError(
                f"'{name}' is adopted already; see [model] effects in grounded.toml"
            )


def _check_alike(name: str, found: Diagnosis) -> None:
    """Refuse an effect that the diagnosis only lists as alike a claimed one, without values."""
    alike = next((one for one in found.lookalikes if one.like == name), None)
    if alike is None:
        return
    family = alike.effect.partition(":")[0]
    then = NextCommand("diagnose", ("--without", family))
    what = f"a diagnosis without {family} would fit it"
    if family == name.partition(":")[0]:
        then, what = NextCommand("adopt", found.effects), "adopt that one"
    raise GroundedError(
        f"'{name}' was not fitted in its own right and has no values: the last diagnosis lists it "
        f"because it reproduces {percent(alike.share)} of the signal of {alike.effect}, which was "
        f"fitted; {what} instead",
        then=then,
    )


def _claimed(found: Diagnosis, names: Sequence[str]) -> bool:
    """Return whether the verdict claims all the effects.

    Raises:
        GroundedError: if nothing can be adopted, or several effects are named and some of them were
            fitted as alternatives to others.
    """
    if found.no_cause:
        raise GroundedError(
            f"too little is known to adopt anything ({found.sentence}): run another trial, ingest "
            "it, then diagnose again"
        )
    rivals = [name for name in names if name not in (*found.effects, *_curves(found))]
    if rivals and len(names) > 1:
        own = f"those that it claims ({', '.join(found.effects)}), or " * bool(found.effects)
        raise GroundedError(
            f"the last diagnosis does not claim {', '.join(rivals)}: these effects were fitted one "
            f"instead of another, not together; adopt {own}one alone",
            then=NextCommand("adopt", found.effects or (rivals[0],)),
        )
    return not rivals


def _rounded(value: float) -> float:
    if not math.isfinite(value):
        raise GroundedError("the last diagnosis lacks a value: diagnose again", then=AGAIN)
    return float(f"{float(value):.8g}")
