"""Units that a log writes beside its numbers, `x [mm]`, against those of the model.

What a CSV's first row says is no guess: where it names a multiple of the model's unit, [log] gets
the factor between the two. Units that are no multiples of each other say nothing.
"""

from __future__ import annotations

import math
import re
from collections import Counter

_OF = {  # a multiple of another unit, itself a product
    "mm": ("m", 1e-3),
    "cm": ("m", 1e-2),
    "km": ("m", 1e3),
    "deg": ("rad", math.pi / 180),
    "degree": ("rad", math.pi / 180),
    "degrees": ("rad", math.pi / 180),
    "°": ("rad", math.pi / 180),
    "mrad": ("rad", 1e-3),
    "rpm": ("rad/s", 2 * math.pi / 60),
    "dps": ("rad/s", math.pi / 180),
    "us": ("s", 1e-6),
    "ms": ("s", 1e-3),
    "min": ("s", 60.0),
    "h": ("s", 3600.0),
    "mV": ("V", 1e-3),
    "mA": ("A", 1e-3),
    "mN": ("N", 1e-3),
    "mNm": ("N m", 1e-3),
    "kN": ("N", 1e3),
    "g": ("kg", 1e-3),
    "Nm": ("N m", 1.0),
    "%": ("1", 0.01),
}


def factor_between(said: str, wanted: str) -> float | None:
    """By what a number in one unit is multiplied to be in another; None where that makes no sense.

    Args:
        said: as a log writes it, such as "mm/s" or "deg/s^2".
        wanted: as the model has it.
    """
    (a, one), (b, other) = _in_base(said), _in_base(wanted)
    return one / other if a == b else None


def _in_base(unit: str) -> tuple[Counter[str], float]:
    """The powers of a unit's parts that are no multiples of others, and its size in those."""
    powers, size = Counter[str](), 1.0
    for k, side in enumerate(unit.replace("²", "^2").replace("·", " ").split("/")):
        for part in re.findall(r"[^\s*^()]+(?:\^-?\d+)?", side):
            name, _, power = part.partition("^")
            sign = (-1 if k else 1) * int(power or 1)
            inner, by = _in_base(_OF[name][0]) if name in _OF else (Counter({name: 1}), 1.0)
            size *= (by * _OF.get(name, ("", 1.0))[1]) ** sign
            for base, count in inner.items():
                powers[base] += sign * count
    return Counter({base: n for base, n in powers.items() if n and base != "1"}), size
