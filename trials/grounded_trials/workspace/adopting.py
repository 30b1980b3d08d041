"""adopt in a workspace: diagnosed effects join the model of grounded.toml, with their values.

A diagnosis estimates the model's parameters beside the effects, so both belong to what it claims
and are adopted together. reports/adoptions.json keeps what [model] was before each, so that the
last can be undone.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from grounded.diagnosis.report import Diagnosis, Estimate, Made
from grounded.diagnosis.stopped import wider
from grounded.errors import GroundedError, NextCommand, nearest
from grounded.result import Result, listed, percent
from grounded_trials.store.documents import read_document, write_document
from grounded_trials.workspace.config import ModelTable, as_toml, set_in_model
from grounded_trials.workspace.diagnosing import read_diagnosis
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.intake.where_to_mend import in_time_now

Effect = dict[str, Any]  # {"name": "dead_zone:throttle", "c": 0.146}
AGAIN, PROPOSE = NextCommand("diagnose"), NextCommand("propose")
KEPT = "adoptions.json"  # in reports/
SLIGHT = 1e-3  # of a parameter: no move at all


@dataclass(frozen=True)
class Left:
    """A number that moved beside the effects and is not adopted with them."""

    called: str  # `m`, or `k of coupling:w<-th`
    kept: float  # what it stays at
    value: float  # beside what the effects were fitted
    unit: str


@dataclass(frozen=True, repr=False)
class Adopted(Result):
    """What the model has now."""

    effects: tuple[Mapping[str, Any], ...]  # all that are adopted
    params: Mapping[str, float]  # of the model, written with them
    claimed: bool  # the diagnosis claims the new ones; else one was taken by itself
    then: NextCommand = PROPOSE
    beside: tuple[str, ...] = ()  # adopted before from the same diagnosis, fitted in their place
    left: Mapping[str, Left] = field(default_factory=dict)  # by name
    logged: str = ""  # the trial whose drive target.csv still is, where it ran no candidate
    stopped: str = ""  # what to do about parameters that went as far as they may

    def summary(self) -> str:
        """The effects that the model has now."""
        return ", ".join(str(effect["name"]) for effect in self.effects)

    def to_json(self) -> dict[str, Any]:
        """The document of `adopt --json`."""
        effects = [dict(effect) for effect in self.effects]
        return {
            "effects": effects,
            "params": dict(self.params),
            "claimed": self.claimed,
            "beside": list(self.beside),
            "left": {name: one.value for name, one in self.left.items()},
        }


@dataclass(frozen=True, repr=False)
class Undone(Result):
    """What the model has again."""

    undone: tuple[str, ...]  # the effects that the last adoption had brought
    effects: tuple[Mapping[str, Any], ...]  # all that are adopted now
    params: Mapping[str, float]  # of [model] now
    then: NextCommand = PROPOSE

    def summary(self) -> str:
        """The effects that the model lost again."""
        return ", ".join(self.undone)

    def to_json(self) -> dict[str, Any]:
        """The document of `adopt --undo --json`."""
        effects = [dict(effect) for effect in self.effects]
        return {"undone": list(self.undone), "effects": effects, "params": dict(self.params)}


def adopt_effects(workspace: Folder, names: Sequence[str], *, parameters: bool = True) -> Adopted:
    """Adds diagnosed effects to [model] effects, see `Workspace.adopt`; or else writes nothing.

    Where the diagnosis calibrated the model's own parameters beside the effects that it claims,
    they are adopted with those: the effects' values hold beside them. An effect that it does not
    claim was fitted in place of those, without them.
    """
    from grounded_trials.workspace.adopted import in_order
    from grounded_trials.workspace.next_step import logged_target, to_plan

    found = read_diagnosis(workspace.reports)
    if found is None:
        raise GroundedError("nothing was diagnosed yet: diagnose first", then=AGAIN)
    names = _corrections(found, list(dict.fromkeys(names)))
    before = {} if found.made is None else found.made.effects
    _check(names, found, workspace, before)
    physics = [name for name in names if name not in found.late_sensors]
    claimed = not physics or _claimed(found, physics)
    calibrated = found.known_parameters if parameters and physics and claimed else {}
    nominal = nominal_values(found, workspace, names)
    old = workspace.config.model.effects
    own, both = joined(found, names, old, nominal, calibrated)
    adopted = in_order(both[: len(old)], both[len(old) :])
    whole = dict(workspace.config.model.params) | own
    earlier, _ = _kept(workspace)  # or nothing is written
    set_in_model(workspace.config.file, params=whole if own else None, effects=adopted or None)
    model = workspace.config.model
    after = {"effects": adopted or model.effects, "params": whole if own else model.params}
    step = {"names": names, "before": _written(model), "after": after}
    write_document(workspace.reports / KEPT, {"adoptions": [*earlier, step], "undone": []})
    fitted = {*names, *before, *(found.effects if claimed else ()), *found.late_sensors}
    beside = (str(effect["name"]) for effect in adopted)
    logged = logged_target(workspace) if not workspace.candidate_ids() else ""
    return Adopted(
        tuple(adopted),
        own,
        claimed,
        then=to_plan(workspace),
        logged=logged,
        beside=tuple(n for n in beside if n not in fitted),
        left=left_behind(found) if parameters and physics and claimed else {},
        stopped=wider(found.parameters) if parameters and physics and claimed else "",
    )


def left_behind(found: Diagnosis) -> dict[str, Left]:
    """The numbers, of parameters and adopted effects, that moved and are not adopted.

    The trials do not tell them apart from others; what the diagnosis measured had them all.
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
    """Gives [model] back what it had before an adoption, see `Workspace.undo_adoption`.

    Raises:
        GroundedError: if nothing is left to undo, or [model] was changed since.
    """
    from grounded_trials.workspace.next_step import to_plan

    kept, undone = _kept(workspace)
    file, model = workspace.config.file, workspace.config.model
    if not kept:
        has = ", ".join(str(effect["name"]) for effect in model.effects) or "none"
        raise GroundedError(
            f"no adoption is left to undo; [model] effects in {file}: {has}. One that was written "
            "there by hand is taken out by hand"
        )
    *earlier, last = kept
    names, before = [str(name) for name in last["names"]], last["before"]
    if _written(model) != last["after"]:
        was = as_toml(before["params"], before["effects"])
        had = listed(f"{name} = {value.as_string()}" for name, value in was.items())
        raise GroundedError(
            f"[model] in {file} was changed after {', '.join(names)} was adopted, by `fit --apply` "
            f"or by hand, which would be lost. Before, it had {had}: write there what "
            "should stay"
        )
    set_in_model(file, params=before["params"], effects=before["effects"])
    write_document(workspace.reports / KEPT, {"adoptions": earlier, "undone": [*undone, *names]})
    now = tuple(before["effects"]), before["params"]
    return Undone(tuple(names), *now, then=to_plan(workspace))


