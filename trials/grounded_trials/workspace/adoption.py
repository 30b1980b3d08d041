"""Adoption: what a diagnosis found, taken into [model] of grounded.toml, and what is known of it.

Effects that were fitted together are adopted together, in the order of the fit, and values only
hold with the parameters that were estimated beside them: those are adopted, too, unless the trials
do not tell them or a bound cut them.

reports/adoptions.json records [model] before each adoption, so that it can be undone, how sure its
values are, and which effects were undone: they are not suggested again.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from grounded.checks import refused, unknown
from grounded.diagnosis.causes import sign_only
from grounded.diagnosis.error_report import gain, telling
from grounded.diagnosis.parts import Diagnosis, Estimate
from grounded.diagnosis.telling import errors_line, open_line
from grounded.effects import param_name
from grounded.effects.joint import like_a_load
from grounded.errors import GroundedError, NextCommand
from grounded.findings import Finding, Quantity, found, settle
from grounded.model import Model, all_at_bounds
from grounded.result import UNSAID, Document, listed, number
from grounded.search.planner import Planner
from grounded_trials.store.documents import read_as, write_document
from grounded_trials.wording import rendered
from grounded_trials.workspace.adopted import in_order, installed_effects, planner_of, settled
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.last_diagnosis import (
    Since,
    made_from,
    newer_alone,
    read_diagnosis,
    since_diagnosis,
)
from grounded_trials.workspace.last_fit import fitted_in_vain, last_fit
from grounded_trials.workspace.new_target import to_plan
from grounded_trials.workspace.readings import changed_since, in_time_now, last_again
from grounded_trials.workspace.user_files.config import ModelTable, as_toml, set_in_model

AGAIN, PROPOSE = NextCommand("diagnose"), NextCommand("propose")
KEPT = "adoptions.json"  # in reports/
NEGLIGIBLE_STEP = 0.1  # fraction of a control step: shorter filters and delays make no difference
NO_CHANGE = 1e-3  # relative change of a parameter that counts as none
WRITTEN = 1e-6  # relative difference of a value and what is written of it

Effects = Sequence[Mapping[str, Any]]
Texts = Mapping[str, tuple[str, ...]]


@dataclass(frozen=True, eq=False, repr=False)
class Adopted(Document):
    """The model's effects and parameters after an adoption."""

    effects: tuple[Mapping[str, Any], ...]  # all adopted effects
    params: Mapping[str, float]  # model parameters written with the new effects
    claimed: bool  # whether the diagnosis claims the new effects; else one was adopted alone
    jointly: tuple[str, ...] = ()  # parameters and effects determined only with the others
    along: tuple[str, ...] = ()  # late and filtering sensors that were adopted without being named
    left: Mapping[str, float] = field(default_factory=dict)  # fitted values that were not adopted
    findings: tuple[Finding, ...] = ()  # what an adoption leaves to be done or known
    then: NextCommand = field(metadata=UNSAID, default=PROPOSE)

    def summary(self) -> str:
        """Return the effects that the model has now."""
        return ", ".join(_names(self.effects))


@dataclass(frozen=True, eq=False, repr=False)
class Undone(Document):
    """The model's effects and parameters after an adoption was undone."""

    undone: tuple[str, ...]  # the effects of the adoption that was undone
    effects: tuple[Mapping[str, Any], ...]  # all adopted effects
    params: Mapping[str, float]  # [model] params
    findings: tuple[Finding, ...] = ()
    then: NextCommand = field(metadata=UNSAID, default=PROPOSE)

    def summary(self) -> str:
        """Return the effects that were removed from the model."""
        return ", ".join(self.undone)


def _names(effects: Effects) -> list[str]:
    return [str(effect["name"]) for effect in effects]


