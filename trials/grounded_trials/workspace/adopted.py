"""Adopted effects, as listed in grounded.toml, as part of the model that plans.

    [model]
    effects = [ { name = "dead_zone:throttle", c = 0.146 } ]

Families come with grounded and with other packages (`installed_effects`);
`grounded.search.planner.planner_with` adds them to the model.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from importlib import metadata
from typing import TYPE_CHECKING

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

if TYPE_CHECKING:
    from grounded_trials.workspace.user_files.config import Effects

LINEAR = ("c", "k", "A", "B", "a", "b")  # parameters that an added rate is proportional to
LATE = (SensorDelayFamily, SensorLagFamily)
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
    params: Mapping[str, float], effects: Effects
) -> tuple[dict[str, float], dict[str, Mapping[str, float]]]:
    """Split parameters into the model's own, and those of effects, which are set in the effects."""
    own = dict(params)
    changed = {
        name: {q: own.pop(param_name(name, q), value) for q, value in values.items()}
        for name, values in effects.items()
    }
    return own, {**changed}


def family_of(library: Library, effect: str) -> Family:
    """Return the family of an effect `family:target`."""
    return library.family(effect.partition(":")[0])


def in_order(old: Effects, new: Effects) -> Effects:
    """Merge a model's effects with newly diagnosed ones, in the order in which they act.

    A rate gain was diagnosed on the rate including the adopted effects, but acts on the model's own
    rate. So the adopted effects on that rate are scaled by the gain.
    """
    library, grown = installed_effects(), dict[str, Mapping[str, float]]()
    for name, values in old.items():
        family, target = family_of(library, name), name.partition(":")[2]
        gain = 1 + new.get(f"rate_gain:{target.partition('<-')[0]}", {}).get("g", 0.0)
        scaled = LINEAR if isinstance(family, RateFamily) and not family.needs_own else ()
        grown[name] = {q: float(f"{v * gain:.8g}") if q in scaled else v for q, v in values.items()}
    both = [*grown.items()], [*new.items()]
    families = [[family_of(library, name) for name, _ in some] for some in both]
    return dict(both[late][i] for late, i in joining_order(*families))


def planner_of(task: Task, effects: Effects) -> Planner:
    """Return the planner of a task with these effects in its model, in the order they act."""
    library = installed_effects() if effects else None
    return planner_with(task, [*effects.items()], library, partial(_followed, dt=task.dt))


def _followed(effect: Effect, values: Mapping[str, float], dt: float) -> Mapping[str, float]:
    """Check an effect's parameters and widen a dry friction too steep for the time step.

    If c dt is many times the width over which the friction builds up, one step reverses a slow
    motion and makes it faster, so that no plan converges.
    """
    try:
        whole = effect.complete(values)
    except GroundedError as error:
        raise error.at("grounded.toml: [model] effects") from None
    for name, (low, high) in _bounds(effect).items():
        room = 1e-6 * abs(whole[name])
        if not low - room <= whole[name] <= high + room:
            where = f"grounded.toml: [model] effects: {effect.name}: {name}"
            raise wrong(where, whole[name], must="bounded", low=low, high=high)
    if effect.family.name != "coulomb_friction":
        return whole
    return {**whole, "width": max(whole["width"], abs(whole["c"]) * dt / STEEP)}


def but_late_sensors(effects: Effects) -> Effects:
    """Drop delays and lags of sensors from effects, for the model that estimates states.

    A log holds late values of a late state. Estimated states must be as late as the measured ones
    they are estimated from, or the two contradict each other.
    """
    library = installed_effects() if effects else Library()
    return {n: v for n, v in effects.items() if not isinstance(family_of(library, n), LATE)}


def _bounds(effect: Effect) -> dict[str, tuple[float, float]]:
    """Return the bounds of parameters that are the same for data of two different scales."""
    model, targets = effect.site.model, effect.site.targets
    signals = (*model.state_names, *model.input_names)
    low, high = (dict.fromkeys(signals, size) for size in (-1e3, 1e3))
    scales = (Scales(), Scales(low, high, dt=1.0, duration=1e4))
    small, large = (effect.family.at(Site(model, targets, one)).quantities for one in scales)
    return {
        q.name: (q.low if q.low == p.low else -math.inf, q.high if q.high == p.high else math.inf)
        for q, p in zip(small, large, strict=True)
        if not q.fixed
    }
