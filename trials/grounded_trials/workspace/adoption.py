"""Adoption: what a diagnosis found, taken into [model] of grounded.toml, and what is known of it.

Effects that were fitted together are adopted together, in the order of the fit, and values only
hold with the parameters that were estimated beside them: those are adopted, too, unless the trials
do not tell them or a bound cut them.

reports/adoptions.json records [model] before each adoption, so that it can be undone, how sure its
values are, and which effects were undone: they are not suggested again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from grounded.checks import refused, unknown
from grounded.diagnosis.causes import sign_only
from grounded.diagnosis.error_report import gain, telling
from grounded.diagnosis.parts import Diagnosis, Estimate, Made
from grounded.diagnosis.telling import errors_line, open_line
from grounded.effects import param_name
from grounded.effects.joint import like_a_load
from grounded.errors import GroundedError, NextCommand
from grounded.findings import Finding, Quantity, found, settle
from grounded.model import all_at_bounds
from grounded.result import UNSAID, Document, listed, number
from grounded.search.planner import Planner
from grounded_trials.plain_file import unreadable
from grounded_trials.store.documents import read_document, write_document
from grounded_trials.wording import rendered
from grounded_trials.workspace.adopted import in_order, installed_effects, planner_of, settled
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.last_diagnosis import (
    Since,
    as_fitted,
    fitted_in_vain,
    made_from,
    newer_alone,
    read_diagnosis,
    since_diagnosis,
    usable_ids,
)
from grounded_trials.workspace.new_target import logged_target, to_plan
from grounded_trials.workspace.user_files.config import ModelTable, as_toml, set_in_model
from grounded_trials.workspace.where_to_mend import changed_since, in_time_now, last_again

AGAIN, PROPOSE = NextCommand("diagnose"), NextCommand("propose")
KEPT = "adoptions.json"  # in reports/
NEGLIGIBLE_STEP = 0.1  # fraction of a control step: shorter filters and delays make no difference
NO_CHANGE = 1e-3  # relative change of a parameter that counts as none
WRITTEN = 1e-6  # relative difference of a value and what is written of it

Effects = Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class Moved:
    """A number of the model, or of one of its effects, with two values."""

    called: str  # `m`, or `k of coupling:w<-th`
    was: float
    now: float
    unit: str


@dataclass(frozen=True, eq=False, repr=False)
class Adopted(Document):
    """The model's effects and parameters after an adoption."""

    effects: tuple[Mapping[str, Any], ...]  # all adopted effects
    params: Mapping[str, float]  # model parameters written with the new effects
    claimed: bool  # whether the diagnosis claims the new effects; else one was adopted alone
    beside: tuple[str, ...] = ()  # adopted from the same diagnosis, but fitted instead of these
    jointly: tuple[str, ...] = ()  # parameters and effects determined only with the others
    along: tuple[str, ...] = ()  # late and filtering sensors that were adopted without being named
    left: Mapping[str, float] = field(default_factory=dict)  # fitted values that were not adopted
    findings: tuple[Finding, ...] = ()  # what an adoption leaves to be done or known
    rewritten: tuple[Moved, ...] = field(metadata=UNSAID, default=())  # of effects adopted before
    then: NextCommand = field(metadata=UNSAID, default=PROPOSE)

    def summary(self) -> str:
        """Return the effects that the model has now."""
        return ", ".join(str(effect["name"]) for effect in self.effects)


@dataclass(frozen=True, eq=False, repr=False)
class Undone(Document):
    """The model's effects and parameters after an adoption was undone."""

    undone: tuple[str, ...]  # the effects of the adoption that was undone
    effects: tuple[Mapping[str, Any], ...]  # all adopted effects
    params: Mapping[str, float]  # [model] params
    findings: tuple[Finding, ...] = ()
    rewritten: tuple[Moved, ...] = field(metadata=UNSAID, default=())  # of effects that stay
    then: NextCommand = field(metadata=UNSAID, default=PROPOSE)

    def summary(self) -> str:
        """Return the effects that were removed from the model."""
        return ", ".join(self.undone)


# what a diagnosis offers


