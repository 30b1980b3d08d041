"""Units at the end of names, such as `x_mm` or `speed_kmh`."""

from __future__ import annotations

from collections.abc import Iterable

ENDINGS = {  # unit by the ending of a name
    **dict.fromkeys(("deg_s", "degs", "deg_per_s", "dps"), "deg/s"),
    **dict.fromkeys(("rad_s", "rads", "rad_per_s"), "rad/s"),
    **dict.fromkeys(("m_s", "mps", "m_per_s"), "m/s"),
    **dict.fromkeys(("km_h", "kmh", "kph"), "km/h"),
    **{"mm_s": "mm/s", "cm_s": "cm/s", "m_s2": "m/s^2", "deg_s2": "deg/s^2", "RPM": "rpm"},
    **{"Grad": "deg", "Grad_s": "deg/s", "U_min": "rpm", "Upm": "rpm"},
    **dict.fromkeys(("C", "degC", "celsius", "Celsius"), "degC"),
    **dict.fromkeys(("pct", "percent", "perc"), "%"),
    **dict.fromkeys(("degree", "degrees"), "deg"),
    **dict.fromkeys(("radian", "radians"), "rad"),
    **{unit: unit for unit in ("mm", "cm", "m", "km", "deg", "mrad", "rad", "rpm", "us", "ms")},
    **{unit: unit for unit in ("mV", "mA", "Nm", "mNm", "mN", "kN")},
    **{unit: unit for unit in ("s", "V", "A", "N")},
}


def unit_ending(name: str) -> str:
    """Return the ending of a name that denotes a unit, such as `mm` of `x_mm`; "" for none."""
    for ending in sorted(ENDINGS, key=len, reverse=True):
        if name.endswith("_" + ending) and len(name) > len(ending) + 1:
            return ending
    return ""


def in_another_unit(name: str, known: Iterable[str]) -> list[str]:
    """Return the known names that differ from `name` only in the unit at the end."""
    return [one for one in known if one != name and _bare(one) == _bare(name)]


def _bare(name: str) -> str:
    ending = unit_ending(name)
    return name[: -len(ending) - 1] if ending else name
