"""adopt in a workspace: diagnosed effects join the model of grounded.toml, with their values.

The model after the diagnosis: its parameters and effects put in, drawn beside the crude one.

A diagnosis estimates the model's parameters beside the effects, so both belong to what it claims;
once effects are adopted and nothing newer was diagnosed, it is the model that plans.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from grounded.errors import GroundedError, NextCommand, nearest
from grounded.search.planner import Planner
from grounded_trials.workspace.config import set_in_model
from grounded_trials.workspace.diagnosis_file import FILE, MALFORMED, Diagnosis, diagnosis_of
from grounded_trials.workspace.folder import Folder

Effect = dict[str, Any]  # {"name": "dead_zone:throttle", "c": 0.146}


@dataclass(frozen=True)
class Adopted:
    """What the model has now."""

    effects: tuple[Mapping[str, Any], ...]  # all that are adopted
    params: Mapping[str, float]  # of the model, written with them
    claimed: bool  # the diagnosis claims the new ones; else one was taken by itself


def adopt_effects(workspace: Folder, names: Sequence[str], *, parameters: bool = True) -> Adopted:
    """Adds diagnosed effects to [model] effects, and the parameters that belong to them.

    Where the diagnosis calibrated the model's own parameters beside the effects that it claims,
    they are adopted with those: the effects' values hold beside them. An effect that it does not
    claim was fitted in place of those, without them.

    Raises:
        GroundedError: if nothing was diagnosed, an effect is not in its ranking, or they were not
            fitted together; nothing is written then.
    """
    document, names = _document(workspace), list(dict.fromkeys(names))
    ranking = {str(entry["effect"]): entry for entry in document["ranking"]}
    before = {str(e["name"]): e for e in document.get("diagnosed", {}).get("adopted", [])}
    _check(names, list(ranking), workspace, before)
    claimed = _claimed(document, names)
    adopted: list[Effect] = [dict(effect) for effect in workspace.config.model.effects]
    found = document.get("parameters", {}) if parameters and claimed else {}
    params = {key: _rounded(p["value"]) for key, p in found.items()}
    for name in names:
        values = _values(ranking[name])
        family, _, target = name.partition(":")
        if family == "parameter":
            params[target] = _rounded(_nominal(document, workspace, target) + values["d"])
        elif name in before:  # a delay more
            values["d"] = _rounded(float(before[name]["d"]) + values["d"])
            adopted = [e | values if e["name"] == name else e for e in adopted]
        else:
            adopted.append({"name": name, **values})
    own, adopted = _settled(params, adopted)
    whole = dict(workspace.config.model.params) | own
    set_in_model(workspace.config.file, params=whole if own else None, effects=adopted or None)
    return Adopted(tuple(adopted), own, claimed)


def _nominal(document: Mapping[str, Any], workspace: Folder, name: str) -> float:
    """A parameter's value when the diagnosis was made."""
    values = document.get("diagnosed", {}).get("nominal", {})
    if name in values:
        return float(values[name])
    if name not in workspace.base_model.params:
        raise GroundedError(
            f"the last diagnosis does not say from which value of '{name}' it counts: run "
            "`grounded diagnose` again"
        )
    return float(workspace.base_model.params[name].value)


def _settled(
    params: Mapping[str, float], effects: Sequence[Effect]
) -> tuple[dict[str, float], list[Effect]]:
    """The model's own parameters, and the effects with the values of theirs."""
    from grounded.effects.wrap import param_name

    own, changed = dict(params), []
    for effect in effects:
        names = {q: param_name(str(effect["name"]), q) for q in effect}
        changed.append(effect | {q: own.pop(name) for q, name in names.items() if name in own})
    return own, changed


