"""Findings on a manoeuvre that was drawn."""

from __future__ import annotations

from grounded.findings.catalogue import Entry

ENTRIES: dict[str, Entry] = {
    "readings": Entry(
        "note",
        "the sensor of {about} reads {bias}, and the target is in its readings; it ends at {end}",
    ),
    "start": Entry(
        "note",
        "[task] start is where {about} rests: {start}",
        "if runs begin elsewhere, change it and draw the target again",
    ),
}