def _numbers(effects: Iterable[Mapping[str, Any]]) -> Iterator[tuple[str, str, str, float]]:
    """Yield effect, quantity, name as a parameter and value of each number of some effects."""
    for effect in effects:
        name = str(effect["name"])
        yield from ((name, q, param_name(name, q), v) for q, v in effect.items() if q != "name")


# what a diagnosis offers


def left_behind(diagnosis: Diagnosis) -> dict[str, Estimate]:
    """Return the parameters, also of adopted effects, that changed in the fit but are not adopted.

    The prediction errors of the diagnosis include their changes.
    """
    nominal, kept = made_from(diagnosis).nominal, diagnosis.adoptable
    return {
        name: e
        for name, e in diagnosis.parameters.items()
        if name not in kept and (old := nominal.get(name)) is not None
        if abs(e.value - old) > NO_CHANGE * max(abs(old), e.std)
    }


def late_open(workspace: Folder, diagnosis: Diagnosis) -> tuple[str, ...]:
    """Return the filters and delays of sensors that a diagnosis found and the model lacks."""
    task = workspace.config.task
    if not (task.target and task.feedback):
        return ()
    known = {*_names(workspace.config.model.effects), *in_time_now(workspace, diagnosis.preflight)}
    late = diagnosis.late_sensors.items()
    return tuple(
        n for n, own in late if n not in known and max(own.values()) > NEGLIGIBLE_STEP * task.dt
    )


def to_adopt(workspace: Folder, diagnosis: Diagnosis) -> NextCommand | None:
    """Return the command that acts on the claims of a diagnosis, or None if there is none.

    Filters and delays of sensors are adopted too if states are fed back: feedback gains designed
    without them make the robot oscillate. Nothing is adopted if [log] reads the trials in another
    way now, or if they were all set aside: then their log is ingested again.
    """
    made, trials = made_from(diagnosis), workspace.whole_trials()
    here = {one.stored.id for one in trials}
    if made.trials and here.isdisjoint(made.trials):
        aside = [one for one in workspace.aside_trials() if one.stored.id in made.trials]
        return AGAIN if here else last_again(workspace, aside)
    if changed_since(workspace, diagnosis, here) and (first := last_again(workspace, trials)):
        return first
    if diagnosis.changed:  # values of two robots together fit neither
        return newer_alone(diagnosis)

    # What is new, but what the user has undone; late sensors are adopted with it, or alone.
    table = workspace.config.model
    new, undone = diagnosis.open(table.effects, table.params), {*adoptions(workspace).undone}
    late = tuple(name for name in late_open(workspace, diagnosis) if name not in undone)
    alone = NextCommand("adopt", late) if late else None
    claimed = diagnosis.kind in ("effect", "several") and not diagnosis.contested
    load = len(new) > 1 and like_a_load(workspace.planner.plan.model, new)
    if not claimed or {*new} <= undone or load:
        return alone

    # A bound is widened, or a sign flipped, before anything is adopted, as the diagnosis says.
    params = workspace.base_model.params
    off = {n: e.value for n, e in diagnosis.parameters.items() if n in diagnosis.verdict.parameters}
    ended = all_at_bounds(params, {n: value for n, value in off.items() if n in params})
    rows = (row for row in diagnosis.ranking if row.effect in new)
    if ended or any(sign_only(row.effect, row.params) for row in rows):
        return AGAIN

    # Only parameters: they are all fitted together, unless that was done without a gain.
    if {f"parameter:{name}" for name in params}.issuperset(new):
        some = (*made.named, *made.compared)
        if not table.effects and not fitted_in_vain(workspace, some):  # else adopted beside them
            return NextCommand("fit", ("--trials", ",".join(some)) if some else ())
        if gain(diagnosis.prediction_error, "crude", "with_effects") <= 0:
            return alone
    return NextCommand("adopt", (*new, *late))


