"""Effects that grounded.toml says were adopted, as part of the model that plans.

`better_model` has those that were diagnosed in it before anybody adopts them, for reports to draw
beside the crude one; once effects are adopted and nothing newer was diagnosed, it is the model that
plans.

    [model]
    effects = [ { name = "dead_zone:throttle", c = 0.146 } ]

Families come with grounded and with other packages (`installed_effects`); how they
join the model: `grounded.search.planner.planner_with`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from grounded.effects.family import (
    Effect,
    Family,
    RateFamily,
    Scales,
    SensorDelayFamily,
    SensorLagFamily,
    Site,
)
from grounded.effects.order import joining_order
from grounded.effects.registry import Library
from grounded.errors import GroundedError
from grounded.search.planner import Planner, planner_with
from grounded.task import Task

if TYPE_CHECKING:
    from grounded.diagnosis.report import Diagnosis
    from grounded_trials.workspace.folder import Folder

LINEAR = ("c", "k", "A", "B", "a", "b")  # the numbers of an added rate that it grows with
STEEP = 3.0  # times its width: what a dry friction takes off a speed in a step, at most


def installed_effects() -> Library:
    """The effects that may be blamed: built in, and those of other packages.

    A package adds families by the entry point group `grounded.effects`: a family, or a sequence of
    families.

    Raises:
        GroundedError: for an entry point that can't be loaded or holds something else.
    """
    from importlib.metadata import entry_points

    found: list[Family] = []
    for point in entry_points(group="grounded.effects"):
        try:
            loaded = point.load()
        except Exception as error:
            raise GroundedError(
                f"the effects of package '{point.value}' can't be loaded: {error}; mend or "
                "uninstall it"
            ) from None
        families = [loaded] if isinstance(loaded, Family) else list(loaded)
        if not all(isinstance(family, Family) for family in families):
            raise GroundedError(f"'{point.value}' must be an effect family or a sequence of them")
        found += families
    return Library().with_families(found)


def in_order(
    old: Sequence[Mapping[str, Any]], new: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """Effects that a model has and those that were diagnosed on it, in the order in which they act.

    A gain of a rate was found on the rate that the model had by then, adopted effects and all; here
    it acts on the model's own, so that those grow with it.

    Args:
        old: of the model, as [model] effects has them.
        new: in the order of the diagnosis (`Diagnosis.joining`).
    """
    library = installed_effects()
    both = ([_grown(library, effect, new) for effect in old], new)
    families = [[library.family(str(e["name"]).partition(":")[0]) for e in some] for some in both]
    return [dict(both[late][i]) for late, i in joining_order(*families)]


def _grown(
    library: Library, effect: Mapping[str, Any], new: Sequence[Mapping[str, Any]]
) -> Mapping[str, Any]:
    """An adopted effect on a rate, as much larger as a gain of that rate that joins the model."""
    name, _, target = str(effect["name"]).partition(":")
    family, driven = library.family(name), target.partition("<-")[0]
    gains = [1 + e["g"] for e in new if e["name"] == f"rate_gain:{driven}"]
    if not gains or not isinstance(family, RateFamily) or family.needs_own:
        return effect
    grown = {k: float(f"{v * gains[0]:.8g}") for k, v in effect.items() if k in LINEAR}
    return {**effect, **grown}


def planner_of(task: Task, effects: Sequence[Mapping[str, Any]]) -> Planner:
    """The planner of a task whose model got these effects, in the order in which they act.

    Raises:
        GroundedError: for an unknown effect, or a quantity that is missing or unknown.
    """
    library = installed_effects() if effects else None
    given = [(str(e["name"]), {k: v for k, v in e.items() if k != "name"}) for e in effects]
    return planner_with(task, given, library, partial(_followed, dt=task.dt))


def _followed(effect: Effect, values: Mapping[str, Any], dt: float) -> Mapping[str, float]:
    """The quantities with a dry friction as steep as a step can follow.

    Where c dt is many times the width over which it builds up, a step throws a slow motion back
    farther than it was: no plan gets through, a ball in a tube went to 4 m instead of 0.6.
    """
    whole = _checked(effect, values)
    if effect.family.name != "coulomb_friction":
        return whole
    return {**whole, "width": max(whole["width"], abs(whole["c"]) * dt / STEEP)}


def but_late_sensors(effects: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Effects but delays and lags of sensors: those of the model that estimates states.

    What a log has of a late state is its late value; states that nothing measures are estimated as
    late as what they are estimated from, or they contradict each other.
    """
    library = installed_effects() if effects else Library()
    family = {str(e["name"]): library.family(str(e["name"]).partition(":")[0]) for e in effects}
    late = SensorDelayFamily | SensorLagFamily
    return [e for e in effects if not isinstance(family[str(e["name"])], late)]


def _checked(effect: Effect, values: Mapping[str, Any]) -> Mapping[str, float]:
    """The quantities of an effect as grounded.toml has them: numbers, all there, in bounds."""
    where = f"grounded.toml: [model] effects: {effect.name}"
    for key, value in values.items():
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not math.isfinite(value):
            raise GroundedError(f"{where}: {key} must be a number, found {value!r}")
    try:
        whole = effect.complete(values)
    except GroundedError as error:
        raise GroundedError(f"grounded.toml: [model] effects: {error}") from None
    for name, (low, high) in _bounds(effect).items():
        room = 1e-6 * abs(whole[name])
        if not low - room <= whole[name] <= high + room:
            at_most = f" and at most {high:g}" * math.isfinite(high)
            at_least = f"at least {low:g}" if math.isfinite(low) else "a number"
            raise GroundedError(
                f"{where}: {name} = {whole[name]:g} can't be: expected {at_least}{at_most}; "
                "correct it, or take the effect out"
            )
    return whole


def _bounds(effect: Effect) -> dict[str, tuple[float, float]]:
    """Bounds that are a quantity's own; those that a scan chose by the data's scale are left out.

    They are told apart by building the effect for data of another size.
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
    own, effects = _as_diagnosed(workspace, diagnosis) if diagnosis is not None else ({}, [])
    if not (own or effects):
        adopted = workspace.config.model.effects
        return Better(workspace.planner, "with adopted effects") if adopted else None
    task = workspace.task
    estimated = task.with_model(task.model.with_values(own))
    return Better(planner_of(estimated, effects), "as diagnosed")


def _as_diagnosed(
    workspace: Folder, diagnosis: Diagnosis
) -> tuple[dict[str, float], list[dict[str, Any]]]:
    """The parameters and effects with what is claimed and not adopted; empty for nothing new."""
    from grounded_trials.workspace.adopting import joined, nominal_values

    table = workspace.config.model
    new = diagnosis.open(table.effects, table.params)
    names = [name for name in diagnosis.joining if name in new and diagnosis.ranked(name)]
    known = {n: e for n, e in diagnosis.known_parameters.items() if math.isfinite(e.value)}
    nominal = nominal_values(diagnosis, workspace, names)
    params, both = joined(diagnosis, names, table.effects, nominal, known)
    own = {name: value for name, value in params.items() if name in workspace.task.model.params}
    if not (own or names):
        return {}, []
    old = len(table.effects)
    return own, in_order(both[:old], both[old:])
