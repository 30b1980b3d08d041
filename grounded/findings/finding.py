"""Finding: one thing that a command tells, as data; and which of several are told."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from fnmatch import fnmatchcase
from typing import Any

from grounded.errors import NextCommand
from grounded.findings.catalogue import entry_of
from grounded.findings.numbers import filled, slots


class Weight(StrEnum):
    """What a finding asks of the reader, in the words of `WEIGHTS`; the heaviest first."""

    REFUSE = "refuse"
    ASIDE = "aside"
    WARN = "warn"
    NOTE = "note"


@dataclass(frozen=True)
class Quantity:
    """A measured value with its unit and, if known, its standard deviation in that unit."""

    value: float
    unit: str = "1"
    std: float = math.nan

    def to_json(self) -> dict[str, Any]:
        """Return value, std (null if unknown) and unit."""
        finite = [one if math.isfinite(one) else None for one in (self.value, self.std)]
        return {"value": finite[0], "std": finite[1], "unit": self.unit}


Fact = Quantity | bool | float | int | str | tuple[str, ...]


@dataclass(frozen=True)
class Finding:
    """One thing that a command tells.

    Args:
        code: its entry in the catalogue, such as "log.unit"; stable, for scripts.
        about: the signals, trials or candidates that it is about.
        facts: what was measured, by slot of the entry.
        weight: what it asks of the reader; that of the entry unless stated.
        nats: evidence for it, NaN if it does not rest on a statistic.
        then: the command that it asks for, None for none.
    """

    code: str
    about: tuple[str, ...] = ()
    facts: Mapping[str, Fact] = field(default_factory=dict)
    weight: Weight = Weight.NOTE
    nats: float = math.nan
    then: NextCommand | None = None

    @property
    def sentence(self) -> str:
        """What was found, and what to do where the entry has a remedy, after its place `where`."""
        entry = entry_of(self.code)
        facts = {"about": self.about, **self.facts}
        texts = (filled(text, facts).strip(" ;") for text in (entry.short, entry.remedy))
        place = f"{self.facts['where']}: " if "where" in self.facts else ""
        return place + "; ".join(text for text in texts if text)

    @property
    def printable(self) -> bool:
        """Whether the catalogue has words for it: it may be from a document of another version."""
        try:
            entry = entry_of(self.code)
        except (KeyError, ImportError):
            return False
        return slots(entry.short) | slots(entry.remedy) <= {"about", *self.facts}

    @property
    def remedy(self) -> str:
        """What to do about it, "" for nothing."""
        return filled(entry_of(self.code).remedy, {"about": self.about, **self.facts}).strip(" ;")

    @property
    def what(self) -> str:
        """What was found, without a remedy."""
        return filled(entry_of(self.code).short, {"about": self.about, **self.facts})

    @property
    def clause(self) -> str:
        """What was found, as it continues a sentence after what it is about."""
        return filled(entry_of(self.code).short, {**self.facts, "about": ()}).strip()

    def weighing(self, weight: Weight) -> Finding:
        """Return it with another weight."""
        return replace(self, weight=weight)

    def also(self, **facts: Fact | None) -> Finding:
        """Return it with further facts, or others in their place; None is left out."""
        known = {name: value for name, value in facts.items() if value is not None}
        return replace(self, facts={**self.facts, **known})

    def to_json(self) -> dict[str, Any]:
        """Return its entry in the `findings` of a JSON document."""
        facts = {
            name: value.to_json() if isinstance(value, Quantity) else value
            for name, value in self.facts.items()
        }
        then = self.then and {"command": self.then.verb, "arguments": list(self.then.arguments)}
        return {
            "code": self.code,
            "weight": self.weight.value,
            "about": list(self.about),
            "facts": facts,
            "nats": self.nats if math.isfinite(self.nats) else None,
            "sentence": self.sentence,
            "then": then,
        }

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Finding:
        """Return the finding that `to_json` wrote, of this version."""

        def fact(value: Any) -> Fact:
            if isinstance(value, dict):
                number, std = (math.nan if x is None else x for x in (value["value"], value["std"]))
                return Quantity(number, value["unit"], std)
            return tuple(value) if isinstance(value, list) else value

        then, nats = document["then"], document["nats"]
        return cls(
            document["code"],
            tuple(document["about"]),
            {name: fact(value) for name, value in document["facts"].items()},
            Weight(document["weight"]),
            math.nan if nats is None else nats,
            then and NextCommand(then["command"], tuple(then["arguments"])),
        )


def found(
    code: str,
    *about: str,
    nats: float = math.nan,
    then: NextCommand | None = None,
    weight: Weight | None = None,
    **facts: Fact | None,
) -> Finding:
    """Return a finding with the weight of its entry and the facts that are not None."""
    weighs = weight or Weight(entry_of(code).weight)
    return Finding(code, about, {}, weighs, nats, then).also(**facts)


ORDER = list(Weight)  # the heaviest first


def settle(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return the findings to tell, the heaviest first, then those with most evidence.

    One that is only a consequence of another, as that one's entry says (`hides`), is left out if
    both are about the same signal or trial, or one of them is about none. What stands there twice
    is told once, with its heaviest weight.
    """
    once = dict[tuple[str, tuple[str, ...]], Finding]()
    for one in findings:
        known = once.setdefault((one.code, one.about), one)
        if ORDER.index(one.weight) < ORDER.index(known.weight):
            once[one.code, one.about] = one
    if len(once) < 2:
        return tuple(once.values())
    kept = [
        one
        for one in once.values()
        if not any(_hides(other, one) for other in once.values() if other is not one)
    ]
    return tuple(sorted(kept, key=_rank))


def _rank(one: Finding) -> tuple[int, float]:
    return ORDER.index(one.weight), -one.nats if math.isfinite(one.nats) else 0.0


def _hides(one: Finding, other: Finding) -> bool:
    """Return whether a finding is told by another already."""
    shared = not one.about or not other.about or bool({*one.about} & {*other.about})
    return shared and any(fnmatchcase(other.code, code) for code in entry_of(one.code).hides)
