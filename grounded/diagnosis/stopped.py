"""Parameters that ended where they may go no further, though the data ask for more."""

from __future__ import annotations

from collections.abc import Mapping

from grounded.diagnosis.report import Estimate
from grounded.result import listed

ENDED = {  # by `Estimate.stopped`
    "": (),
    "bound": ("at its bound: the data ask for more",),
    "prior": ("as far as its std lets it go: the data ask for more",),
}

AT_BOUNDS = (  # said of the next trial where all that moved are there
    "None helps before this: parameters ended at their bounds and the data ask for more. Where one "
    "may lie beyond, widen its bounds in the model file; else another, which the model has as a "
    "constant, may be off: give it bounds. Then diagnose again."
)


def wider(known: Mapping[str, Estimate]) -> str:
    """What to do about those whose prior stopped them, a sentence; "" where it stopped none.

    Args:
        known: the calibrated values, by parameter.
    """
    names = [name for name, estimate in known.items() if estimate.stopped == "prior"]
    if not names:
        return ""
    one = len(names) == 1
    its, it, each = ("its", "it", "it is") if one else ("their", "them", "they are")
    return (
        f"{listed(names)} went as far as {its} std {'lets' if one else 'let'} {it}, and the data "
        f"ask for more: if {each} known less well than that, widen {its} std in the model file, or "
        "give bounds instead, and diagnose again; else adopt what is claimed."
    )
