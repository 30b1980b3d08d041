"""Findings on a manoeuvre that was drawn."""

from __future__ import annotations

from grounded.findings.catalogue import Entry

ENTRIES: dict[str, Entry] = {
    "readings": Entry(
        "note",
        "the sensor of {about} reads {bias}, and the target is in its readings[[; it ends at "
        "{end}]][[; [task] start is {start}]]",
        "if a true 0 is meant there, add the bias",
    ),
    "start": Entry(
        "note",
        "[task] start is where {about} rests: {start}",
        "if runs begin elsewhere, change it and draw the target again",
    ),
    "may_rest": Entry(
        "note",
        "nothing asks for rest at the end",
        "for {about} there, by weights in [reward] terminal, draw it again with `--rest` as well",
    ),
    "replaced": Entry(
        "note",
        "the search starts again; before: {about}[[about? , ]]the target in {file}.bak",
        "to go back, copy {file}.bak and grounded.toml.bak over {file} and grounded.toml",
    ),
}