def not_adopted(workspace: Folder, diagnosis: Diagnosis | None) -> Finding | None:
    """Return what the last diagnosis found that the model lacks, with the command, if anything.

    Nothing is said of a diagnosis of another model, or if its effects were adopted and undone.
    """
    if diagnosis is None or since_diagnosis(workspace, diagnosis).changed:
        return None
    then, clauses = to_adopt(workspace, diagnosis), diagnosis.verdict.causes or diagnosis.effects
    if then is None or then.verb not in ("adopt", "fit") or not clauses:
        return None
    command = rendered(then, workspace.address)
    more = len(clauses) - 1
    return found("plan.lacks", then=then, cause=clauses[0], more=more, command=command)


def joined(
    diagnosis: Diagnosis,
    names: Iterable[str],
    effects: Effects,
    nominal: Mapping[str, float],
    calibrated: Mapping[str, Estimate],
) -> tuple[dict[str, float], list[dict[str, Any]]]:
    """Return the parameters to set and all effects, after adding diagnosed effects to a model.

    Args:
        diagnosis: the diagnosis.
        names: its effects to add, in any order: they are added in the order of the fit.
        effects: the effects that the model has already.
        nominal: the values to which changes of parameters among `names` are added.
        calibrated: the parameters that are adopted with the effects.

    Raises:
        GroundedError: if a value is not known.
    """
    before, fitted = made_from(diagnosis).effects, [*diagnosis.joining]
    old, new = {str(effect["name"]): dict(effect) for effect in effects}, list[dict[str, Any]]()
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
            new.append({"name": name} | {q: _rounded(value) for q, value in values.items()})
    own, both = settled(params, [*old.values(), *new])
    return own, in_order(both[: len(old)], both[len(old) :])


def _rounded(value: float) -> float:
    if not math.isfinite(value):
        raise refused("model.not_adoptable", "it", why="unvalued", then=AGAIN)
    return float(f"{float(value):.8g}")


def _nominal(workspace: Folder, diagnosis: Diagnosis) -> dict[str, float]:
    """Return the values that parameters had when the diagnosis was made; else those of now."""
    own = {name: float(one.value) for name, one in workspace.base_model.params.items()}
    return own | dict(made_from(diagnosis).nominal)


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
    model, before = workspace.config.model, made_from(diagnosis).effects
    nominal = _nominal(workspace, diagnosis)
    own, adopted = joined(diagnosis, names, model.effects, nominal, calibrated)
    params = dict(model.params) | own
    earlier = adoptions(workspace).adoptions  # raises before anything is written, as does
    planner_of(workspace.task, adopted)  # a model that can't be built from these effects

    # Write it, and how it can be undone.
    set_in_model(workspace.config.file, params if own else None, adopted or None)
    step = _step(diagnosis, names, own, adopted, calibrated)
    after = {"effects": adopted or _written(model)["effects"], "params": params}
    step = replace(step, before=_written(model), after=after)
    write_document(workspace.reports / KEPT, Kept((*earlier, step)).to_json())

    # What differs from the fit in which the values were found.
    fitted = {*names, *before, *(diagnosis.effects if claimed else ()), *diagnosis.late_sensors}
    left = left_behind(diagnosis) if whole_fit else {}
    left = {name: one for name, one in left.items() if name not in own}
    done = Adopted(
        effects=tuple(adopted),
        params=own,
        claimed=claimed,
        jointly=(
            *(name for name in own if name in {*calibrated} & {*diagnosis.jointly}),
            *(name for name in names if name in diagnosis.combined),
        ),
        along=tuple(name for name in names if name not in asked),
        left={name: one.value for name, one in left.items()},
        then=to_plan(workspace),
    )
    named = [effect for effect in adopted if effect["name"] in asked]
    told = [*_readings(workspace.base_model, named)]
    called = {name: f"{q} of {effect}" for effect, q, name, _ in _numbers(before.values())}
    for name, e in left.items():
        kept, value = Quantity(nominal[name], e.unit), Quantity(e.value, e.unit)
        told.append(found("model.not_told", called.get(name, name), kept=kept, value=value))
    told += [found("model.along", *done.along)] if done.along else []
    instead = [] if claimed else asked[:1]
    beside = [name for name in _names(adopted) if name not in fitted]
    told += [found("model.beside", *some) for some in (instead, beside) if some]
    if stopped := [n for n, e in diagnosis.parameters.items() if e.stopped and whole_fit]:
        told.append(found("model.at_bound", *stopped))
    return replace(done, findings=settle(told))


