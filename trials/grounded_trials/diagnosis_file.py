"""reports/diagnosis.json read back: what `grounded diagnose` found, for people to look at.

The file may come from another version, or from a stranger: what is missing is left empty, what has
the wrong shape is refused with a sentence, and no text in it is trusted.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from grounded.errors import GroundedError

FILE = "diagnosis.json"


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
    """A parameter of an effect with its standard deviation."""

    name: str
    value: float
    std: float
    unit: str


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
    adopted: tuple[str, ...] = ()  # effects that were in the model then


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
        return _diagnosis(json.loads(text))
    except (ValueError, TypeError, AttributeError, KeyError, RecursionError) as error:
        raise GroundedError(
            f"{path} is not what `grounded diagnose` writes ({error}); call it again"
        ) from None


def _diagnosis(document: dict[str, Any]) -> Diagnosis:
    verdict, where = document["verdict"], document.get("where") or {}
    gap, made = document.get("gap"), document.get("diagnosed") or {}
    return Diagnosis(
        kind=str(verdict["kind"]),
        effects=tuple(map(str, verdict.get("effects") or ())),
        sentence=str(verdict.get("sentence") or ""),
        channels=tuple(
            Share(
                str(c["name"]), _number(c["share"]), f"{_number(c['rms']):.3g} {c.get('unit', '')}"
            )
            for c in where.get("channels") or ()
        ),
        times=tuple(_time(t) for t in where.get("times") or ()),
        regions=tuple(
            Share(
                str(r["when"]),
                _number(r["share"]),
                f"{100 * _number(r.get('occupancy')):.0f} % of the time",
            )
            for r in where.get("regions") or ()
        ),
        ranking=tuple(_ranked(r) for r in document.get("ranking") or ()),
        indistinguishable=tuple(
            tuple(map(str, group)) for group in document.get("indistinguishable") or ()
        ),
        gap=_gap(gap) if gap else None,
        next_trial=str(document.get("next_trial") or ""),
        parameters=_values(document.get("parameters")),
        leftover=tuple(_left(one) for one in document.get("leftover") or ()),
        trials=tuple(map(str, made.get("trials") or ())),
        adopted=tuple(str(effect["name"]) for effect in made.get("adopted") or ()),
    )


def _time(span: dict[str, Any]) -> Share:
    start, end = _number(span["from"]), _number(span["to"])
    return Share(f"{start:g} to {end:g} s", _number(span["share"]), "", start, end)


def _ranked(row: dict[str, Any]) -> Ranked:
    return Ranked(
        effect=str(row["effect"]),
        params=_values(row.get("params")),
        evidence=_number(row.get("evidence")),
        gap_after=_number(row.get("gap_after")),
        shrinkage=_number(row.get("shrinkage")),
        fixed=tuple((str(k), _number(v)) for k, v in (row.get("fixed") or {}).items()),
    )


def _values(table: dict[str, Any] | None) -> tuple[Value, ...]:
    return tuple(
        Value(str(name), _number(p["value"]), _number(p.get("std")), str(p.get("unit") or ""))
        for name, p in (table or {}).items()
    )


def _left(one: dict[str, Any]) -> Left:
    region = one.get("region") or {}
    return Left(
        channel=str(one["channel"]),
        size=_number(one.get("size")),
        unit=str(one.get("unit") or ""),
        when=str(region.get("when") or ""),
        share=_number(region.get("share")),
        evidence=_number(one.get("evidence")),
    )


def _gap(gap: dict[str, Any]) -> Gap:
    return Gap(
        horizon_s=_number(gap.get("horizon_s")),
        unit=str(gap.get("unit") or ""),
        before=_number(gap.get("before")),
        after=_number(gap.get("after")),
        floor=_number(gap.get("floor")),
        held_out=bool(gap.get("held_out")),
    )


def _number(value: Any) -> float:
    """A finite number, or NaN for null."""
    return math.nan if value is None else float(value)
