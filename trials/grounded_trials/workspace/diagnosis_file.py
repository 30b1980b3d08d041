"""reports/diagnosis.json read back: what `grounded diagnose` found, for people to look at.

The file may come from another version, or from a stranger: what is missing is left empty, what has
the wrong shape is refused with a sentence, and no text in it is trusted.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from grounded.errors import GroundedError
from grounded_trials.wording import with_unit
from grounded_trials.workspace.diagnosis_error import (
    Likeness,
    Split,
    UtilityPrediction,
    likenesses,
    number,
    splits,
    utility,
    white,
)

FILE = "diagnosis.json"
# what reading a document of another shape may raise
MALFORMED = (ValueError, TypeError, AttributeError, KeyError, OverflowError, RecursionError)


@dataclass(frozen=True)
class Share:
    """One channel, time span or region, and its share of the gap."""

    label: str
    share: float  # 0 to 1
    note: str = ""  # rms with its unit, or how much of the time was spent there
    start: float = math.nan  # [s] of a time span
    end: float = math.nan


@dataclass(frozen=True)
class Value:
    """A parameter of an effect with its standard deviation and 95 % interval."""

    name: str
    value: float
    std: float
    unit: str
    interval: tuple[float, float] | None = None  # None in older files; NaN where there is none


@dataclass(frozen=True)
class Ranked:
    """One effect that was weighed: the gain in evidence [nats] and the gap that it leaves."""

    effect: str
    params: tuple[Value, ...]
    evidence: float
    gap_after: float
    shrinkage: float
    fixed: tuple[tuple[str, float], ...] = ()  # quantities that are no parameters


@dataclass(frozen=True)
class Left:
    """What no known effect explains: a channel's missing rate, and where most of it is."""

    channel: str
    size: float
    unit: str
    when: str
    share: float
    evidence: float


@dataclass(frozen=True)
class Gap:
    """The prediction error over a horizon, before and after the effects, and the noise floor."""

    horizon_s: float
    unit: str
    before: float
    after: float
    floor: float
    held_out: bool


@dataclass(frozen=True)
class Diagnosis:
    """The whole document, see CONTRACT.md."""

    kind: str  # effect, several, none, unknown
    effects: tuple[str, ...]
    sentence: str
    channels: tuple[Share, ...]
    times: tuple[Share, ...]
    regions: tuple[Share, ...]
    ranking: tuple[Ranked, ...]
    indistinguishable: tuple[tuple[str, ...], ...]
    gap: Gap | None
    next_trial: str
    parameters: tuple[Value, ...] = ()  # of the model, estimated beside the effects
    leftover: tuple[Left, ...] = ()
    trials: tuple[str, ...] = ()  # that it was made from
    adopted: tuple[Mapping[str, Any], ...] = ()  # effects that were in the model then
    nominal: tuple[tuple[str, float], ...] = ()  # the values of its parameters then
    model_params: tuple[tuple[str, float], ...] | None = None  # and its [model] params
    split: tuple[Split, ...] = ()  # what the error is made of, by horizon
    whiteness: tuple[tuple[str, float], ...] = ()  # p-value of what is left, by channel
    utility_prediction: UtilityPrediction | None = None
    lookalikes: tuple[Likeness, ...] = ()
    unknowable: tuple[str, ...] = ()  # what the trials are too few or too quiet for

    def open(self, adopted: Iterable[Mapping[str, Any]]) -> tuple[str, ...]:
        """The claimed effects that the model with these adopted ones lacks as it did then."""
        now = {str(e["name"]): dict(e) for e in adopted}
        then = {str(e["name"]): dict(e) for e in self.adopted}
        return tuple(name for name in self.effects if now.get(name) == then.get(name))

    @property
    def no_cause(self) -> bool:
        """Whether too little is known to name any cause: its figures mean nothing then."""
        return self.kind == "unknown" and any(text in self.sentence for text in self.unknowable)


def read_diagnosis(folder: Path) -> Diagnosis | None:
    """The diagnosis in a reports folder; None when there is none.

    Raises:
        GroundedError: if the file is not what `grounded diagnose` writes.
    """
    path = folder / FILE
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise GroundedError(f"{path} can't be read: {error}") from None
    try:
        return diagnosis_of(json.loads(text))
    except MALFORMED as error:
        raise GroundedError(
            f"{path} is not what `grounded diagnose` writes ({error}); call it again"
        ) from None


