"""Units: one table for the whole house, their products, and how names end in them.

    UNITS       a unit -> the unit that it is a multiple of, and how many of them
    ENDINGS     the ending of a name -> the unit that it states: `x_mm`, `speed_kmh`

`factor_between` converts; units that are no multiples of each other have no factor.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable

UNITS: dict[str, tuple[str, float]] = {
    **{"mm": ("m", 1e-3), "cm": ("m", 1e-2), "km": ("m", 1e3)},
    **{"feet": ("m", 0.3048), "ft": ("m", 0.3048), "mile": ("m", 1609.344)},
    **dict.fromkeys(("deg", "degree", "degrees", "°", "Grad"), ("rad", math.pi / 180)),
    **{"mrad": ("rad", 1e-3), "U": ("rad", 2 * math.pi)},
    **{"rpm": ("rad/s", math.pi / 30), "dps": ("rad/s", math.pi / 180)},
    **{"knots": ("m/s", 1852 / 3600), "mph": ("m/s", 1609.344 / 3600)},
    **{
        "ns": ("s", 1e-9),
        "us": ("s", 1e-6),
        "ms": ("s", 1e-3),
        "min": ("s", 60.0),
        "h": ("s", 3600.0),
    },
    **{"mV": ("V", 1e-3), "mA": ("A", 1e-3)},
    **{"mN": ("N", 1e-3), "kN": ("N", 1e3), "mNm": ("N m", 1e-3), "Nm": ("N m", 1.0)},
    **{"g": ("kg", 1e-3), "%": ("1", 0.01), "°C": ("degC", 1.0)},
}
DEGREES, RPM = 1 / UNITS["deg"][1], 1 / UNITS["rpm"][1]  # in a radian, in one rad/s
ENDINGS = {
    **dict.fromkeys(("deg_s", "degs", "deg_per_s", "dps", "Grad_s"), "deg/s"),
    **dict.fromkeys(("rad_s", "rads", "rad_per_s"), "rad/s"),
    **dict.fromkeys(("m_s", "mps", "m_per_s"), "m/s"),
    **dict.fromkeys(("km_h", "kmh", "kph"), "km/h"),
    **{"mm_s": "mm/s", "cm_s": "cm/s", "m_s2": "m/s^2", "deg_s2": "deg/s^2"},
    **dict.fromkeys(("rpm", "RPM", "U_min", "Upm"), "rpm"),
    **dict.fromkeys(("C", "degC", "celsius", "Celsius"), "degC"),
    **dict.fromkeys(("pct", "percent", "perc"), "%"),
    **dict.fromkeys(("deg", "degree", "degrees", "Grad"), "deg"),
    **dict.fromkeys(("rad", "radian", "radians"), "rad"),
    **{unit: unit for unit in ("mm", "cm", "m", "km", "mrad", "us", "ms", "s")},
    **{unit: unit for unit in ("mV", "V", "mA", "A", "Nm", "mNm", "mN", "N", "kN")},
}


def factor_between(said: str, wanted: str) -> float | None:
    """Return the factor that converts a number from one unit to another; None if incompatible."""
    (a, one), (b, other) = _in_base(said), _in_base(wanted)
    return one / other if a == b else None


def same_unit(said: str, wanted: str) -> bool:
    """Check whether two spellings mean the same unit, such as `N·m`, `Nm` and `N m`."""
    factor = factor_between(said, wanted)
    return factor is not None and math.isclose(factor, 1.0)


def _in_base(unit: str) -> tuple[Counter[str], float]:
    """Return a unit as powers of base units, and its factor to these."""
    powers, size = Counter[str](), 1.0
    for k, side in enumerate(unit.replace("²", "^2").replace("·", " ").split("/")):
        for part in re.findall(r"[^\s*^()]+(?:\^-?\d)?", side):
            name, _, power = part.partition("^")
            sign = (-1 if k else 1) * int(power or 1)
            inner, by = _in_base(UNITS[name][0]) if name in UNITS else (Counter({name: 1}), 1.0)
            size *= (by * UNITS.get(name, ("", 1.0))[1]) ** sign
            for base, count in inner.items():
                powers[base] += sign * count
    return Counter({base: n for base, n in powers.items() if n and base != "1"}), size


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
