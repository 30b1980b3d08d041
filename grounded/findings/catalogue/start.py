"""Findings on how a workspace begins."""

from __future__ import annotations

from grounded.findings.catalogue import Entry

ENTRIES: dict[str, Entry] = {}