def _check(
    names: Sequence[str], known: Sequence[str], workspace: Folder, before: Mapping[str, Any]
) -> None:
    """Each must have been weighed, and not be adopted since."""
    adopted = [e["name"] for e in workspace.config.model.effects if e["name"] not in before]
    for name in names:
        if name not in known:
            raise GroundedError(
                f"'{name}' is not among the effects of the last diagnosis: {nearest(name, known)}"
            )
        if name in adopted:
            raise GroundedError(
                f"'{name}' is adopted already; see [model] effects in grounded.toml"
            )


def _claimed(document: Mapping[str, Any], names: Sequence[str]) -> bool:
    """Whether the verdict claims them all; several that it doesn't were fitted as rivals."""
    found = diagnosis_of(dict(document))
    if found.no_cause:
        raise GroundedError(
            f"too little is known to adopt anything ({found.sentence}): run another trial, ingest "
            "it, then `grounded diagnose`"
        )
    rivals = [name for name in names if name not in found.effects]
    if rivals and len(names) > 1:
        own = f"`grounded adopt {' '.join(found.effects)}`, " * bool(found.effects)
        raise GroundedError(
            f"the last diagnosis does not claim {', '.join(rivals)}: these effects were fitted one "
            "instead of another, not together; expected effects that it claims together, or one "
            f"alone: {own}or `grounded adopt {rivals[0]}`"
        )
    return not rivals


def _values(entry: Mapping[str, Any]) -> dict[str, float]:
    """An effect's quantities, those that were estimated and those that are fixed."""
    values = {key: _rounded(p["value"]) for key, p in entry["params"].items()}
    return values | {key: _rounded(value) for key, value in entry.get("fixed", {}).items()}


def _rounded(value: float) -> float:
    return float(f"{float(value):.8g}")


def _document(workspace: Folder) -> dict[str, Any]:
    path = workspace.reports / FILE
    try:
        document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        _ = diagnosis_of(document)
        for entry in document["ranking"]:
            _ = str(entry["effect"]), entry["params"].items()
    except FileNotFoundError:
        raise GroundedError("nothing was diagnosed yet", NextCommand("diagnose")) from None
    except (OSError, *MALFORMED) as error:
        raise GroundedError(
            f"{path} can't be read ({error}): run `grounded diagnose` again"
        ) from None
    return document


@dataclass(frozen=True, eq=False)
class Better:
    """A model to compare the crude one with, and its name in a legend."""

    planner: Planner
    name: str


def better_model(workspace: Folder, diagnosis: Diagnosis | None) -> Better | None:
    """The diagnosed model, or else the one with adopted effects; None where there is neither.

    Raises:
        GroundedError: if the diagnosis names an effect or a quantity that is not known.
    """
    adopted = [dict(effect) for effect in workspace.config.model.effects]
    effects = adopted + _new(diagnosis, {str(effect["name"]) for effect in adopted})
    values = _parameters(workspace, diagnosis)
    if diagnosis is None or not (values or len(effects) > len(adopted)):
        return Better(workspace.planner, "with adopted effects") if adopted else None
    from grounded_trials.workspace.adopted import planner_with

    task = workspace.task
    estimated = task.with_model(task.model.with_values(values))
    return Better(planner_with(estimated, effects), "as diagnosed")


def _new(diagnosis: Diagnosis | None, adopted: set[str]) -> list[dict[str, Any]]:
    """The effects that the verdict names and the model lacks, with their quantities."""
    if diagnosis is None:
        return []
    ranked = {r.effect: r for r in diagnosis.ranking}
    return [
        {"name": name, **dict(ranked[name].fixed), **{v.name: v.value for v in ranked[name].params}}
        for name in diagnosis.effects
        if name in ranked and name not in adopted
    ]


def _parameters(workspace: Folder, diagnosis: Diagnosis | None) -> dict[str, float]:
    """The model's parameters as the diagnosis estimated them; its own names only."""
    known = workspace.task.model.params
    found = diagnosis.parameters if diagnosis is not None else ()
    return {v.name: v.value for v in found if v.name in known and v.value == v.value}
