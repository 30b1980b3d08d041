"""Describes what was adopted: the model's changes from model.py, their gain, what is still open.

The gain is the one measured by the last diagnosis, if that was made with the current planning model
or claims what was adopted since. Otherwise no gain is reported.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from grounded.diagnosis.report import Diagnosis, Estimate, Made
from grounded.errors import GroundedError
from grounded.model import Model
from grounded.task import Task
from grounded_trials.report.diagnosis_words import made_from
from grounded_trials.report.three_lines import gained, still_open, three_lines
from grounded_trials.wording import ALONE, changed
from grounded_trials.workspace.adopting import joined, left_behind
from grounded_trials.workspace.config import ModelTable
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.last_diagnosis import read_diagnosis
from grounded_trials.workspace.next_step import Since, since_diagnosis, usable_ids

NOW = "the model now"


@dataclass(frozen=True)
class Settled:
    """What was adopted; `closed`: everything that the last diagnosis claims has been adopted."""

    adopted: tuple[str, ...]  # one clause each: effects, then parameters
    gained: str = ""  # "" if no diagnosis measured the current planning model
    left: str = ""
    closed: bool = False

    @property
    def lines(self) -> list[str]:
        """The sentences, one per line."""
        found = [f"Found and adopted: {'; '.join(self.adopted)}.", self.gained, self.left]
        return [line for line in found if line]


def settled_in(workspace: Folder, diagnosis: Diagnosis | None, since: Since) -> Settled | None:
    """Return how a workspace's model differs from model.py; None if it does not.

    Args:
        workspace: the workspace, whose grounded.toml lists what was adopted.
        diagnosis: the last diagnosis.
        since: changes since then.
    """
    table, task = workspace.config.model, workspace.origin
    clauses = [_clause(effect, task.model) for effect in table.effects]
    clauses += _moved(task.model, table.params, diagnosis.jointly if diagnosis else set())
    if not clauses:
        return None
    if diagnosis is None or diagnosis.no_cause:
        return Settled(tuple(clauses))
    if not since.changed:
        text = gained(diagnosis, task, now="crude", before="outset", who=NOW)
        return Settled(tuple(clauses), text, _still(diagnosis))
    if not _as_claimed(diagnosis, table):
        return Settled(tuple(clauses))
    before = "outset" if gained(diagnosis, task, before="outset") else "crude"
    text = gained(diagnosis, task, before=before, who=NOW)
    return Settled(tuple(clauses), text, still_open(diagnosis), closed=True)


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


def told(diagnosis: Diagnosis, task: Task, since: Since, settled: Settled | None) -> list[str]:
    """Return a diagnosis as lines of text, after the lines on what has been adopted since.

    Args:
        diagnosis: the last diagnosis.
        task: the task, whose weighed states are reported.
        since: changes since the diagnosis.
        settled: what was adopted.
    """
    lines = so_far(diagnosis, since, settled)
    if settled is not None and settled.closed:
        return lines[:-1]
    part = not since.newer and 0 < since.used < since.usable
    some = [f"Diagnosed with {since.used} of {since.usable} trials."] * part
    return [*lines, *three_lines(diagnosis, task), *some]


def so_far(diagnosis: Diagnosis, since: Since, settled: Settled | None) -> list[str]:
    """Return the lines before a diagnosis: what was adopted, and why it may be outdated."""
    lines = [] if settled is None else settled.lines
    if settled is not None and settled.left and not since.changed:
        lines = lines[:-1]  # the diagnosis itself follows
    if text := since.sentence:
        lines.append(f"{text[:1].upper()}{text[1:]}.")
    return [*lines, f"The diagnosis, {made_from(diagnosis)}, said:"] if lines else []


def _still(diagnosis: Diagnosis) -> str:
    """Return the first sentence of a diagnosis of the current planning model."""
    if diagnosis.effects:
        return f"Found, not adopted: {'; '.join(diagnosis.verdict.causes or diagnosis.effects)}."
    return diagnosis.verdict.lines[0]


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


def _clause(entry: Mapping[str, Any], model: Model) -> str:
    """Return an adopted effect in words, with its values."""
    from grounded.diagnosis.cause_words import meaning
    from grounded_trials.workspace.adopted import installed_effects

    name, given = str(entry["name"]), {k: v for k, v in entry.items() if k != "name"}
    try:
        effect = installed_effects().effect(name, model)
        units = {q.name: q.unit for q in effect.quantities}
        values = {q: Estimate(float(v), unit=units[q]) for q, v in given.items() if q in units}
        return meaning(effect, values)
    except (GroundedError, TypeError, ValueError):
        return f"{name} ({', '.join(f'{k} = {v}' for k, v in given.items())})"


def _moved(model: Model, params: Mapping[str, float], jointly: set[str]) -> list[str]:
    """Return `m 1.00 -> 1.30 kg` for every parameter that grounded.toml changes.

    Those that the trials identify only `jointly` are marked.
    """
    known = {n: p for n, p in model.params.items() if n in params and params[n] != p.value}
    return [
        changed(name, p.value, params[name], p.unit) + ALONE * (name in jointly)
        for name, p in known.items()
    ]
