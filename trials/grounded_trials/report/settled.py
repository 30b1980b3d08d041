"""What was found and adopted: what the model has beyond model.py, what it gained, what is left.

One ruler measured it, that of the last diagnosis: it was made with the model that plans now, or it
claims what was adopted since. Where it did neither, nothing is said of a gain.
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
from grounded_trials.wording import changed
from grounded_trials.workspace.adopting import joined, left_behind
from grounded_trials.workspace.config import ModelTable
from grounded_trials.workspace.diagnosing import read_diagnosis
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.next_step import Since, since_diagnosis, usable_ids

NOW = "the model now"


@dataclass(frozen=True)
class Settled:
    """What is part of the model now; `closed`: all that the last diagnosis claims is."""

    adopted: tuple[str, ...]  # a clause each: effects, then parameters
    gained: str = ""  # "" where no diagnosis measured the model that plans now
    left: str = ""
    closed: bool = False

    @property
    def lines(self) -> list[str]:
        """Sentences, a line each."""
        found = [f"Found and adopted: {'; '.join(self.adopted)}.", self.gained, self.left]
        return [line for line in found if line]


def settled_in(workspace: Folder, diagnosis: Diagnosis | None, since: Since) -> Settled | None:
    """What a workspace's model has beyond model.py; None where that is nothing.

    Args:
        workspace: whose grounded.toml says it.
        diagnosis: the last one.
        since: what happened after it.
    """
    table, task = workspace.config.model, workspace.origin
    clauses = [_clause(effect, task.model) for effect in table.effects]
    clauses += _moved(task.model, table.params)
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
    """How far the model that plans now predicts, as the last diagnosis measured it, or ""."""
    found, since = _last(workspace)
    settled = settled_in(workspace, found, since)
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
    """What a diagnosis says today: what was adopted first, then what is open.

    Args:
        diagnosis: the last one.
        task: whose weighed states it speaks of.
        since: what happened after it.
        settled: what the model has.
    """
    lines = so_far(diagnosis, since, settled)
    if settled is not None and settled.closed:
        return lines[:-1]
    return [*lines, *three_lines(diagnosis, task)]


def so_far(diagnosis: Diagnosis, since: Since, settled: Settled | None) -> list[str]:
    """What was adopted and why the diagnosis is not the last word, before its own sentences."""
    lines = [] if settled is None else settled.lines
    if settled is not None and settled.left and not since.changed:
        lines = lines[:-1]  # the diagnosis is about to say it
    if text := since.sentence:
        lines.append(f"{text[:1].upper()}{text[1:]}.")
    return [*lines, f"The diagnosis, {made_from(diagnosis)}, said:"] if lines else []


def _still(diagnosis: Diagnosis) -> str:
    """What a diagnosis of the model that plans now says first."""
    if diagnosis.effects:
        return f"Found, not adopted: {'; '.join(diagnosis.verdict.causes or diagnosis.effects)}."
    return diagnosis.verdict.lines[0]


def _as_claimed(diagnosis: Diagnosis, table: ModelTable) -> bool:
    """Whether the model is what the diagnosis measured: `adopt` of all that it claims made it.

    It was measured with the filters of sensors that were found, adopted or not.
    """
    if left_behind(diagnosis):
        return False
    made, names = diagnosis.made or Made(), diagnosis.effects
    now = {str(effect["name"]): dict(effect) for effect in table.effects}
    both = [*names, *(name for name in diagnosis.late_sensors if name in now)]
    try:
        known = diagnosis.known_parameters
        own, effects = joined(diagnosis, both, made.adopted, made.nominal, known)
    except (GroundedError, KeyError):  # of an older document
        return False
    wanted = {str(effect["name"]): effect for effect in effects}
    return bool(names) and now == wanted and dict(made.params or {}) | own == dict(table.params)


def _clause(entry: Mapping[str, Any], model: Model) -> str:
    """An adopted effect in words, with its values."""
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


def _moved(model: Model, params: Mapping[str, float]) -> list[str]:
    """`m 1.00 -> 1.30 kg` of every parameter that grounded.toml sets anew."""
    known = {n: p for n, p in model.params.items() if n in params and params[n] != p.value}
    return [changed(name, p.value, params[name], p.unit) for name, p in known.items()]
