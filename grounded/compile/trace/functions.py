"""NumPy's functions on expressions, by NumPy's names.

Each is one operation of a graph or a few: hypot is a root of squares, a remainder is what the floor
leaves. Conditions are weights, so that `where`, `maximum` and the like can be smoothed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from grounded.compile.trace.expression import (
    FUNCTIONS,
    Expression,
    any_traced,
    apply,
    at_least,
    logical_and,
    logical_not,
    logical_or,
    remainder,
    weight_of,
)


def where(condition: Any, a: Any, b: Any) -> Any:
    """np.where, blended when smoothed."""
    if not any_traced((condition, a, b)):
        return np.where(condition, a, b)
    if not isinstance(condition, Expression):
        return a if condition else b
    return apply("blend", weight_of(condition.graph, condition), a, b)


def maximum(a: Any, b: Any) -> Any:
    """The larger of two."""
    return apply("max", a, b)


def minimum(a: Any, b: Any) -> Any:
    """The smaller of two."""
    return -apply("max", _negative(a), _negative(b))


def _negative(a: Any) -> Any:
    return -a if isinstance(a, Expression) else -float(a)


def clip(x: Any, low: Any = None, high: Any = None, **kwargs: Any) -> Any:
    """np.clip."""
    low, high = (
        kwargs.get("min", kwargs.get("a_min", low)),
        kwargs.get("max", kwargs.get("a_max", high)),
    )
    if low is not None:
        x = maximum(x, low) if any_traced((x, low)) else max(x, low)
    if high is not None:
        x = minimum(x, high) if any_traced((x, high)) else min(x, high)
    return x


def hypot(a: Any, b: Any) -> Any:
    """sqrt(a^2 + b^2)."""
    return apply("sqrt", apply("add", a * a, b * b))


def heaviside(x: Any, middle: Any) -> Any:
    """0, middle, 1."""
    return where(apply("equal", x, 0.0), middle, apply("above", x, 0.0))


def copysign(a: Any, b: Any) -> Any:
    """|a| with the sign of b (b = 0 counts as positive)."""
    size = abs(a)
    return where(at_least(b, 0.0) if isinstance(b, Expression) else b >= 0, size, -size)


def isfinite(x: Any) -> Any:
    """Whether x - x is 0: for finite numbers alone."""
    return apply("equal", x - x, 0.0)


def _op(name: str) -> Callable[..., Any]:
    return lambda *args: apply(name, *args)


TRACED: dict[str, Callable[..., Any]] = {
    **{name: _op(op) for op, names in PLAIN.items() for name in (op, names)},
    "true_divide": _op("div"),
    "positive": lambda x: x,
    "float_power": _op("pow"),
    "sign": _op("sign"),
    "arcsinh": lambda x: apply("log", x + apply("sqrt", x * x + 1.0)),
    "arccosh": lambda x: apply("log", x + apply("sqrt", x * x - 1.0)),
    "arctanh": lambda x: 0.5 * (apply("log1p", x) - apply("log1p", -x)),
    "absolute": _op("abs"),
    "abs": _op("abs"),
    "fabs": _op("abs"),
    "ceil": lambda x: -apply("floor", -x),
    "fix": _op("trunc"),
    "round": lambda x, decimals=0: x.__round__(decimals),
    "around": lambda x, decimals=0: x.__round__(decimals),
    "square": lambda x: x * x,
    "reciprocal": lambda x: 1.0 / x,
    "exp2": lambda x: apply("exp", x * float(np.log(2.0))),
    "log2": lambda x: apply("log", x) * float(1 / np.log(2.0)),
    "log10": lambda x: apply("log", x) * float(1 / np.log(10.0)),
    "deg2rad": lambda x: x * (np.pi / 180),
    "radians": lambda x: x * (np.pi / 180),
    "rad2deg": lambda x: x * (180 / np.pi),
    "degrees": lambda x: x * (180 / np.pi),
    "hypot": hypot,
    "remainder": remainder,
    "mod": remainder,
    "fmod": lambda a, b: a - apply("trunc", apply("div", a, b)) * b,
    "floor_divide": lambda a, b: apply("floor", apply("div", a, b)),
    "maximum": maximum,
    "minimum": minimum,
    "fmax": maximum,
    "fmin": minimum,
    "clip": clip,
    "where": where,
    "heaviside": heaviside,
    "copysign": copysign,
    "isfinite": isfinite,
    "greater": lambda a, b: apply("above", a, b),
    "less": lambda a, b: apply("above", b, a),
    "greater_equal": at_least,
    "less_equal": lambda a, b: at_least(b, a),
    "equal": _op("equal"),
    "not_equal": lambda a, b: logical_not(apply("equal", a, b)),
    "logical_and": logical_and,
    "logical_or": logical_or,
    "logical_not": logical_not,
    "bitwise_and": logical_and,
    "bitwise_or": logical_or,
    "invert": logical_not,
    "asarray": lambda x, dtype=None: x,
    "real": lambda x: x,
    "nan_to_num": lambda x: where(isfinite(x), x, 0.0),
}
FUNCTIONS.update(TRACED)
