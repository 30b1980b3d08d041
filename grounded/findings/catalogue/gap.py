"""Findings of a diagnosis: the gap between model and log, and its causes."""

from __future__ import annotations

from grounded.findings.catalogue import Entry

ENTRIES: dict[str, Entry] = {}