def told_parameters(diagnosis: Diagnosis) -> dict[str, Estimate]:
    """Return the calibrated parameters that may be adopted.

    The trials identify them, and no bound cut a value that changed by less than its error.
    """
    nominal = made_from(diagnosis).nominal
    return {
        name: e
        for name, e in diagnosis.known_parameters.items()
        if not (e.stopped and abs(e.value - nominal.get(name, math.inf)) <= e.std)
    }


def left_behind(diagnosis: Diagnosis) -> dict[str, Moved]:
    """Return the parameters, also of adopted effects, that changed in the fit but are not adopted.

    The prediction errors of the diagnosis include their changes.
    """
    made, kept = made_from(diagnosis), told_parameters(diagnosis)
    called = {
        param_name(effect, key): f"{key} of {effect}"
        for effect, values in made.effects.items()
        for key in values
    }
    return {
        name: Moved(called.get(name, name), old, e.value, e.unit)
        for name, e in diagnosis.parameters.items()
        if name not in kept and (old := made.nominal.get(name)) is not None
        if abs(e.value - old) > NO_CHANGE * max(abs(old), e.std)
    }


def late_open(workspace: Folder, diagnosis: Diagnosis) -> tuple[str, ...]:
    """Return the filters and delays of sensors that a diagnosis found and the model lacks."""
    task = workspace.config.task
    if not (task.target and task.feedback):
        return ()
    known = {effect["name"] for effect in workspace.config.model.effects}
    known |= set(in_time_now(workspace, diagnosis.preflight))
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
    if (first := _to_read_again(workspace, diagnosis)) is not None:
        return first
    if diagnosis.changed:  # values of two robots together fit neither
        return newer_alone(diagnosis)

    # What is new, but what the user has undone; late sensors are adopted with it, or alone.
    new = diagnosis.open(workspace.config.model.effects, workspace.config.model.params)
    undone = {*adoptions(workspace)[1]}
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
        made = made_from(diagnosis)
        some = (*made.named, *made.compared)
        beside = workspace.config.model.effects  # found beside effects, they are adopted so
        if not beside and not fitted_in_vain(workspace, some):
            return NextCommand("fit", ("--trials", ",".join(some)) if some else ())
        if gain(diagnosis.prediction_error, "crude", "with_effects") <= 0:
            return alone
    return NextCommand("adopt", (*new, *late))


def _to_read_again(workspace: Folder, diagnosis: Diagnosis) -> NextCommand | None:
    """Return the command to type before the claims of a diagnosis are adopted, or None."""
    seen, trials = {*made_from(diagnosis).trials}, workspace.whole_trials()
    here = {one.stored.id for one in trials}
    if seen and seen.isdisjoint(here):
        aside = (one for one in workspace.aside_trials() if one.stored.id in seen)
        return AGAIN if here else last_again(workspace, [*aside])
    changed = changed_since(workspace, diagnosis, here)
    return last_again(workspace, trials) if changed else None