def _with_curves(diagnosis: Diagnosis, names: list[str]) -> list[str]:
    """Replace `correction:v` by its curves.

    Raises:
        GroundedError: if the correction is not adoptable, or claimed effects are not adopted too.
    """
    one, curves = diagnosis.correction, _curves(diagnosis)
    asked = [n for n in names if n.startswith("correction:")]
    if one is None or asked not in ([f"correction:{one.channel}"], curves):
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
    """Return whether the verdict claims all the effects, but for late sensors.

    Raises:
        GroundedError: if one is not in the diagnosis, was adopted since, or is a delay that [log]
            takes out already; if several are named and some were fitted as alternatives to others.
    """
    physics = [name for name in names if name not in diagnosis.late_sensors]
    if diagnosis.changed and physics:
        raise refused("gap.next.changed", then=newer_alone(diagnosis))
    before, own = made_from(diagnosis).effects, [*diagnosis.effects, *_curves(diagnosis)]
    known = {*(row.effect for row in diagnosis.ranking), *own, *diagnosis.late_sensors}
    adopted = {*_names(workspace.config.model.effects)} - {*before}.intersection(known)
    in_log = in_time_now(workspace, diagnosis.preflight)
    for name in names:
        if name not in known | adopted:
            raise unknown("effect", name, known, "the last diagnosis")
        if name in in_log:
            keys = (f"[log.state.{name.partition(':')[2]}] delay_s = {in_log[name]:g}",)
            raise refused("plan.delay_twice", keys=keys, effects=(name,))
        if name in adopted:
            raise refused("model.not_adoptable", name, why="adopted")
    if diagnosis.no_cause and physics:
        raise refused("gap.too_few", then=AGAIN)
    rivals = [name for name in physics if name not in own]
    if rivals and len(physics) > 1:
        then = NextCommand("adopt", diagnosis.effects or (rivals[0],))
        raise refused("model.not_adoptable", *rivals, why="rival", then=then)
    return not rivals


def _readings(model: Model, effects: Effects) -> Iterator[Finding]:
    """Yield which states are in readings of their sensors, once these effects are adopted."""
    for effect in effects:
        family, _, state = str(effect["name"]).partition(":")
        size = effect.get("b", effect.get("k", 0.0))
        way = "low" if size < 0 else "high"
        if family == "sensor_bias":
            bias = Quantity(abs(size), model.states[state])
            yield found("model.readings", state, bias=bias, way=way, offset=-size)
        elif family == "sensor_scale":
            yield found("model.readings", state, by=abs(size), way=way)
        elif family == "sensor_delay":
            yield found("model.readings", *state.split("+"), age=Quantity(effect["d"], "s"))


def undo_adoption(workspace: Folder) -> Undone:
    """Undo the last `adopt`: restore the effects and params of grounded.toml.

    Raises:
        GroundedError: if nothing is left to undo, or [model] was changed since.
    """
    kept, file, model = adoptions(workspace), workspace.config.file, workspace.config.model
    if not kept.adoptions:
        has = ", ".join(_names(model.effects)) or "none"
        raise refused("model.edited", file, effects=has)
    last = kept.adoptions[-1]
    params, effects = last.before["params"], last.before["effects"]
    if _written(model) != last.after:
        was = as_toml(params, effects)
        had = listed(f"{name} = {value.as_string()}" for name, value in was.items())
        raise refused("model.edited", file, adopted=last.names, had=had)
    set_in_model(file, params=params, effects=effects)
    left = Kept(kept.adoptions[:-1], (*kept.undone, *last.names))
    write_document(workspace.reports / KEPT, left.to_json())
    return Undone(
        undone=last.names,
        effects=tuple(effects),
        params=params,
        then=to_plan(workspace),
    )


