"""The words of every finding: a code -> its weight, sentence and remedy.

Read `gap` as an example. A module an area, which is the part of the code before its first dot.
`numbers` says how slots are written. `short` says what was found and what it means, `remedy` what
to do; `hides` names the codes (with `*`) that are only its consequences.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import import_module

AREAS = (
    "file",
    "gap",
    "given",
    "log",
    "model",
    "plan",
    "run",
    "search",
    "sensor",
    "start",
    "target",
)

WEIGHTS = {
    "refuse": "the command stops",
    "aside": "the trial does not count until a person decides",
    "warn": "what was done may be wrong",
    "note": "good to know; nothing stops and everything counts",
}


@dataclass(frozen=True)
class Entry:
    """The words of one code.

    Args:
        weight: one of `WEIGHTS`, which says what it means.
        short: what was found, a clause without a full stop.
        remedy: what to do about it, "" for nothing.
        hides: codes of findings that follow from it.
    """

    weight: str
    short: str
    remedy: str = ""
    hides: tuple[str, ...] = ()


@cache
def entries(area: str) -> dict[str, Entry]:
    """Return the entries of an area by code."""
    module = import_module(f"{__name__}.{area}")
    return {f"{area}.{name}": entry for name, entry in module.ENTRIES.items()}


def entry_of(code: str) -> Entry:
    """Return the entry of a code; KeyError if there is none."""
    return entries(code.partition(".")[0])[code]


def codes() -> list[str]:
    """Return all codes, area by area."""
    return [code for area in AREAS for code in entries(area)]
