"""Adopted effects, as listed in grounded.toml, as part of the model that plans.

    [model]
    effects = [ { name = "dead_zone:throttle", c = 0.146 } ]

Families come with grounded and with other packages (`installed_effects`);
`grounded.search.planner.planner_with` adds them to the model.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from importlib import metadata
from typing import Any

from grounded.checks import of_type, wrong
from grounded.effects import joining_order, param_name
from grounded.effects.family import (
    Effect,
    Family,
    RateFamily,
    Scales,
    SensorDelayFamily,
    SensorLagFamily,
    Site,
)
from grounded.effects.registry import Library
from grounded.errors import GroundedError
from grounded.search.planner import Planner, planner_with
from grounded.task import Task
from grounded_trials.plain_file import unreadable

LINEAR = ("c", "k", "A", "B", "a", "b")  # parameters that an added rate is proportional to
STEEP = 3.0  # largest change of speed by dry friction in one step, in units of its width


def installed_effects() -> Library:
    """Return the library of effects: built-in families, and those of other packages.

    A package adds families by the entry point group `grounded.effects`: a family, or a sequence of
    families.
    """
    found: list[Family] = []
    for point in metadata.entry_points(group="grounded.effects"):
        try:
            loaded = point.load()
        except Exception as error:
            raise unreadable(point.value, error, kind="package") from None
        families = [loaded] if isinstance(loaded, Family) else list(loaded)
        for family in families:
            of_type(point.value, family, Family)
        found += families
    return Library().with_families(found)


def settled(
    params: Mapping[str, float], effects: Sequence[Mapping[str, Any]]
) -> tuple[dict[str, float], list[dict[str, Any]]]:
    """Split parameters into the model's own, and those of effects, which are set in the effects."""
    own, changed = dict(params), []
    for effect in effects:
        names = {q: param_name(str(effect["name"]), q) for q in effect}
        changed.append(
            dict(effect) | {q: own.pop(name) for q, name in names.items() if name in own}
        )
    return own, changed


def in_order(
    old: Sequence[Mapping[str, Any]], new: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """Merge a model's effects with newly diagnosed ones, in the order in which they act.

    A rate gain was diagnosed on the rate including the adopted effects, but acts on the model's own
    rate. So the adopted effects on that rate are scaled by the gain.
    """
    library = installed_effects()
    both = ([_grown(library, effect, new) for effect in old], new)
    families = [[library.family(str(e["name"]).partition(":")[0]) for e in some] for some in both]
    return [dict(both[late][i]) for late, i in joining_order(*families)]


def _grown(
    library: Library, effect: Mapping[str, Any], new: Sequence[Mapping[str, Any]]
) -> Mapping[str, Any]:
    """Scale an adopted effect on a rate by the newly diagnosed gain of that rate, if any."""
    name, _, target = str(effect["name"]).partition(":")
    family, driven = library.family(name), target.partition("<-")[0]
    gains = [1 + e["g"] for e in new if e["name"] == f"rate_gain:{driven}"]
    if not gains or not isinstance(family, RateFamily) or family.needs_own:
        return effect
    grown = {k: float(f"{v * gains[0]:.8g}") for k, v in effect.items() if k in LINEAR}
    return {**effect, **grown}


def planner_of(task: Task, effects: Sequence[Mapping[str, Any]]) -> Planner:
    """Return the planner of a task with these effects in its model, in the order they act."""
    library = installed_effects() if effects else None
    given = [(str(e["name"]), {k: v for k, v in e.items() if k != "name"}) for e in effects]
    return planner_with(task, given, library, partial(_followed, dt=task.dt))


def _followed(effect: Effect, values: Mapping[str, Any], dt: float) -> Mapping[str, float]:
    """Check an effect's parameters and widen a dry friction too steep for the time step.

    If c dt is many times the width over which the friction builds up, one step reverses a slow
    motion and makes it faster, so that no plan converges.
    """
    whole = _checked(effect, values)
    if effect.family.name != "coulomb_friction":
        return whole
    return {**whole, "width": max(whole["width"], abs(whole["c"]) * dt / STEEP)}


def but_late_sensors(effects: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Drop delays and lags of sensors from effects, for the model that estimates states.

    A log holds late values of a late state. Estimated states must be as late as the measured ones
    they are estimated from, or the two contradict each other.
    """
    library = installed_effects() if effects else Library()
    family = {str(e["name"]): library.family(str(e["name"]).partition(":")[0]) for e in effects}
    late = SensorDelayFamily | SensorLagFamily
    return [e for e in effects if not isinstance(family[str(e["name"])], late)]


def _checked(effect: Effect, values: Mapping[str, Any]) -> Mapping[str, float]:
    """Check the parameters of an effect in grounded.toml: complete, numbers, within bounds."""
    where = f"grounded.toml: [model] effects: {effect.name}"
    for key, value in values.items():
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not math.isfinite(value):
            raise wrong(f"{where}: {key}", value, must="finite")
    try:
        whole = effect.complete(values)
    except GroundedError as error:
        raise error.at("grounded.toml: [model] effects") from None
    for name, (low, high) in _bounds(effect).items():
        room = 1e-6 * abs(whole[name])
        if not low - room <= whole[name] <= high + room:
            raise wrong(f"{where}: {name}", whole[name], must="bounded", low=low, high=high)
    return whole


def _bounds(effect: Effect) -> dict[str, tuple[float, float]]:
    """Return the bounds of parameters, without those that depend on the scale of the data.

    To separate the two, the effect is built for data of two different scales.
    """
    model, targets = effect.site.model, effect.site.targets
    names = (*model.state_names, *model.input_names)
    small, large = (
        effect.family.at(Site(model, targets, scales))
        for scales in (
            Scales(),
            Scales(dict.fromkeys(names, -1e3), dict.fromkeys(names, 1e3), dt=1.0, duration=1e4),
        )
    )
    return {
        q.name: (q.low if q.low == p.low else -math.inf, q.high if q.high == p.high else math.inf)
        for q, p in zip(small.quantities, large.quantities, strict=True)
        if not q.fixed
    }
