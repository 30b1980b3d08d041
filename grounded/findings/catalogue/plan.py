"""Findings on what a candidate will do, and whether to trust it."""

from __future__ import annotations

from grounded.findings.catalogue import Entry

ENTRIES: dict[str, Entry] = {}