def not_adopted(workspace: Folder, diagnosis: Diagnosis | None) -> Finding | None:
    """Return what the last diagnosis found that the model lacks, with the command, if anything.

    Nothing is said of a diagnosis of another model, or if its effects were adopted and undone.
    """
    if diagnosis is None or since_diagnosis(workspace, diagnosis, usable_ids(workspace)).changed:
        return None
    then, clauses = to_adopt(workspace, diagnosis), diagnosis.verdict.causes or diagnosis.effects
    if then is None or then.verb not in ("adopt", "fit") or not clauses:
        return None
    command = rendered(then, workspace.address)
    more = len(clauses) - 1
    return found("plan.lacks", then=then, cause=clauses[0], more=more, command=command)


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
    before = made_from(diagnosis).effects
    _check(names, diagnosis, workspace, before)
    physics = [name for name in names if name not in diagnosis.late_sensors]
    claimed = not physics or _claims_all(diagnosis, physics)
    if physics and {*diagnosis.effects} <= {*physics}:
        names = list(dict.fromkeys([*names, *late_open(workspace, diagnosis)]))

    # The model with them.
    whole_fit = parameters and bool(physics) and claimed
    calibrated = told_parameters(diagnosis) if whole_fit else {}
    nominal = _nominal(diagnosis, workspace, names)
    old, model = workspace.config.model.effects, workspace.config.model
    own, both = joined(diagnosis, names, old, nominal, calibrated)
    adopted = in_order(both[: len(old)], both[len(old) :])
    whole = dict(model.params) | own
    earlier, _ = adoptions(workspace)  # raises before anything is written, as does
    planner_of(workspace.task, adopted)  # a model that can't be built from these effects

    # Write it, and how it can be undone.
    set_in_model(workspace.config.file, params=whole if own else None, effects=adopted or None)
    after = {"effects": adopted or model.effects, "params": whole if own else model.params}
    step = {"names": names, "before": _written(model), "after": after}
    step |= _as_found(diagnosis, names, own, _estimated(diagnosis, names, nominal, calibrated))
    write_document(workspace.reports / KEPT, {"adoptions": [*earlier, step], "undone": []})

    # What differs from the fit in which the values were found.
    fitted = {*names, *before, *(diagnosis.effects if claimed else ()), *diagnosis.late_sensors}
    jointly = [name for name in own if name in {*calibrated} & {*diagnosis.jointly}]
    left = left_behind(diagnosis) if whole_fit else {}
    left = {name: one for name, one in left.items() if name not in own}
    done = Adopted(
        effects=tuple(adopted),
        params=own,
        claimed=claimed,
        beside=tuple(n for n in (str(effect["name"]) for effect in adopted) if n not in fitted),
        jointly=(*jointly, *(name for name in names if name in diagnosis.combined)),
        along=tuple(name for name in names if name not in asked),
        left={name: one.now for name, one in left.items()},
        rewritten=_rewritten(workspace, old, adopted),
        then=to_plan(workspace),
    )
    stopped = [n for n, e in diagnosis.parameters.items() if e.stopped] if whole_fit else []
    told = [*_told(workspace, done, asked, left)]
    told += [found("model.at_bound", *stopped)] if stopped else []
    return replace(done, findings=settle(told))


def _check(
    names: Sequence[str], diagnosis: Diagnosis, workspace: Folder, before: Mapping[str, Any]
) -> None:
    """Check that each effect is in the diagnosis and was not adopted since.

    Raises:
        GroundedError: if not, or if [log] already corrects the delay that it describes.
    """
    if diagnosis.changed and not set(names) <= {*diagnosis.late_sensors}:
        raise refused("gap.next.changed", then=newer_alone(diagnosis))
    known = [*(row.effect for row in diagnosis.ranking), *_curves(diagnosis)]
    known += [*diagnosis.late_sensors]
    effects = [str(effect["name"]) for effect in workspace.config.model.effects]
    adopted = [name for name in effects if name not in before or name not in known]
    in_log = in_time_now(workspace, diagnosis.preflight)
    for name in names:
        if name not in known and name not in adopted:
            raise unknown("effect", name, known, "the last diagnosis")
        if name in in_log:
            keys = (f"[log.state.{name.partition(':')[2]}] delay_s = {in_log[name]:g}",)
            raise refused("plan.delay_twice", keys=keys, effects=(name,))
        if name in adopted:
            raise refused("model.not_adoptable", name, why="adopted")


def _claims_all(diagnosis: Diagnosis, names: Sequence[str]) -> bool:
    """Return whether the verdict claims all the effects.

    Raises:
        GroundedError: if nothing can be adopted, or several effects are named and some of them were
            fitted as alternatives to others.
    """
    if diagnosis.no_cause:
        raise refused("gap.too_few", then=AGAIN)
    rivals = [name for name in names if name not in (*diagnosis.effects, *_curves(diagnosis))]
    if rivals and len(names) > 1:
        then = NextCommand("adopt", diagnosis.effects or (rivals[0],))
        raise refused("model.not_adoptable", *rivals, why="rival", then=then)
    return not rivals


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


