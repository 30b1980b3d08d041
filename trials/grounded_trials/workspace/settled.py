"""What was adopted: the model's changes from model.py, what they gained, what is still open.

The gain is the one measured by the last diagnosis, if that was made with the current planning model
or claims what was adopted since. Otherwise no gain is reported.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from grounded.diagnosis.error_report import telling
from grounded.diagnosis.parts import Diagnosis, Estimate, Made
from grounded.diagnosis.telling import Told, errors_line, open_line, sentence, told
from grounded.errors import GroundedError
from grounded.findings import Finding, found
from grounded.result import begun, listed, number
from grounded_trials.workspace.adoptable import joined
from grounded_trials.workspace.adopting import (
    as_adopted,
    conditions_when_adopted,
    left_behind,
    tied_when_adopted,
)
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.last_diagnosis import (
    Since,
)
from grounded_trials.workspace.user_files.config import ModelTable

WRITTEN = 1e-6  # relative difference of a value and what `adopt` writes of it


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

    @property
    def lines(self) -> list[str]:
        """What was adopted, what it gained and what is open, as sentences."""
        first = found("model.adopted", *(name for name, _ in self.rows))
        return [sentence(one) for one in (first, self.gained, self.open) if one]


def settled_in(workspace: Folder, diagnosis: Diagnosis | None, since: Since) -> Settled | None:
    """Return how a workspace's model differs from model.py; None if it does not.

    Args:
        workspace: the workspace, whose grounded.toml lists what was adopted.
        diagnosis: the last diagnosis.
        since: changes since then.
    """
    rows = tuple(_rows(workspace, _Known(diagnosis, as_adopted(workspace))))
    if not rows or diagnosis is None or diagnosis.no_cause:
        return Settled(rows) if rows else None
    if not since.changed:
        return Settled(rows, gained=_error(diagnosis, "crude", "outset"), open=_open(diagnosis))
    if not _as_claimed(diagnosis, workspace.config.model):
        return Settled(rows)
    gained = _error(diagnosis, "with_effects", "outset") or _error(diagnosis)
    return Settled(rows, closed=True, gained=gained, open=_open(diagnosis))


def _error(d: Diagnosis, now: str = "with_effects", before: str = "crude") -> Finding | None:
    """Return how far predictions are off, and were; None if one of them is not known."""
    row = telling(d.prediction_error)
    if row is None or not (getattr(row, now) and getattr(row, before)):
        return None
    return next(errors_line(d, now, before), None)


def _open(d: Diagnosis) -> Finding | None:
    return next(open_line(d), None) if d.leftover else None


def told_since(diagnosis: Diagnosis, since: Since, settled: Settled | None) -> Told:
    """Return what is told of a diagnosis now: what was adopted since is not missing any more."""
    said = told(diagnosis)
    if settled is not None and settled.closed:
        return replace(said, lines=(), rows=(), findings=(), next="")
    return replace(said, next="") if since.sentence else said


def lines_since(diagnosis: Diagnosis, since: Since, settled: Settled | None) -> list[str]:
    """Return the same as sentences: what was adopted, why the rest is outdated, and the rest."""
    first = [] if settled is None else settled.lines
    if settled is not None and not settled.closed:
        first = first[:1]  # the diagnosis itself says what is open
    if text := since.sentence:
        first.append(f"{begun(text)}.")
    return [*first, *told_since(diagnosis, since, settled).texts()]


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


def _rows(workspace: Folder, known: _Known) -> Iterator[tuple[str, str]]:
    """Yield the name and the values of each adopted effect, then of each adopted parameter."""
    from grounded.effects import param_name
    from grounded_trials.workspace.adopted import installed_effects

    table, model, library = workspace.config.model, workspace.origin.model, installed_effects()
    ties, rests = tied_when_adopted(workspace), conditions_when_adopted(workspace)

    def given(name: str) -> str:
        text = "".join(f", or {other}" for other in ties.get(name, ()))
        fitted = name in table.params and not known.adopted(name, table.params[name])
        on = () if fitted else rests.get(name, ())
        return text + f", given {listed(on)}" * bool(on)

    for entry in table.effects:
        name = str(entry["name"])
        try:
            units = {q.name: q.unit for q in library.effect(name, model).free if q.name in entry}
        except GroundedError:  # it is of another package
            units = {key: "" for key in entry if key != "name"}
        each = (
            f"{q} = {known.estimate(param_name(name, q), entry[q], unit).text}"
            for q, unit in units.items()
        )
        yield name, f"{', '.join(each)}{given(name)}"
    for name, param in model.params.items():
        if (value := table.params.get(name, param.value)) != param.value:
            text = known.estimate(name, value, param.unit).text
            yield name, f"{text}{given(name)}, was {number(param.value)}"