def diagnosis_of(document: dict[str, Any]) -> Diagnosis:
    """The document of `grounded diagnose --json`, read."""
    verdict, where = document["verdict"], document.get("where") or {}
    gap, made = document.get("gap"), document.get("diagnosed") or {}
    return Diagnosis(
        kind=str(verdict["kind"]),
        effects=tuple(map(str, verdict.get("effects") or ())),
        sentence=str(verdict.get("sentence") or ""),
        channels=tuple(_channel(c) for c in where.get("channels") or ()),
        times=tuple(_time(t) for t in where.get("times") or ()),
        regions=tuple(_region(r) for r in where.get("regions") or ()),
        ranking=tuple(_ranked(r) for r in document.get("ranking") or ()),
        indistinguishable=tuple(
            tuple(map(str, group)) for group in document.get("indistinguishable") or ()
        ),
        gap=_gap(gap) if gap else None,
        next_trial=str(document.get("next_trial") or ""),
        parameters=_values(document.get("parameters")),
        leftover=tuple(_left(one) for one in document.get("leftover") or ()),
        trials=tuple(map(str, made.get("trials") or ())),
        adopted=tuple({"name": str(e["name"])} | e for e in made.get("adopted") or ()),
        nominal=_params(made.get("nominal")) or (),
        model_params=_params(made.get("params")),
        split=splits(where.get("split")),
        whiteness=white(where.get("whiteness")),
        utility_prediction=utility(document.get("utility_prediction")),
        lookalikes=likenesses(document.get("lookalikes")),
        unknowable=tuple(map(str, document.get("unknowable") or ())),
    )


def _channel(entry: dict[str, Any]) -> Share:
    rms = with_unit(f"{number(entry['rms']):.3g}", str(entry.get("unit", "")))
    return Share(str(entry["name"]), number(entry["share"]), rms)


def _region(entry: dict[str, Any]) -> Share:
    note = f"{100 * number(entry.get('occupancy')):.0f} % of the time"
    return Share(str(entry["when"]), number(entry["share"]), note)


def _params(table: dict[str, Any] | None) -> tuple[tuple[str, float], ...] | None:
    if table is None:
        return None
    return tuple((str(name), number(value)) for name, value in table.items())


def _time(span: dict[str, Any]) -> Share:
    start, end = number(span["from"]), number(span["to"])
    return Share(f"{start:g} to {end:g} s", number(span["share"]), "", start, end)


def _ranked(row: dict[str, Any]) -> Ranked:
    return Ranked(
        effect=str(row["effect"]),
        params=_values(row.get("params")),
        evidence=number(row.get("evidence")),
        gap_after=number(row.get("gap_after")),
        shrinkage=number(row.get("shrinkage")),
        fixed=tuple((str(k), number(v)) for k, v in (row.get("fixed") or {}).items()),
    )


def _values(table: dict[str, Any] | None) -> tuple[Value, ...]:
    return tuple(
        Value(
            str(name),
            number(p["value"]),
            number(p.get("std")),
            str(p.get("unit") or ""),
            _interval(p["interval"]) if "interval" in p else None,
        )
        for name, p in (table or {}).items()
    )


def _interval(ends: Any) -> tuple[float, float]:
    low, high = ends or (None, None)
    return number(low), number(high)


def _left(one: dict[str, Any]) -> Left:
    region = one.get("region") or {}
    return Left(
        channel=str(one["channel"]),
        size=number(one.get("size")),
        unit=str(one.get("unit") or ""),
        when=str(region.get("when") or ""),
        share=number(region.get("share")),
        evidence=number(one.get("evidence")),
    )


def _gap(gap: dict[str, Any]) -> Gap:
    return Gap(
        horizon_s=number(gap.get("horizon_s")),
        unit=str(gap.get("unit") or ""),
        before=number(gap.get("before")),
        after=number(gap.get("after")),
        floor=number(gap.get("floor")),
        held_out=bool(gap.get("held_out")),
    )
