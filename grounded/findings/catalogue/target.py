"""Findings on a manoeuvre that was drawn."""

from __future__ import annotations

from grounded.findings.catalogue import Entry

ENTRIES: dict[str, Entry] = {
    "readings": Entry(
        "note",
        "the sensor of {about} reads {bias}, and the target is in its readings[[; it ends at "
        "{end}]][[; [task] start is {start}]]",
    ),
    "may_rest": Entry("note", "nothing asks {about} to rest at the end", "`--rest` does"),
    "replaced": Entry(
        "note",
        "the search starts again; before: {about}[[about? , ]]the target in {file}.bak",
    ),
}
