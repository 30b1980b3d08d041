"""Findings on how a log came about, and what is wrong with it."""

from __future__ import annotations

from grounded.findings.catalogue import Entry

ENTRIES: dict[str, Entry] = {}
