"""Numbers in words for people."""

from __future__ import annotations

import math


def figure(value: float | None, digits: int = 4) -> str:
    """`digits` significant digits; "failed" for minus infinity, "-" where there is none."""
    if value is None or math.isnan(value):
        return "-"
    if value == -math.inf:
        return "failed"
    if value != 0 and not 1e-3 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}"
    decimals = max(digits - 1 - math.floor(math.log10(abs(value))) if value else digits - 1, 0)
    return f"{value:,.{decimals}f}"
