"""What a diagnosis offers to adopt, and what was adopted or undone since.

Effects that were fitted together are adopted together, in the order of the fit, and values only
hold with the parameters that were estimated beside them. reports/adoptions.json records [model]
before each adoption, so that it can be undone, and which effects were undone: they are not
suggested again.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from grounded.checks import refused, unknown
from grounded.errors import GroundedError, NextCommand
from grounded_trials.plain_file import unreadable
from grounded_trials.store.documents import read_document, write_document
from grounded_trials.workspace.last_diagnosis import made_from, newer_alone
from grounded_trials.workspace.where_to_mend import in_time_now

if TYPE_CHECKING:
    from grounded.diagnosis.parts import Diagnosis, Estimate
    from grounded.search.planner import Planner
    from grounded_trials.workspace.folder import Folder

AGAIN = NextCommand("diagnose")
KEPT = "adoptions.json"  # in reports/
SHORT = 0.1  # fraction of a control step: shorter filters and delays make no difference


def check_adoptable(
    names: Sequence[str], found: Diagnosis, workspace: Folder, before: Mapping[str, Any]
) -> None:
    """Check that each effect is in the diagnosis and was not adopted since.

    Raises:
        GroundedError: if not, or if [log] already corrects the delay that it describes.
    """
    if found.changed and not set(names) <= {*found.late_sensors}:
        raise refused("gap.next.changed", then=newer_alone(found))
    known = [row.effect for row in found.ranking] + _curves(found) + [*found.late_sensors]
    effects = [str(effect["name"]) for effect in workspace.config.model.effects]
    adopted = [name for name in effects if name not in before or name not in known]
    in_log = in_time_now(workspace, found.preflight)
    for name in names:
        if name not in known and name not in adopted:
            _check_alike(name, found)
            family = [one for one in known if one.startswith(f"{name}:")]
            raise unknown("effect", name, family[:1] or known, "the last diagnosis")
        if name in in_log:
            _, _, state = name.partition(":")
            keys = (f"[log.state.{state}] delay_s = {in_log[name]:g}",)
            raise refused("plan.delay_twice", keys=keys, effects=(name,))
        if name in adopted:
            raise refused("model.not_adoptable", name, why="adopted")


def _check_alike(name: str, found: Diagnosis) -> None:
    """Refuse an effect that the diagnosis only lists as alike a claimed one, without values."""
    alike = next((one for one in found.lookalikes if one.like == name), None)
    if alike is None:
        return
    family = alike.effect.partition(":")[0]
    then = NextCommand("diagnose", ("--without", family))
    if family == name.partition(":")[0]:
        then = NextCommand("adopt", found.effects)
    facts = {"why": "alike", "share": alike.share, "effect": alike.effect}
    raise refused("model.not_adoptable", name, then=then, **facts)


def claims_all(found: Diagnosis, names: Sequence[str]) -> bool:
    """Return whether the verdict claims all the effects.

    Raises:
        GroundedError: if nothing can be adopted, or several effects are named and some of them were
            fitted as alternatives to others.
    """
    if found.no_cause:
        raise refused("gap.too_few", then=AGAIN)
    rivals = [name for name in names if name not in (*found.effects, *_curves(found))]
    if rivals and len(names) > 1:
        then = NextCommand("adopt", found.effects or (rivals[0],))
        raise refused("model.not_adoptable", *rivals, why="rival", then=then)
    return not rivals


def with_curves(found: Diagnosis, names: list[str]) -> list[str]:
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
        raise refused("model.not_adoptable", asked[0], why="worse")
    missing = [name for name in found.effects if name not in names]
    if missing:
        then = NextCommand("adopt", (*missing, asked[0]))
        facts = {"why": "together", "effect": tuple(missing)}
        raise refused("model.not_adoptable", asked[0], then=then, **facts)
    return [name for name in names if name not in asked] + curves


def _curves(found: Diagnosis) -> list[str]:
    return [] if found.correction is None else [curve.effect for curve in found.correction.curves]


def late_open(workspace: Folder, diagnosis: Diagnosis) -> tuple[str, ...]:
    """Return the filters and delays of sensors that a diagnosis found and the model lacks."""
    task = workspace.config.task
    if not (task.target and task.feedback):
        return ()
    known = {effect["name"] for effect in workspace.config.model.effects}
    known |= set(in_time_now(workspace, diagnosis.preflight))
    least = SHORT * task.dt
    found = diagnosis.late_sensors.items()
    return tuple(n for n, own in found if n not in known and max(own.values()) > least)


def joined(
    found: Diagnosis,
    names: Sequence[str],
    effects: Sequence[Mapping[str, Any]],
    nominal: Mapping[str, float],
    calibrated: Mapping[str, Estimate],
) -> tuple[dict[str, float], list[dict[str, Any]]]:
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
    adopted, new = [dict(effect) for effect in effects], list[dict[str, Any]]()
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


def nominal_values(found: Diagnosis, workspace: Folder, names: Iterable[str]) -> dict[str, float]:
    """Return the values that parameters among the effects had when the diagnosis was made.

    Raises:
        GroundedError: if neither the diagnosis nor the model has a value.
    """
    made, base = made_from(found), workspace.base_model.params
    nominal = {}
    for name in (n.removeprefix("parameter:") for n in names if n.startswith("parameter:")):
        if name not in made.nominal and name not in base:
            raise refused("model.not_adoptable", name, why="unvalued", then=AGAIN)
        nominal[name] = made.nominal[name] if name in made.nominal else float(base[name].value)
    return nominal


def _rounded(value: float) -> float:
    if not math.isfinite(value):
        raise refused("model.not_adoptable", "it", why="unvalued", then=AGAIN)
    return float(f"{float(value):.8g}")


@dataclass(frozen=True, eq=False)
class Better:
    """A model to compare the crude one with, and its name in a legend."""

    planner: Planner
    name: str


def better_model(workspace: Folder, diagnosis: Diagnosis | None) -> Better | None:
    """Return the diagnosed model, else the one with adopted effects, or None if there is neither.

    Raises:
        GroundedError: if the diagnosis names an unknown effect or parameter.
    """
    own, effects = _as_diagnosed(workspace, diagnosis) if diagnosis is not None else ({}, [])
    if not (own or effects):
        adopted = workspace.config.model.effects
        return Better(workspace.planner, "with adopted effects") if adopted else None
    from grounded_trials.workspace.adopted import planner_of  # slow

    task = workspace.task
    estimated = task.with_model(task.model.with_values(own))
    return Better(planner_of(estimated, effects), "as diagnosed")


def _as_diagnosed(
    workspace: Folder, diagnosis: Diagnosis
) -> tuple[dict[str, float], list[dict[str, Any]]]:
    """Return parameters and effects including claims not adopted yet; empty if there are none."""
    from grounded_trials.workspace.adopted import in_order

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


def declined(workspace: Folder) -> tuple[str, ...]:
    """Return the effects of the last diagnosis that were adopted and undone since."""
    return tuple(str(name) for name in adoptions(workspace)[1])


def adoptions(workspace: Folder) -> tuple[list[dict[str, Any]], list[str]]:
    """Read the adoptions that can be undone, oldest first, and those undone since a diagnosis."""
    path = workspace.reports / KEPT
    try:
        document = read_document(path)
        return list(document["adoptions"]), list(document["undone"])
    except FileNotFoundError:
        return [], []
    except (ValueError, KeyError, TypeError, RecursionError, GroundedError) as error:
        raise unreadable(path, error, mend="delete") from None


def diagnosed_again(workspace: Folder) -> None:
    """Forget which effects were undone: a newer diagnosis may claim them again."""
    kept, undone = adoptions(workspace)
    if undone:
        write_document(workspace.reports / KEPT, {"adoptions": kept, "undone": []})