def _written(model: ModelTable) -> dict[str, Any]:
    """Return the parts of [model] that an adoption may change, for JSON."""
    return {"effects": [dict(e) for e in model.effects], "params": dict(model.params)}


# what is kept of it


@dataclass(frozen=True, eq=False, repr=False)
class Step(Document):
    """One adoption: [model] before and after it, and what its diagnosis knew."""

    names: tuple[str, ...]
    before: Mapping[str, Any] = field(default_factory=dict)
    after: Mapping[str, Any] = field(default_factory=dict)
    known: Mapping[str, tuple[float, ...]] = field(default_factory=dict)  # values with their std
    ties: Texts = field(default_factory=dict)  # effects that the trials could not tell from one
    equivalent: Texts = field(default_factory=dict)  # those of them that no trial can
    given: Texts = field(default_factory=dict)  # what a value rests on


@dataclass(frozen=True, eq=False, repr=False)
class Kept(Document):
    """The adoptions that can be undone, oldest first, and effects undone since a diagnosis."""

    adoptions: tuple[Step, ...] = ()
    undone: tuple[str, ...] = ()

    def of(self, key: str) -> dict[str, tuple[Any, ...]]:
        """Return what the last adoption of each effect or parameter kept under a key."""
        kept = dict[str, tuple[Any, ...]]()
        for step in self.adoptions:
            kept |= dict.fromkeys((*step.names, *step.known), ()) | dict(getattr(step, key))
        return {name: each for name, each in kept.items() if each}


def adoptions(workspace: Folder) -> Kept:
    """Read the adoptions of a workspace.

    Raises:
        GroundedError: if reports/adoptions.json can't be read.
    """
    return read_as(workspace.reports / KEPT, Kept, mend="delete") or Kept()


def _readable(workspace: Folder) -> Kept:
    """Read the adoptions of a workspace; a damaged file counts as none."""
    try:
        return adoptions(workspace)
    except GroundedError:
        return Kept()


def diagnosed_again(workspace: Folder) -> None:
    """Forget which effects were undone: a newer diagnosis may claim them again."""
    kept = adoptions(workspace)
    if kept.undone:
        write_document(workspace.reports / KEPT, Kept(kept.adoptions).to_json())


def _step(
    diagnosis: Diagnosis,
    names: Sequence[str],
    own: Mapping[str, float],
    effects: Effects,
    calibrated: Mapping[str, Estimate],
) -> Step:
    """Return what is kept of the diagnosis from which effects and parameters are adopted."""
    std = {name: e.std for name, e in calibrated.items()}
    for row in (row for row in diagnosis.ranking if row.effect in names):
        family, _, target = row.effect.partition(":")
        own_name = family == "parameter"
        for q, e in row.params.items():
            std[target if own_name else param_name(row.effect, q)] = e.std
    now = {**own, **{name: value for _, _, name, value in _numbers(effects)}}
    ties = {name: _beside(diagnosis.indistinguishable, name) for name in names}
    return Step(
        tuple(names),
        known={name: (now[name], s) for name, s in std.items() if name in now and math.isfinite(s)},
        ties=ties,
        equivalent={name: _beside(diagnosis.equivalent, name) for name in ties},
        given={name: on for name, on in diagnosis.conditions.items() if name in {*names, *own}},
    )


def _beside(groups: Sequence[Sequence[str]], name: str) -> tuple[str, ...]:
    """Return the other effects of the groups that an effect is in."""
    others = (other for group in groups if name in group for other in group if other != name)
    return tuple(dict.fromkeys(others))


