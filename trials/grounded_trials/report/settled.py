"""Describes what was adopted: the model's changes from model.py, their gain, what is still open.

The gain is the one measured by the last diagnosis, if that was made with the current planning model
or claims what was adopted since. Otherwise no gain is reported.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from grounded.diagnosis.cause_words import GIVEN, ended, give_or_take, meaning
from grounded.diagnosis.parts import Estimate, Made
from grounded.diagnosis.report import Diagnosis
from grounded.errors import GroundedError
from grounded.model import Model, Param
from grounded.result import begun, listed, number
from grounded.task import Task
from grounded_trials.report.diagnosis_words import made_from
from grounded_trials.report.three_lines import gained, still_open, three_lines
from grounded_trials.wording import ALONE, changed
from grounded_trials.workspace.adoptable import joined
from grounded_trials.workspace.adopting import (
    as_adopted,
    conditions_when_adopted,
    equivalent_when_adopted,
    left_behind,
    tied_when_adopted,
)
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.last_diagnosis import (
    Since,
    read_diagnosis,
    since_diagnosis,
    usable_ids,
)
from grounded_trials.workspace.user_files.config import ModelTable

NOW = "the model now"
WRITTEN = 1e-6  # relative difference of a value and what `adopt` writes of it


@dataclass(frozen=True)
class Settled:
    """What was adopted; `closed`: everything that the last diagnosis claims has been adopted."""

    adopted: tuple[str, ...]  # one clause each: effects, then parameters
    gained: str = ""  # "" if no diagnosis measured the current planning model
    left: str = ""
    closed: bool = False
    rows: tuple[tuple[str, str], ...] = ()  # name and values of each, as short as can be
    briefly: str = ""  # `left` without what ties, and with names instead of clauses

    @property
    def lines(self) -> list[str]:
        """The sentences, one per line."""
        return self.told("; ".join(self.adopted))

    def told(self, adopted: str) -> list[str]:
        """Return the sentences, one per line, with these words on what was adopted."""
        found = [f"Found and adopted: {adopted}.", self.gained, self.left]
        return [line for line in found if line]


def settled_in(workspace: Folder, diagnosis: Diagnosis | None, since: Since) -> Settled | None:
    """Return how a workspace's model differs from model.py; None if it does not.

    Args:
        workspace: the workspace, whose grounded.toml lists what was adopted.
        diagnosis: the last diagnosis.
        since: changes since then.
    """
    table, task = workspace.config.model, workspace.origin
    known, ties = _Known(diagnosis, as_adopted(workspace)), tied_when_adopted(workspace)
    rests = {
        name: on
        for name, on in conditions_when_adopted(workspace).items()
        if name not in table.params or known.adopted(name, table.params[name])  # else fitted since
    }
    clauses = [_clause(effect, task.model, known, rests) for effect in table.effects]
    clauses += _moved(task.model, table.params, diagnosis.jointly if diagnosis else set(), rests)
    if not clauses:
        return None
    rows = tuple(_rows(task.model, table, known, ties, rests))
    found = Settled(tuple(clauses), rows=rows)
    names = [str(effect["name"]) for effect in table.effects]
    same = equivalent_when_adopted(workspace)
    unsure = [
        f"{c}{_or_else(ties.get(n, ()), n in same)}" for n, c in zip(names, clauses, strict=False)
    ]
    with_ties = replace(found, adopted=(*unsure, *clauses[len(names) :]))
    if diagnosis is None or diagnosis.no_cause:
        return with_ties
    if not since.changed:
        text = gained(diagnosis, task, now="crude", before="outset", who=NOW)
        causes = diagnosis.verdict.causes or diagnosis.effects
        left, briefly = (_still(diagnosis, some, since) for some in (causes, diagnosis.effects))
        return replace(with_ties, gained=text, left=left, briefly=briefly)
    if not _as_claimed(diagnosis, table):
        return with_ties
    before = "outset" if gained(diagnosis, task, before="outset") else "crude"
    text = gained(diagnosis, task, before=before, who=NOW)
    repeated = bool(since.repeats)
    left, briefly = (still_open(diagnosis, ties=ties, repeated=repeated) for ties in (True, False))
    told = found if set(ties) <= set(diagnosis.effects) else with_ties  # `left` has its ties
    return replace(told, gained=text, left=left, closed=True, briefly=briefly)


def measured_now(workspace: Folder) -> str:
    """Return the current planning model's prediction error by the last diagnosis, or "".

    If what that claims was adopted since, it is compared with the error just before.
    """
    found, since = _last(workspace)
    settled = settled_in(workspace, found, since)
    if found is not None and settled is not None and settled.closed:
        return gained(found, workspace.origin, before="crude", who=NOW)
    if settled is not None or found is None or since.changed:
        return settled.gained if settled is not None else ""
    return gained(found, workspace.origin, now="crude", before="crude", who=NOW)


def _last(workspace: Folder) -> tuple[Diagnosis | None, Since]:
    try:
        found = read_diagnosis(workspace.reports)
    except GroundedError:
        found = None
    return found, since_diagnosis(workspace, found, usable_ids(workspace)) if found else Since()


def told(
    diagnosis: Diagnosis,
    task: Task,
    since: Since,
    settled: Settled | None,
    *,
    causes_below: bool = False,
) -> list[str]:
    """Return a diagnosis as lines of text, after the lines on what has been adopted since.

    Args:
        diagnosis: the last diagnosis.
        task: the task, whose weighed states are reported.
        since: changes since the diagnosis.
        settled: what was adopted.
        causes_below: whether lists of what was adopted and of all causes follow.
    """
    lines = so_far(diagnosis, since, settled, causes_below=causes_below)
    if settled is not None and settled.closed:
        return lines[:-1]
    part = not since.newer and 0 < since.used < since.usable
    some = [f"Diagnosed with {since.used} of {since.usable} trials."] * part
    return [*lines, *three_lines(diagnosis, task, causes_below=causes_below), *some]


def so_far(
    diagnosis: Diagnosis, since: Since, settled: Settled | None, *, causes_below: bool = False
) -> list[str]:
    """Return the lines before a diagnosis: what was adopted, and why it may be outdated."""
    lines = [] if settled is None else settled.lines
    if settled is not None and causes_below and len(settled.adopted) > 1:
        lines = settled.told(f"{len(settled.adopted)} changes, listed below")
    if settled is not None and settled.left and not since.changed:
        lines = lines[:-1]  # the diagnosis itself follows
    if text := since.sentence:
        lines.append(f"{begun(text)}.")
    return [*lines, f"The diagnosis, {made_from(diagnosis)}, said:"] if lines else []


def _still(diagnosis: Diagnosis, causes: Sequence[str], since: Since) -> str:
    """Return the first sentence of a diagnosis of the current planning model; its `causes`.

    If a run was repeated since, which tells the noise that it asks for, that is told instead.
    """
    if diagnosis.effects:
        return f"Found, not adopted: {'; '.join(causes)}."
    return still_open(diagnosis, repeated=True) if since.repeats else diagnosis.verdict.lines[0]


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
        known = diagnosis.known_parameters
        own, effects = joined(diagnosis, both, made.adopted, made.nominal, known)
    except (GroundedError, KeyError):  # a document of an older version
        return False
    wanted = {str(effect["name"]): effect for effect in effects}
    return bool(names) and now == wanted and dict(made.params or {}) | own == dict(table.params)


class _Known:
    """How well adopted values are known: as well as the last diagnosis knows them.

    Otherwise as well as when they were adopted (`before`): a diagnosis that finds nothing new
    estimates nothing.
    """

    def __init__(self, diagnosis: Diagnosis | None, before: Mapping[str, Estimate]) -> None:
        from grounded.effects import param_name

        fitted = {} if diagnosis is None else dict(diagnosis.parameters)
        for ranked in () if diagnosis is None else diagnosis.ranking:
            fitted |= {param_name(ranked.effect, q): e for q, e in ranked.params.items()}
        self.both = fitted, before

    def adopted(self, name: str, value: float) -> bool:
        """Return whether a value is still the one that was adopted last."""
        own = self.both[1].get(name)
        return own is not None and math.isclose(own.value, value, rel_tol=WRITTEN)

    def estimate(self, name: str, value: float, unit: str) -> Estimate:
        """Return an adopted value with its standard deviation, NaN if that is unknown."""
        for own in (one[name] for one in self.both if name in one):
            if math.isclose(own.value, value, rel_tol=WRITTEN):
                return replace(own, unit=unit)
        return Estimate(value, unit=unit)


def _given(name: str, rests: Mapping[str, Sequence[str]]) -> str:
    """Return a clause on the parameters that a value rests on; "" for none."""
    return GIVEN.format(listed(rests[name])) if rests.get(name) else ""


def _clause(
    entry: Mapping[str, Any], model: Model, known: _Known, rests: Mapping[str, Sequence[str]]
) -> str:
    """Return an adopted effect in words, with its values; those that may be zero are left out."""
    from grounded.effects import param_name
    from grounded_trials.workspace.adopted import installed_effects

    name, given = str(entry["name"]), {k: v for k, v in entry.items() if k != "name"}
    try:
        effect = installed_effects().effect(name, model)
        units = {q.name: q.unit for q in effect.quantities}
        values = {
            q: known.estimate(param_name(name, q), float(v), units[q])
            for q, v in given.items()
            if q in units
        }
        return f"{meaning(effect, values)}{_given(name, rests)}"
    except (GroundedError, TypeError, ValueError):
        return f"{name} ({', '.join(f'{k} = {v}' for k, v in given.items())})"


def _or_else(others: Sequence[str], same: bool) -> str:
    """Return a clause on the effects that an adopted one may stand for; "" for none.

    `same`: whether they are equivalent in the model.
    """
    if not others:
        return ""
    why = "the trials could not tell them apart"
    if same:
        why = "no trial can tell them apart in this model"
    return f" or, as {why}, {' or '.join(others)} instead"


def _rows(
    model: Model,
    table: ModelTable,
    known: _Known,
    ties: Mapping[str, Sequence[str]],
    rests: Mapping[str, Sequence[str]],
) -> Iterator[tuple[str, str]]:
    """Yield the name and the values of each adopted effect, then of each adopted parameter."""
    from grounded.effects import param_name
    from grounded_trials.workspace.adopted import installed_effects

    library = installed_effects()

    def told(name: str, value: float, unit: str) -> str:
        return give_or_take(known.estimate(name, value, unit))

    for entry in table.effects:
        name = str(entry["name"])
        try:
            quantities = library.effect(name, model).free
        except GroundedError:
            quantities = ()
        units = {q.name: q.unit for q in quantities if q.name in entry}
        units = units or {key: "" for key in entry if key != "name"}
        each = (f"{q} = {told(param_name(name, q), entry[q], unit)}" for q, unit in units.items())
        alike = "".join(f", or {one}" for one in ties.get(name, ()))
        yield name, f"{', '.join(each)}{_given(name, rests)}{alike}"
    for name, param in model.params.items():  # in the order of `_moved`
        if (value := table.params.get(name, param.value)) != param.value:
            text = f"{told(name, value, param.unit)}{_at_end(param, value)}{_given(name, rests)}"
            yield name, f"{text}, was {number(param.value)}"


def _at_end(param: Param, value: float) -> str:
    """Return `, at its bound, the data ask for less` of such a value; "" for another."""
    at = Estimate(value, stopped=param.stopped(value))
    return "".join(f", {clause}" for clause in ended(at, param.value))


def _moved(
    model: Model,
    params: Mapping[str, float],
    jointly: set[str],
    rests: Mapping[str, Sequence[str]],
) -> list[str]:
    """Return `m 1.00 -> 1.30 kg` for every parameter that grounded.toml changes.

    Those that the trials identify only `jointly` are marked.
    """
    known = {n: p for n, p in model.params.items() if n in params and params[n] != p.value}
    return [
        changed(name, p.value, params[name], p.unit)
        + _at_end(p, params[name])
        + ALONE * (name in jointly)
        + _given(name, rests)
        for name, p in known.items()
    ]
