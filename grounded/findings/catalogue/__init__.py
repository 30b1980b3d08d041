"""The words of every finding: a code -> its weight, sentence and remedy.

Read `models` as an example. The part of a code before its first dot is its area, a table of its
own; `numbers` says how slots are written. `short` says what was found and what it means, `remedy`
what to do; `hides` names the codes (with `*`) that are only its consequences.
"""

from __future__ import annotations

from grounded.findings.catalogue.entry import Entry
from grounded.findings.catalogue.files import FILE, GIVEN, START, TARGET
from grounded.findings.catalogue.logs import LOG, RUN, SENSOR
from grounded.findings.catalogue.models import GAP, MODEL
from grounded.findings.catalogue.plans import PLAN, SEARCH

WEIGHTS = {
    "refuse": "the command stops",
    "aside": "the trial does not count until a person decides",
    "warn": "what was done may be wrong",
    "note": "good to know; nothing stops and everything counts",
}
AREAS = {
    "file": FILE,
    "gap": GAP,
    "given": GIVEN,
    "log": LOG,
    "model": MODEL,
    "plan": PLAN,
    "run": RUN,
    "search": SEARCH,
    "sensor": SENSOR,
    "start": START,
    "target": TARGET,
}
ENTRIES = {f"{area}.{name}": one for area, table in AREAS.items() for name, one in table.items()}


def entry_of(code: str) -> Entry:
    """Return the entry of a code; KeyError if there is none."""
    return ENTRIES[code]


def codes() -> list[str]:
    """Return all codes, area by area."""
    return [*ENTRIES]
