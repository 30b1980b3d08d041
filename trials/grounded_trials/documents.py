"""The JSON documents of all commands as types, and the schema that is generated from them.

A result whose document is its fields (`grounded.result.Document`) is its own type; those that are
put together have a TypedDict here. `python -m grounded_trials.documents` prints the schema, kept as
docs/schema.json; a test compares the two, and holds the document of every command to it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    Any,
    NotRequired,
    TypedDict,
    Union,
    get_args,
    get_origin,
    get_type_hints,
    is_typeddict,
)

from grounded.accounts.finding import Finding as Fault
from grounded.diagnosis.error_report import RulerRow
from grounded.diagnosis.parts import Diagnosis, Verdict
from grounded.errors import NextCommand
from grounded.findings import Finding
from grounded.findings.catalogue import Entry
from grounded_trials.logs.recover import Recovery
from grounded_trials.logs.signal_report import SignalReport
from grounded_trials.starting.begin import Begun
from grounded_trials.starting.drawing import Drawn
from grounded_trials.store.store import Lost
from grounded_trials.workspace.adoption import Adopted, Undone
from grounded_trials.workspace.candidates.exporting import Exported
from grounded_trials.workspace.candidates.proposing import Proposed
from grounded_trials.workspace.candidates.running import Ran
from grounded_trials.workspace.discarding import SetAside
from grounded_trials.workspace.exciting import Excited
from grounded_trials.workspace.home.library import Shelved
from grounded_trials.workspace.home.taking_home import TakenHome
from grounded_trials.workspace.intake.ingest import Ingested
from grounded_trials.workspace.looping import NextRun
from grounded_trials.workspace.off_target import OffTarget
from grounded_trials.workspace.verifying import Verified

By = Mapping[str, float]


class Command(TypedDict):
    """The command to run next."""

    command: str
    arguments: list[str]


class TriedJson(TypedDict):
    """A candidate in the history of a search."""

    candidate: str
    iteration: int
    alpha: float
    damping: float | None
    base: str | None
    predicted_utility: float
    utility: float
    standard_error: float
    probability: float
    noise_cost: float
    trials: list[str]
    accepted: bool
    verdict: str


class BestJson(TypedDict):
    """The best candidate so far."""

    candidate: str
    utility: float
    lead_doubt: str | None
    off_target: list[OffTarget]


class StatusJson(TypedDict):
    """`status`, `learn`."""

    phase: str
    iteration: int
    best: BestJson | None
    utilities: list[float]
    trials: int
    outstanding: str | None
    missing: int
    sentence: str
    ending: str | None
    certainty: str
    findings: list[Finding]
    history: list[TriedJson]
    discarded: dict[str, str]


class ProposeJson(TypedDict):
    """`propose`."""

    candidate: str | None
    file: str | None
    iteration: int
    alpha: float | None
    damping: float | None
    predicted_utility: float | None
    phase: str
    sentence: str
    ending: str | None
    notes: list[str]
    findings: list[Finding]
    best_utility: NotRequired[float | None]
    new: NotRequired[bool]
    noise_cost: float | None
    off_target: list[OffTarget]
    sample_age_s: float | None


class IngestJson(TypedDict):
    """`ingest`."""

    trials: list[Ingested]


class FitJson(TypedDict):
    """`fit`."""

    params: dict[str, Any]
    status: str
    sentence: str
    findings: list[Finding]
    samples: int
    at_bounds: list[str]
    applied: bool
    prediction_error: list[RulerRow]
    trials: list[str]
    not_fitted: list[str]
    rows_s: float
    interpolated_s: float
    preflight: list[Fault]


class MeasuresJson(TypedDict):
    """Errors of a run, by state."""

    candidate: str
    utility: float
    tracking_error: By
    prediction_error: By
    bias_rate: By


class VerdictJson(TypedDict):
    """The verdict of the last diagnosis."""

    kind: str
    effects: list[str]
    sentence: str


class AdoptedJson(TypedDict):
    """What was adopted."""

    clauses: list[str]


class ReportJson(TypedDict):
    """`report`."""

    paths: dict[str, str | list[str]]
    utilities: list[float]
    phase: str
    sentence: str
    ending: str | None
    optimum: float | None
    lost: list[Lost]
    next: str
    model_policy: MeasuresJson | None
    best: MeasuresJson | None
    verdict: NotRequired[VerdictJson]
    outdated: NotRequired[str | None]
    findings: NotRequired[list[Finding]]
    adopted: AdoptedJson | None


class InspectJson(TypedDict):
    """`inspect`."""

    files: list[str]
    format: str | None
    library: str
    duration_s: float
    messages: int
    topics: list[dict[str, Any]]
    remarks: list[str]
    findings: list[Finding]
    damage: str
    log_table: str


class CreatedJson(TypedDict):
    """`init --example`, `init --blank`."""

    workspace: str
    example: NotRequired[str]
    model: NotRequired[str]
    findings: list[Finding]


class ExamplesJson(TypedDict):
    """`init --list`."""

    examples: dict[str, str]


class FamilyJson(TypedDict):
    """A family of effects, with the units of its quantities at an example."""

    equation: str
    sentence: str
    example: str
    quantities: dict[str, str]
    lookalikes: list[str]


class ExplainJson(TypedDict):
    """`explain`."""

    findings: dict[str, Entry]
    effects: dict[str, FamilyJson]


DOCUMENTS: dict[str, Any] = {
    "adopt": Adopted | Undone,
    "diagnose": Diagnosis,
    "discard": SetAside,
    "excite": Excited,
    "explain": ExplainJson,
    "export": Exported | TakenHome | Shelved,
    "fit": FitJson,
    "ingest": IngestJson,
    "init": Begun | CreatedJson | ExamplesJson,
    "inspect": InspectJson,
    "learn": StatusJson,
    "next": NextRun,
    "propose": ProposeJson,
    "recover": Recovery,
    "report": ReportJson,
    "restore": SetAside,
    "run": Ran,
    "status": StatusJson,
    "target": Drawn,
    "verify": Verified,
}
_AS = {NextCommand: Command, Proposed: ProposeJson}  # types that are written in another form
_MORE: dict[type, dict[str, Any]] = {  # what a document has beside its fields
    Diagnosis: {"next_trial": str, "unknowable": list[str]},
    Verdict: {"sentence": str},
    Fault: {"finding": str},
    Finding: {"sentence": str},
}
_LATE = {"SignalReport": SignalReport}  # what a module imports for its types alone
_PLAIN = {str: "string", Path: "string", bool: "boolean", int: "integer", NoneType: "null"}


def schema() -> dict[str, Any]:
    """Return the JSON schema (draft 2020-12) of all documents, each under its command."""
    known: dict[str, Any] = {}
    commands = {name: _of(kind, known) for name, kind in DOCUMENTS.items()}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "What grounded COMMAND --json prints, by command",
        "properties": commands,
        "$defs": dict(sorted(known.items())),
    }


def _of(kind: Any, known: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of a type; those of objects are added to `known` and referred to."""
    origin, args = get_origin(kind), get_args(kind)
    if kind is Any:
        return {}
    if origin in (Union, UnionType):
        return {"anyOf": [_of(one, known) for one in args]}
    if origin in (list, tuple):
        return {"type": "array", "items": _of(args[0], known)}
    if origin in (dict, Mapping):
        return {"type": "object", "additionalProperties": _of(args[1], known)}
    if kind is float:  # null where it is not known or not finite
        return {"type": ["number", "null"]}
    if kind in _PLAIN:
        return {"type": _PLAIN[kind]}
    if isinstance(kind, type) and issubclass(kind, Enum):
        return {"type": "string"}
    kind = _AS.get(kind, kind)
    name = "Fault" if kind is Fault else kind.__name__
    if name not in known:
        known[name] = {}
        known[name] |= _object(kind, known)
    return {"$ref": f"#/$defs/{name}"}


