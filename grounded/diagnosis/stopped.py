"""Parameters that stopped at a bound or at the edge of their prior."""

from __future__ import annotations

from collections.abc import Mapping

from grounded.diagnosis.report import Estimate
from grounded.result import listed

ENDED = {  # by `Estimate.stopped`
    "": (),
    "bound": ("at its bound, the data ask for more",),
    "prior": ("at the limit of its std, the data ask for more",),
}

AT_BOUNDS = (  # advice on the next trial if every parameter that moved is there
    "None helps yet: parameters stopped at their bounds and the data ask for more. Widen the "
    "bounds in the model file if the true value may lie beyond; otherwise a parameter that the "
    "model holds constant may be off, so give it bounds. Then diagnose again."
)


def wider(known: Mapping[str, Estimate]) -> str:
    """Return advice on the parameters that their prior stopped; "" if there are none.

    Args:
        known: the calibrated values, by parameter.
    """
    names = [name for name, estimate in known.items() if estimate.stopped == "prior"]
    if not names:
        return ""
    one = len(names) == 1
    its, each = ("its", "it is") if one else ("their", "they are")
    return (
        f"{listed(names)} moved as far as {its} std allows, and the data ask for more: if {each} "
        f"known less well than that, widen {its} std in the model file, or give bounds instead, "
        "and diagnose again; otherwise adopt the claimed effects."
    )
