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
    "slower": Entry(
        "note",
        "it reaches {fastest} at most, not --speed {asked:g}: --accel {accel:g} and --lateral "
        "{lateral:g} m/s^2 limit it",
    ),
    "may_rest": Entry(
        "note",
        "nothing asks for rest at the end",
        "for {about} there, by weights in [reward] terminal, draw it again with `--rest` as well",
    ),
    "kept": Entry(
        "note",
        "[reward] state is kept, since it was chosen: {weights}",
        "delete the line and draw the target again for this target's own: {usual}",
    ),
    "still": Entry(
        "note",
        "{about} {about:does/do} not move in the target, so it does not show what a small error is",
        "choose the weight in [reward] state",
    ),
    "noisy_end": Entry(
        "note",
        "the weight of {about} at the end is only {least:.3g}: with it, the sensor noise ({noise}) "
        "costs {cost:g} of the utility, and with a larger one the inputs would answer that noise",
    ),
    "replaced": Entry(
        "note",
        "the search starts again; before: {about}[[about? , ]]the target in {file}.bak",
        "to go back, copy {file}.bak and grounded.toml.bak over {file} and grounded.toml",
    ),
}