def _object(kind: Any, known: dict[str, Any]) -> dict[str, Any]:
    hints, needed = get_type_hints(kind, localns=_LATE, include_extras=True), list[str]()
    if is_typeddict(kind):
        needed = [name for name, hint in hints.items() if get_origin(hint) is not NotRequired]
        found = {name: _of(_bare(hint), known) for name, hint in hints.items()}
    else:
        assert isinstance(kind, type) and is_dataclass(kind)
        found = {}
        for one in fields(kind):
            if key := one.metadata.get("key", one.name):
                found[key] = _of(hints[one.name], known)
                needed += [] if one.metadata.get("brief") else [key]
                if one.metadata.get("null"):
                    found[key] = {"anyOf": [found[key], {"type": "null"}]}
        for key in getattr(kind, "ALSO", ()):
            found[key] = _of(get_type_hints(getattr(kind, key).fget)["return"], known)
            needed.append(key)
        for key, more in _MORE.get(kind, {}).items():
            found[key] = _of(more, known)
            needed.append(key)
    return {"type": "object", "properties": found, "required": needed}


def _bare(hint: Any) -> Any:
    return get_args(hint)[0] if get_origin(hint) is NotRequired else hint


if __name__ == "__main__":
    print(json.dumps(schema(), indent=1))