def joined(
    diagnosis: Diagnosis,
    names: Sequence[str],
    effects: Effects,
    nominal: Mapping[str, float],
    calibrated: Mapping[str, Estimate],
) -> tuple[dict[str, float], list[dict[str, Any]]]:
    """Return the parameters to set and all effects, after adding diagnosed effects to a model.

    Args:
        diagnosis: the diagnosis.
        names: its effects to add, in any order: they are added in the order of the fit.
        effects: the effects that the model has already; they stay in front.
        nominal: the value to which the change of each parameter among `names` is added.
        calibrated: the parameters that are adopted with the effects.
    """
    before = made_from(diagnosis).effects
    adopted, new = [dict(effect) for effect in effects], list[dict[str, Any]]()
    params = {key: _rounded(estimate.value) for key, estimate in calibrated.items()}
    fitted = {name: k for k, name in enumerate(diagnosis.joining)}
    for name in sorted(names, key=lambda name: fitted.get(name, len(fitted))):
        values = {key: _rounded(value) for key, value in diagnosis.values(name).items()}
        family, _, target = name.partition(":")
        if family == "parameter":
            params[target] = _rounded(nominal[target] + values["d"])
        elif name in before:  # a further delay adds to the adopted one
            values["d"] = _rounded(float(before[name]["d"]) + values["d"])
            adopted = [e | values if e["name"] == name else e for e in adopted]
        else:
            new.append({"name": name, **values})
    return settled(params, [*adopted, *new])


def _nominal(diagnosis: Diagnosis, workspace: Folder, names: Sequence[str]) -> dict[str, float]:
    """Return the values that parameters among the effects had when the diagnosis was made.

    Raises:
        GroundedError: if neither the diagnosis nor the model has a value.
    """
    own = {name: float(one.value) for name, one in workspace.base_model.params.items()}
    known = own | dict(made_from(diagnosis).nominal)
    asked = [n.removeprefix("parameter:") for n in names if n.startswith("parameter:")]
    for name in asked:
        if name not in known:
            raise refused("model.not_adoptable", name, why="unvalued", then=AGAIN)
    return {name: known[name] for name in asked}


def _rounded(value: float) -> float:
    if not math.isfinite(value):
        raise refused("model.not_adoptable", "it", why="unvalued", then=AGAIN)
    return float(f"{float(value):.8g}")


def _told(
    workspace: Folder, done: Adopted, asked: Sequence[str], left: Mapping[str, Moved]
) -> Iterator[Finding]:
    """Yield what an adoption leaves to be done or known.

    Args:
        workspace: the workspace.
        done: the adoption.
        asked: the effects that the user named.
        left: the parameters that changed in the fit and are not adopted.
    """
    for effect in done.effects:
        name = str(effect["name"])
        family, _, state = name.partition(":")
        size = effect.get("b", effect.get("k", 0.0))
        way = "low" if size < 0 else "high"
        if name in asked and family == "sensor_bias":
            bias = Quantity(abs(size), workspace.base_model.states[state])
            yield found("model.readings", state, bias=bias, way=way, offset=-size)
        elif name in asked and family == "sensor_scale":
            yield found("model.readings", state, by=abs(size), way=way)
        elif name in asked and family == "sensor_delay":
            yield found("model.readings", *state.split("+"), age=Quantity(effect["d"], "s"))
    if done.along:
        yield found("model.along", *done.along)
    for beside in ([] if done.claimed else asked[:1], done.beside):
        if beside:
            yield found("model.beside", *beside)
    for one in left.values():
        kept, value = (Quantity(value, one.unit) for value in (one.was, one.now))
        yield found("model.not_told", one.called, kept=kept, value=value)
    if not workspace.candidate_ids() and (logged := logged_target(workspace)):
        yield found("model.logged_target", logged)


def _estimated(
    diagnosis: Diagnosis,
    names: Sequence[str],
    nominal: Mapping[str, float],
    calibrated: Mapping[str, Estimate],
) -> dict[str, Estimate]:
    """Return what is adopted, by its name as a parameter of the model; arguments as of `joined`."""
    known, before = dict(calibrated), made_from(diagnosis).effects
    for row in (row for row in diagnosis.ranking if row.effect in names):
        family, _, target = row.effect.partition(":")
        for q, estimate in row.params.items():
            if family == "parameter":
                known[target] = estimate.moved(nominal[target])
            else:
                at = float(before.get(row.effect, {}).get(q, 0.0))
                known[param_name(row.effect, q)] = estimate.moved(at)
    return known


