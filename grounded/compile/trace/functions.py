"""What the user's function calls, on expressions: NumPy's functions, `math`, `max`, `min`, `float`.

NumPy asks its arguments how to be applied (`__array_ufunc__`), and finds here, by its own names,
functions that are one operation of a graph or a few. Conditions are weights, so that `where`,
`maximum` and the like can be smoothed.

Python's `math` and `max` don't ask. So the user's function is copied (`rebound`) with a copy of its
globals and closure in which these names mean functions that trace expressions and pass numbers on.
Helper functions that it calls are copied in the same way; NumPy and the standard library are left
alone, and so is the user's module.
"""

from __future__ import annotations

import builtins
import math
import sys
from collections.abc import Callable
from functools import partial, reduce
from types import CellType, CodeType, FunctionType, MethodType, ModuleType, SimpleNamespace
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
from grounded.compile.trace.graph import PLAIN


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
    low = kwargs.get("min", kwargs.get("a_min", low))
    high = kwargs.get("max", kwargs.get("a_max", high))
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
    **{name: _op(op) for op, numpys in PLAIN.items() for name in (op, numpys)},
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


LEFT_ALONE = frozenset(sys.stdlib_module_names - {"__main__"}) | {"numpy", "scipy", "llvmlite"}


def rebound(function: Any, memo: dict[int, Any] | None = None) -> Any:
    """The copy; anything that isn't a Python function of the user's is returned as it is."""
    memo = {} if memo is None else memo
    if id(function) in memo:
        return memo[id(function)]
    if isinstance(function, partial):
        return partial(rebound(function.func, memo), *function.args, **function.keywords)
    if isinstance(function, MethodType):
        return MethodType(rebound(function.__func__, memo), function.__self__)
    if not isinstance(function, FunctionType):
        call = getattr(type(function), "__call__", None)  # noqa: B004
        if isinstance(call, FunctionType) and _is_users(call):
            return MethodType(rebound(call, memo), function)
        return function
    return _copy(function, memo) if _is_users(function) else function


def _is_users(function: FunctionType) -> bool:
    return (function.__module__ or "").partition(".")[0] not in LEFT_ALONE


def _copy(function: FunctionType, memo: dict[int, Any]) -> FunctionType:
    world = dict(function.__globals__)
    cells = tuple(CellType() for _ in function.__closure__ or ())
    copy = FunctionType(
        function.__code__, world, function.__name__, function.__defaults__, cells or None
    )
    copy.__kwdefaults__ = function.__kwdefaults__
    memo[id(function)] = copy
    for cell, old in zip(cells, function.__closure__ or (), strict=True):
        try:
            cell.cell_contents = _replacement(old.cell_contents, memo)
        except ValueError:  # an empty cell: a name that is not bound yet
            continue
    for name in _names(function.__code__):
        if name in world:
            world[name] = _replacement(world[name], memo)
        elif name in TRACED_BUILTINS:
            world[name] = TRACED_BUILTINS[name]
    return copy


def _names(code: CodeType) -> set[str]:
    """Global names that a function or a function inside it may use."""
    inner = (c for c in code.co_consts if isinstance(c, CodeType))
    return set(code.co_names).union(*(_names(c) for c in inner))


def _replacement(value: Any, memo: dict[int, Any]) -> Any:
    if value is math:
        return TRACED_MATH
    if isinstance(value, ModuleType):
        alone = value.__name__.partition(".")[0] in LEFT_ALONE
        return value if alone else _Module(value, memo)
    try:
        if value in _BY_FUNCTION:  # from math import sin
            return _BY_FUNCTION[value]
    except TypeError:  # not hashable
        return value
    if isinstance(value, FunctionType | MethodType | partial):
        return rebound(value, memo)
    return value


class _Module:
    """A user's module whose functions are copied when they are asked for."""

    def __init__(self, module: ModuleType, memo: dict[int, Any]) -> None:
        self._module, self._memo = module, memo

    def __getattr__(self, name: str) -> Any:
        return _replacement(getattr(self._module, name), self._memo)


def _either(traced: Callable[..., Any], plain: Callable[..., Any]) -> Callable[..., Any]:
    def call(*args: Any, **kwargs: Any) -> Any:
        return (traced if any_traced(args) else plain)(*args, **kwargs)

    return call


def _log(x: Any, base: float | None = None) -> Any:
    value = TRACED["log"](x)
    return value if base is None else value / math.log(base)


def _hypot(*args: Any) -> Any:
    return TRACED["sqrt"](sum(a * a for a in args))


def _extreme(pair: Callable[[Any, Any], Any], plain: Callable[..., Any]) -> Callable[..., Any]:
    def call(*args: Any, **kwargs: Any) -> Any:
        values = tuple(args[0]) if len(args) == 1 else args
        if not any_traced(values):
            return plain(*args, **kwargs)
        return reduce(lambda a, b: pair(a, b) if any_traced((a, b)) else plain(a, b), values)

    return call


class _Float(type):
    def __instancecheck__(cls, value: object) -> bool:
        return isinstance(value, float)

    def __call__(cls, value: Any = 0.0) -> Any:
        return value if isinstance(value, Expression) else float(value)


class TracedFloat(metaclass=_Float):
    """`float` that lets expressions through."""


_IN_MATH = {name: f for name, f in TRACED.items() if hasattr(math, name)}
_IN_MATH |= {"log": _log, "hypot": _hypot, "asinh": TRACED["arcsinh"]}
_IN_MATH |= {"acosh": TRACED["arccosh"], "atanh": TRACED["arctanh"]}
_BY_FUNCTION = {
    getattr(math, name): _either(f, getattr(math, name)) for name, f in _IN_MATH.items()
}
TRACED_MATH = SimpleNamespace(
    **{
        name: _BY_FUNCTION.get(value, value) if callable(value) else value
        for name, value in vars(math).items()
        if not name.startswith("_")
    }
)
TRACED_BUILTINS = {
    "max": _extreme(maximum, builtins.max),
    "min": _extreme(minimum, builtins.min),
    "float": TracedFloat,
}