def declined(workspace: Folder) -> tuple[str, ...]:
    """What the last diagnosis claims, and was adopted and undone since."""
    return tuple(str(name) for name in _kept(workspace)[1])


def _kept(workspace: Folder) -> tuple[list[dict[str, Any]], list[str]]:
    """The adoptions that can be undone, oldest first, and what was undone since a diagnosis."""
    path = workspace.reports / KEPT
    try:
        document = read_document(path)
        return list(document["adoptions"]), list(document["undone"])
    except FileNotFoundError:
        return [], []
    except (ValueError, KeyError, TypeError, RecursionError, GroundedError) as error:
        raise GroundedError(
            f"{path} can't be read ({error}): without it, adoptions can't be undone; delete it"
        ) from None


def diagnosed_again(workspace: Folder) -> None:
    """Forgets what was undone: a newer diagnosis may claim it again."""
    kept, undone = _kept(workspace)
    if undone:
        write_document(workspace.reports / KEPT, {"adoptions": kept, "undone": []})


def _written(model: ModelTable) -> dict[str, Any]:
    """What an adoption may change, as JSON has it."""
    return {"effects": [dict(e) for e in model.effects], "params": dict(model.params)}


def joined(
    found: Diagnosis,
    names: Sequence[str],
    effects: Sequence[Mapping[str, Any]],
    nominal: Mapping[str, float],
    calibrated: Mapping[str, Estimate],
) -> tuple[dict[str, float], list[Effect]]:
    """The parameters that are set and all effects, once diagnosed ones have joined a model.

    Args:
        found: the diagnosis.
        names: of its effects, in any order: they join in that in which they were fitted.
        effects: that the model has already; they stay in front.
        nominal: the value from which each parameter that is adopted by name counts.
        calibrated: the parameters that come along.
    """
    before = {} if found.made is None else found.made.effects
    adopted, new = [dict(effect) for effect in effects], list[Effect]()
    params = {key: _rounded(estimate.value) for key, estimate in calibrated.items()}
    fitted = {name: k for k, name in enumerate(found.joining)}
    for name in sorted(names, key=lambda name: fitted.get(name, len(fitted))):
        values = {key: _rounded(value) for key, value in found.values(name).items()}
        family, _, target = name.partition(":")
        if family == "parameter":
            params[target] = _rounded(nominal[target] + values["d"])
        elif name in before:  # a delay more
            values["d"] = _rounded(float(before[name]["d"]) + values["d"])
            adopted = [e | values if e["name"] == name else e for e in adopted]
        else:
            new.append({"name": name, **values})
    return settled(params, [*adopted, *new])