def undo_adoption(workspace: Folder) -> Undone:
    """Undo the last `adopt`: restore the effects and params of grounded.toml.

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
        undone=tuple(names),
        effects=tuple(before["effects"]),
        params=before["params"],
        rewritten=_rewritten(workspace, last["after"]["effects"], before["effects"]),
        then=to_plan(workspace),
    )


def _rewritten(workspace: Folder, before: Effects, after: Effects) -> tuple[Moved, ...]:
    """Return the quantities of effects in both lists that differ, in the order of the effects."""
    now = {str(effect["name"]): effect for effect in after}
    return tuple(
        Moved(f"{key} of {name}", float(was), float(now[name][key]), units.get(key, ""))
        for old in before
        if (name := str(old["name"])) in now
        for units in (units_of(workspace, name),)
        for key, was in old.items()
        if key != "name" and now[name].get(key, was) != was
    )


def _written(model: ModelTable) -> dict[str, Any]:
    """Return the parts of [model] that an adoption may change, for JSON."""
    return {"effects": [dict(e) for e in model.effects], "params": dict(model.params)}


# what is kept of it


def adoptions(workspace: Folder) -> tuple[list[dict[str, Any]], list[str]]:
    """Read the adoptions that can be undone, oldest first, and those undone since a diagnosis."""
    path = workspace.reports / KEPT
    try:
        document = read_document(path)
        return list(document["adoptions"]), [str(name) for name in document["undone"]]
    except FileNotFoundError:
        return [], []
    except (ValueError, KeyError, TypeError, RecursionError, GroundedError) as error:
        raise unreadable(path, error, mend="delete") from None


def diagnosed_again(workspace: Folder) -> None:
    """Forget which effects were undone: a newer diagnosis may claim them again."""
    kept, undone = adoptions(workspace)
    if undone:
        write_document(workspace.reports / KEPT, {"adoptions": kept, "undone": []})


def _as_found(
    diagnosis: Diagnosis,
    names: Sequence[str],
    own: Mapping[str, float],
    values: Mapping[str, Estimate],
) -> dict[str, Any]:
    """Return what reports/adoptions.json keeps of the diagnosis that effects are adopted from."""
    ties = {
        name: others for name in names if (others := _beside(diagnosis.indistinguishable, name))
    }
    known = {n: [e.value, e.std] for n, e in values.items() if math.isfinite(e.value + e.std)}
    return {
        "known": known,
        "ties": ties,
        "equivalent": {name: _beside(diagnosis.equivalent, name) for name in ties},
        "given": {n: [*on] for n, on in diagnosis.conditions.items() if n in {*names, *own}},
    }


def _beside(groups: Sequence[Sequence[str]], name: str) -> list[str]:
    """Return the other effects of the groups that an effect is in."""
    own = [group for group in groups if name in group]
    return list(dict.fromkeys(other for group in own for other in group if other != name))


def _kept(
    workspace: Folder, key: str, of: Callable[[Any], Any] = str
) -> dict[str, tuple[Any, ...]]:
    """Return what the last adoption of each effect or parameter kept under a key, as tuples.

    Empty if reports/adoptions.json is missing or can't be read. Steps that were written before the
    key was kept have none.
    """
    kept = dict[str, Any]()
    try:
        for step in adoptions(workspace)[0]:
            again = (*step["names"], *step.get("known", {}))
            kept |= dict.fromkeys(again, ()) | dict(step.get(key, {}))
        return {str(name): tuple(map(of, each)) for name, each in kept.items() if each}
    except (GroundedError, AttributeError, KeyError, TypeError, ValueError):
        return {}


def tied_when_adopted(workspace: Folder) -> dict[str, tuple[str, ...]]:
    """Return the effects that the trials could not tell from an adopted one, by its name.

    Nothing compares them again, so a tie lasts as long as the one is part of the model and the
    other is not.
    """
    now, ties = workspace.config.model.effects, _kept(workspace, "ties")
    names = [str(one["name"]) for one in now]
    rest = {name: tuple(o for o in ties.get(name, ()) if o not in names) for name in names}
    return {name: others for name, others in rest.items() if others}


def equivalent_when_adopted(workspace: Folder) -> set[str]:
    """Return the adopted effects whose ties (`tied_when_adopted`) no trial can tell from them."""
    same, ties = _kept(workspace, "equivalent"), tied_when_adopted(workspace).items()
    return {name for name, others in ties if {*others} <= {*same.get(name, ())}}


# the model as it is now


def units_of(workspace: Folder, effect: str) -> dict[str, str]:
    """Return the units of an effect's quantities that are fitted."""
    try:
        known = installed_effects().effect(effect, workspace.base_model).free
    except GroundedError:  # beside another adopted effect, or of a package that is not installed
        return {}
    return {q.name: q.unit for q in known}


