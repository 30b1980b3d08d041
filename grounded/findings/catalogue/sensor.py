"""Findings on the signals of a log: clauses that continue a sentence after the signal's name."""

from __future__ import annotations

from grounded.findings.catalogue import Entry

ENTRIES: dict[str, Entry] = {
    "late": Entry(
        "warn",
        "[[{by} later than ]][[tau? follows ]][[derivative? the derivative of ]][[{of}]]"
        "[[ through a filter of {tau:.3g} s]][[is older by another {more:.3g} s, by which the log "
        "of {position} itself is late]][[is in one message with, and so as late as, {message}]]",
    ),
    "derived": Entry(
        "note",
        "is a filtered derivative of {of}, {age:.2g} s behind it on average; left out of the "
        "diagnosis: it tells nothing more than {of}",
    ),
    "scale": Entry(
        "warn",
        "shows [[{share:%} of]][[{size} {way} than]] the rate of {of}[[rpm? , 2 pi / 60 times it: "
        "it was probably converted from rpm by mistake]][[!rpm? ; either may be wrong]]",
    ),
    "samples": Entry(
        "warn",
        "[[degrees? is in degrees: ]][[jumps by a full turn {count:time}]][[drops to {low} for "
        "single samples]][[has a new value only every {every:.3g} s]]"
        "[[sticks to its last value, up to {stuck:.3g} s at a time, and then jumps]]"
        "[[ ({share:%})]]",
    ),
    "mismatch": Entry(
        "warn",
        "does not move as {of} {of:implies/imply} (its rate is off by {off})",
    ),
    "unresolved": Entry(
        "warn",
        "reaches {reach} in {trial}: from {at} on, the model can't be "
        "integrated with time steps of {step}, and the rest of that trial is left out",
    ),
    # how to mend it for good
    "mend": Entry(
        "note",
        "{about} can be mended for good",
        "[[the program that writes the trials should {how:late=read it with less delay or filter "
        "it less,sign=flip its sign,degrees=write it in the model's unit}]][[treat it as {of}: ]]"
        "[[if the robot's program gets it as late as this log does, `adopt` sensor_delay, and the "
        "plan allows for it; else set {log} in its table of [log]; not both]]"
        "[[fed? ; the runner's feedback gets it late as well]]",
    ),
}