def _curves(found: Diagnosis) -> list[str]:
    return [] if found.correction is None else [curve.effect for curve in found.correction.curves]


def _corrections(found: Diagnosis, names: list[str]) -> list[str]:
    """The names with `correction:v` replaced by its curves, which must have passed their test."""
    curves, asked = _curves(found), [n for n in names if n.startswith("correction:")]
    if found.correction is None or asked not in (
        [f"correction:{found.correction.channel}"],
        curves,
    ):
        return names
    if not found.correction.adoptable:
        raise GroundedError(
            f"'{asked[0]}' does not predict trials better that it was not fitted to: expected a "
            "correction that is adoptable; run more trials and diagnose again"
        )
    missing = [name for name in found.effects if name not in names]
    if missing:
        raise GroundedError(
            f"'{asked[0]}' was fitted beside {', '.join(missing)}: adopt them together",
            then=NextCommand("adopt", (*missing, asked[0])),
        )
    return [name for name in names if name not in asked] + curves


def nominal_values(found: Diagnosis, workspace: Folder, names: Iterable[str]) -> dict[str, float]:
    """The values, when a diagnosis was made, of the parameters among its effects.

    Raises:
        GroundedError: if neither an older document nor the model has one.
    """
    made, base = found.made or Made(), workspace.base_model.params
    nominal = {}
    for name in (n.removeprefix("parameter:") for n in names if n.startswith("parameter:")):
        if name not in made.nominal and name not in base:
            raise GroundedError(
                f"the last diagnosis does not say from which value of '{name}' it counts: diagnose "
                "again",
                then=AGAIN,
            )
        nominal[name] = made.nominal[name] if name in made.nominal else float(base[name].value)
    return nominal


def settled(
    params: Mapping[str, float], effects: Sequence[Mapping[str, Any]]
) -> tuple[dict[str, float], list[Effect]]:
    """The model's own parameters, and the effects with the values of theirs."""
    from grounded.effects import param_name

    own, changed = dict(params), []
    for effect in effects:
        names = {q: param_name(str(effect["name"]), q) for q in effect}
        changed.append(
            dict(effect) | {q: own.pop(name) for q, name in names.items() if name in own}
        )
    return own, changed


def _check(
    names: Sequence[str], found: Diagnosis, workspace: Folder, before: Mapping[str, Any]
) -> None:
    """Each must have been weighed, and not be adopted since."""
    known = [row.effect for row in found.ranking] + _curves(found) + [*found.late_sensors]
    adopted = [e["name"] for e in workspace.config.model.effects if e["name"] not in before]
    in_log = in_time_now(workspace, found.preflight)
    for name in names:
        if name not in known:
            _check_alike(name, found)
            raise GroundedError(
                f"'{name}' is not among the effects of the last diagnosis: {nearest(name, known)}"
            )
        if name in in_log:
            _, _, state = name.partition(":")
            raise GroundedError(
                f"'{name}': [log.state.{state}] delay_s = {in_log[name]:g} takes that delay out of "
                "every log that is read now, and the model would have it as well. Expected one of "
                "both: take delay_s out again, as it was for the trials that were diagnosed, and "
                "the plan knows what the robot's program gets; or keep delay_s, and let that "
                "program predict it ahead by as much"
            )
        if name in adopted:
            raise GroundedError(
                f"'{name}' is adopted already; see [model] effects in grounded.toml"
            )


def _check_alike(name: str, found: Diagnosis) -> None:
    """Refuses what the diagnosis lists as alike a claimed effect, and has no values for."""
    alike = next((one for one in found.lookalikes if one.like == name), None)
    if alike is None:
        return
    family = alike.effect.partition(":")[0]
    then = NextCommand("diagnose", ("--without", family))
    what = f"a diagnosis without {family} would fit it"
    if family == name.partition(":")[0]:
        then, what = NextCommand("adopt", found.effects), "adopt that one"
    raise GroundedError(
        f"'{name}' was not fitted in its own right, so that it has no values: the last diagnosis "
        f"lists it because it makes {percent(alike.share)} of the signal of {alike.effect}, which "
        f"was fitted; {what} instead",
        then=then,
    )


def _claimed(found: Diagnosis, names: Sequence[str]) -> bool:
    """Whether the verdict claims them all; several that it doesn't were fitted as rivals."""
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
            f"instead of another, not together; expected {own}one alone",
            then=NextCommand("adopt", found.effects or (rivals[0],)),
        )
    return not rivals


def _rounded(value: float) -> float:
    if not math.isfinite(value):
        raise GroundedError("the last diagnosis lacks a value: diagnose again", then=AGAIN)
    return float(f"{float(value):.8g}")