def tied_when_adopted(workspace: Folder) -> dict[str, tuple[str, ...]]:
    """Return the effects that the trials could not tell from an adopted one, by its name.

    Nothing compares them again, so a tie lasts as long as the one is part of the model and the
    other is not.
    """
    names, ties = _names(workspace.config.model.effects), _readable(workspace).of("ties")
    rest = {name: tuple(o for o in ties.get(name, ()) if o not in names) for name in names}
    return {name: others for name, others in rest.items() if others}


def equivalent_when_adopted(workspace: Folder) -> set[str]:
    """Return the adopted effects whose ties (`tied_when_adopted`) no trial can tell from them."""
    same, ties = _readable(workspace).of("equivalent"), tied_when_adopted(workspace).items()
    return {name for name, others in ties if {*others} <= {*same.get(name, ())}}


# the model as it is now


def units_of(workspace: Folder, effect: str) -> dict[str, str]:
    """Return the units of an effect's quantities, "" where they are not known.

    That is so beside another adopted effect, and of a package that is not installed.
    """
    units = {q: "" for e in workspace.config.model.effects if e["name"] == effect for q in e}
    units.pop("name", None)
    try:
        known = installed_effects().effect(effect, workspace.base_model).free
    except GroundedError:
        return units
    return units | {q.name: q.unit for q in known}


def numbers_in(workspace: Folder) -> dict[str, tuple[float, str]]:
    """Return the numbers of the adopted effects with their units, as they are called."""
    numbers = _numbers(workspace.config.model.effects)
    return {f"{q} of {e}": (v, units_of(workspace, e).get(q, "")) for e, q, _, v in numbers}


def known_values(workspace: Folder, diagnosis: Diagnosis | None = None) -> dict[str, Estimate]:
    """Return the values of parameters and adopted effects, by parameter name, with their +-.

    The +- is that of the diagnosis, of the adoption or of the last fit, the first that has this
    value; NaN if none has.
    """
    own = dict(diagnosis.parameters) if diagnosis else {}
    for row in diagnosis.ranking if diagnosis else ():
        own |= {param_name(row.effect, q): e for q, e in row.params.items()}
    fitted = {name: (e.value, e.std) for name, e in own.items()}
    sources = (fitted, _readable(workspace).of("known"), last_fit(workspace).known)
    now = {name: (one.value, one.unit) for name, one in workspace.base_model.params.items()}
    for effect, q, name, value in _numbers(workspace.config.model.effects):
        now[name] = float(value), units_of(workspace, effect)[q]
    found_values = dict[str, Estimate]()
    for name, (value, unit) in now.items():
        pairs = (source[name] for source in sources if len(source.get(name, ())) == 2)
        same = (std for at, std in pairs if _same(at, value))
        found_values[name] = Estimate(value, next(same, math.nan), unit=unit)
    return found_values


def _same(one: float, other: float) -> bool:
    return math.isclose(one, other, rel_tol=WRITTEN, abs_tol=1e-12)


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
    table, task = workspace.config.model, workspace.task
    if diagnosis is not None:
        new = diagnosis.open(table.effects, table.params)
        names = [name for name in diagnosis.joining if name in new and diagnosis.ranked(name)]
        known = {n: e for n, e in diagnosis.adoptable.items() if math.isfinite(e.value)}
        nominal = _nominal(workspace, diagnosis)
        params, effects = joined(diagnosis, names, table.effects, nominal, known)
        own = {name: value for name, value in params.items() if name in task.model.params}
        if own or names:
            estimated = task.with_model(task.model.with_values(own))
            return Better(planner_of(estimated, effects), "as diagnosed")
    return Better(workspace.planner, "with adopted effects") if table.effects else None