def known_values(workspace: Folder, diagnosis: Diagnosis | None = None) -> dict[str, Estimate]:
    """Return the values of parameters and adopted effects, by parameter name, with their +-.

    The +- is that of the diagnosis, of the adoption or of the last fit, the first that has this
    value; NaN if none has.
    """
    fitted = {} if diagnosis is None else dict(diagnosis.parameters)
    for row in () if diagnosis is None else diagnosis.ranking:
        fitted |= {param_name(row.effect, q): e for q, e in row.params.items()}
    own: Mapping[str, tuple[float, ...]] = {name: (e.value, e.std) for name, e in fitted.items()}
    sources = (own, _as_adopted(workspace), as_fitted(workspace))
    now = {name: (one.value, one.unit) for name, one in workspace.base_model.params.items()}
    for effect in workspace.config.model.effects:
        units = units_of(workspace, str(effect["name"]))
        for q, value in effect.items():
            if q != "name":
                name = param_name(str(effect["name"]), q)
                now[name] = float(value), units.get(q, "")
    found_values = dict[str, Estimate]()
    for name, (value, unit) in now.items():
        same = (std for at, std in (s[name] for s in sources if name in s) if _same(at, value))
        found_values[name] = Estimate(value, next(same, math.nan), unit=unit)
    return found_values


def _as_adopted(workspace: Folder) -> dict[str, tuple[float, ...]]:
    """Return the values that were adopted last with their std, by parameter of the model."""
    return {n: own for n, own in _kept(workspace, "known", float).items() if len(own) == 2}


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
        known = {n: e for n, e in told_parameters(diagnosis).items() if math.isfinite(e.value)}
        nominal = _nominal(diagnosis, workspace, names)
        params, both = joined(diagnosis, names, table.effects, nominal, known)
        own = {name: value for name, value in params.items() if name in task.model.params}
        if own or names:
            old = len(table.effects)
            estimated = task.with_model(task.model.with_values(own))
            effects = in_order(both[:old], both[old:])
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
    if left_behind(diagnosis):
        return False
    made, names = diagnosis.made or Made(), diagnosis.effects
    now = {str(effect["name"]): dict(effect) for effect in table.effects}
    both = [*names, *(name for name in diagnosis.late_sensors if name in now)]
    try:
        known = told_parameters(diagnosis)
        own, effects = joined(diagnosis, both, made.adopted, made.nominal, known)
    except (GroundedError, KeyError):  # a document of an older version
        return False
    wanted = {str(effect["name"]): effect for effect in effects}
    return bool(names) and now == wanted and dict(made.params or {}) | own == dict(table.params)


def _rows(workspace: Folder, diagnosis: Diagnosis | None) -> Iterator[tuple[str, str]]:
    """Yield the name and the values of each adopted effect, then of each adopted parameter."""
    table, model = workspace.config.model, workspace.origin.model
    known, adopted = known_values(workspace, diagnosis), _as_adopted(workspace)
    ties, rests = tied_when_adopted(workspace), _kept(workspace, "given")

    def given(name: str) -> str:
        text = "".join(f", or {other}" for other in ties.get(name, ()))
        value = table.params.get(name)
        fitted = value is not None and not _same(adopted.get(name, (math.inf,))[0], value)
        on = () if fitted else rests.get(name, ())
        return text + f", given {listed(on)}" * bool(on)

    for entry in table.effects:
        name = str(entry["name"])
        units = units_of(workspace, name) or {key: "" for key in entry if key != "name"}
        each = (f"{q} = {known[param_name(name, q)].text}" for q in units if q in entry)
        yield name, f"{', '.join(each)}{given(name)}"
    for name, param in model.params.items():
        if table.params.get(name, param.value) != param.value:
            yield name, f"{known[name].text}{given(name)}, was {number(param.value)}"
