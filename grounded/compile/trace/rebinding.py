"""A copy of the user's function in whose world `math`, `max`, `min` and `float` can be traced.

NumPy asks its arguments how to be applied (`__array_ufunc__`), Python's `math` and `max` do not.
So the function is copied with a copy of its globals (and closure) in which these names mean
functions that pass numbers on and trace expressions. Helper functions that it calls are copied in
the same way; NumPy and the standard library are left alone, and so is the user's module.
"""

from __future__ import annotations

import builtins
import math
import sys
from collections.abc import Callable
from functools import partial, reduce
from types import CellType, CodeType, FunctionType, MethodType, ModuleType, SimpleNamespace
from typing import Any

from grounded.compile.trace.expression import Expression, any_traced
from grounded.compile.trace.functions import TRACED as FUNCTIONS
from grounded.compile.trace.functions import maximum, minimum

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
    value = FUNCTIONS["log"](x)
    return value if base is None else value / math.log(base)


def _hypot(*args: Any) -> Any:
    return FUNCTIONS["sqrt"](sum(a * a for a in args))


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


_IN_MATH = {name: f for name, f in FUNCTIONS.items() if hasattr(math, name)}
_IN_MATH |= {"log": _log, "hypot": _hypot, "asinh": FUNCTIONS["arcsinh"]}
_IN_MATH |= {"acosh": FUNCTIONS["arccosh"], "atanh": FUNCTIONS["arctanh"]}
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