@dataclass(frozen=True)
class Settled:
    """What was adopted, and the prediction errors that a diagnosis measured of the model now.

    `closed`: everything that the last diagnosis claims has been adopted. `open`: what is still
    open, if the diagnosis says so of the model now.
    """

    rows: tuple[tuple[str, str], ...]  # name and values of each effect and parameter
    closed: bool = False
    gained: Finding | None = None
    open: Finding | None = None

    @property
    def adopted(self) -> tuple[str, ...]:
        """Name and values in one text each."""
        return tuple(f"{name}: {values}" for name, values in self.rows)


def settled_in(workspace: Folder, diagnosis: Diagnosis | None, since: Since) -> Settled | None:
    """Return how a workspace's model differs from model.py; None if it does not.

    The gain is the one that the last diagnosis measured, if it was made with this model or claims
    what was adopted since; else none is told.

    Args:
        workspace: the workspace, whose grounded.toml lists what was adopted.
        diagnosis: the last diagnosis.
        since: changes since then.
    """
    rows = tuple(_rows(workspace, diagnosis))
    if not rows or diagnosis is None or diagnosis.no_cause:
        return Settled(rows) if rows else None
    left = next(open_line(diagnosis), None) if diagnosis.leftover else None
    if not since.changed:
        return Settled(rows, gained=_errors(diagnosis, "crude", "outset"), open=left)
    if not _as_claimed(diagnosis, workspace.config.model):
        return Settled(rows)
    gained = _errors(diagnosis, "with_effects", "outset")
    gained = gained or _errors(diagnosis, "with_effects", "crude")
    return Settled(rows, closed=True, gained=gained, open=left)


def _errors(diagnosis: Diagnosis, now: str, before: str) -> Finding | None:
    """Return how far predictions are off, and were; None if one of them is not known."""
    row = telling(diagnosis.prediction_error)
    if row is None or not (getattr(row, now) and getattr(row, before)):
        return None
    return next(errors_line(diagnosis, now, before), None)


def _as_claimed(diagnosis: Diagnosis, table: ModelTable) -> bool:
    """Return whether the model is the one that the diagnosis claims, with everything adopted.

    Late sensors that it found may be adopted or not.
    """
    if left_behind(diagnosis) or not diagnosis.effects:
        return False
    made, now = made_from(diagnosis), {str(e["name"]): dict(e) for e in table.effects}
    both = [*diagnosis.effects, *(name for name in diagnosis.late_sensors if name in now)]
    try:
        known = diagnosis.adoptable
        own, effects = joined(diagnosis, both, made.adopted, made.nominal, known)
    except (GroundedError, KeyError):  # a document of an older version
        return False
    wanted = {str(effect["name"]): effect for effect in effects}
    return now == wanted and dict(made.params or {}) | own == dict(table.params)


def _rows(workspace: Folder, diagnosis: Diagnosis | None) -> Iterator[tuple[str, str]]:
    """Yield the name and the values of each adopted effect, then of each adopted parameter."""
    table, model, kept = workspace.config.model, workspace.origin.model, _readable(workspace)
    known, adopted, rests = known_values(workspace, diagnosis), kept.of("known"), kept.of("given")
    ties = tied_when_adopted(workspace)

    def given(name: str) -> str:
        text = "".join(f", or {other}" for other in ties.get(name, ()))
        value = table.params.get(name)
        fitted = value is not None and not _same(adopted.get(name, (math.inf,))[0], value)
        on = () if fitted else rests.get(name, ())
        return text + f", given {listed(on)}" * bool(on)

    for name in _names(table.effects):
        units = units_of(workspace, name)
        numbers = [(q, one) for effect, q, one, _ in _numbers(table.effects) if effect == name]
        each = (f"{q} = {known[one].text}" for q, one in numbers if q in units)
        yield name, f"{', '.join(each)}{given(name)}"
    for name, param in model.params.items():
        if table.params.get(name, param.value) != param.value:
            yield name, f"{known[name].text}{given(name)}, was {number(param.value)}"
