"""A value that remembers how it was computed: what a model sees while it is traced.

An `Expression` answers Python's operators, NumPy's functions (`__array_ufunc__` and
`__array_function__`) and, because NumPy calls a method of that name on each element of an object
array, `x.sin()`. So `np.sin(s.psi)`, `np.array([s.x, s.y]) @ R` and `2 * s.v` all build the graph.
What it can't answer is a question about its value, `if s.v > 0`: it has none yet.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from grounded.compile.trace.graph import Graph

Operator = Callable[[Any, Any], Any]

FUNCTIONS: dict[str, Callable[..., Any]] = {}  # NumPy's names; filled by `functions`


class NotTraceable(Exception):
    """What the user's function does can't be put into a graph; the text says what."""


def _both_ways(function: Operator) -> tuple[Operator, Operator]:
    """An operator, and the one that Python asks when the expression stands on its right."""
    return function, lambda self, other: function(other, self)


class Expression:
    """A node of a graph, with the manners of a number."""

    __slots__ = ("graph", "i")
    __hash__ = None  # type: ignore[assignment]

    def __init__(self, graph: Graph, i: int) -> None:
        self.graph, self.i = graph, i

    # What has no value yet.

    def __bool__(self) -> bool:
        return bool(decide(self))

    def __float__(self) -> float:
        value = self.graph.constant(self.i)
        if value is None:
            raise NotTraceable("it needs the number behind a traced value (float, math, an index)")
        return value

    def __int__(self) -> int:
        return int(float(self))

    __index__ = __int__

    def __round__(self, digits: int | None = None) -> Any:
        if digits:
            raise NotTraceable("it rounds to decimal digits")
        return apply("rint", self)

    # Arithmetic.

    __add__, __radd__ = _both_ways(lambda a, b: apply("add", a, b))
    __sub__, __rsub__ = _both_ways(lambda a, b: apply("sub", a, b))
    __mul__, __rmul__ = _both_ways(lambda a, b: apply("mul", a, b))
    __truediv__, __rtruediv__ = _both_ways(lambda a, b: apply("div", a, b))
    __pow__, __rpow__ = _both_ways(lambda a, b: apply("pow", a, b))
    __mod__, __rmod__ = _both_ways(lambda a, b: remainder(a, b))
    __floordiv__, __rfloordiv__ = _both_ways(lambda a, b: apply("floor", apply("div", a, b)))

    def __neg__(self) -> Any:
        return apply("neg", self)

    def __pos__(self) -> Any:
        return self

    def __abs__(self) -> Any:
        return apply("abs", self)

    # Conditions: weights in [0, 1].

    __gt__, __lt__ = _both_ways(lambda a, b: apply("above", a, b))
    __ge__, __le__ = _both_ways(lambda a, b: at_least(a, b))
    __and__, __rand__ = _both_ways(lambda a, b: logical_and(a, b))
    __or__, __ror__ = _both_ways(lambda a, b: logical_or(a, b))

    def __eq__(self, other: object) -> Any:
        return apply("equal", self, other)

    def __ne__(self, other: object) -> Any:
        return logical_not(apply("equal", self, other))

    def __invert__(self) -> Any:
        return logical_not(self)

    # NumPy.

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **kwargs: Any) -> Any:
        if method != "__call__" or kwargs:
            raise NotTraceable(f"it uses np.{ufunc.__name__} with options ({method})")
        function = FUNCTIONS.get(ufunc.__name__)
        if function is None:
            raise NotTraceable(f"np.{ufunc.__name__} is not among the traced functions")
        return elementwise(function, *inputs)

    def __array_function__(self, function: Any, types: Any, args: Any, kwargs: Any) -> Any:
        known = FUNCTIONS.get(function.__name__)
        if known is None:
            raise NotTraceable(f"np.{function.__name__} is not among the traced functions")
        return elementwise(known, *args, **kwargs)

    def __getattr__(self, name: str) -> Any:
        if name in FUNCTIONS and not name.startswith("_"):  # np.sin of an object array
            return lambda *args: FUNCTIONS[name](self, *args)
        raise AttributeError(name)


def decide(condition: Expression) -> bool:
    """Answers an `if`: only a tracer that knows the parameters' values can (see `tracing.py`)."""
    oracle = condition.graph.oracle
    if oracle is None:
        raise NotTraceable("a Python `if`, `and`, `or`, `while` or `max` on a traced value")
    return oracle(condition.i)


def elementwise(function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """A function of expressions and numbers, broadcast over arrays of them.

    An array without axes, as np.where of two constants gives, is a number.
    """
    args = tuple(a[()] if isinstance(a, np.ndarray) and a.ndim == 0 else a for a in args)
    arrays = [np.asarray(a, object) for a in args if isinstance(a, np.ndarray | list | tuple)]
    if not arrays:
        return function(*args, **kwargs)
    wide = np.broadcast(
        *[np.asarray(a, object) if not isinstance(a, Expression) else _box(a) for a in args]
    )
    out = np.empty(wide.shape, object)
    out.reshape(-1)[:] = [function(*row, **kwargs) for row in wide]
    return out


def _box(value: Expression) -> Any:
    box = np.empty((), object)
    box[()] = value
    return box


def node_of(graph: Graph, value: Any) -> int:
    """The node of an expression or a number."""
    if isinstance(value, Expression):
        return value.i
    if isinstance(value, np.ndarray) and value.ndim == 0:
        return node_of(graph, value.item())
    if isinstance(value, complex | np.complexfloating | str | bytes):
        raise NotTraceable(f"it mixes a traced value with {value!r}")
    try:
        return graph.const(float(value))
    except (TypeError, ValueError):
        raise NotTraceable(f"it mixes a traced value with {type(value).__name__}") from None


def apply(op: str, *args: Any) -> Any:
    """An operation on expressions and numbers; arrays are handled one by one."""
    if any(isinstance(a, np.ndarray) and a.ndim for a in args):
        return elementwise(lambda *row: apply(op, *row), *args)
    graph = next((a.graph for a in args if isinstance(a, Expression)), None)
    if graph is None:
        raise NotTraceable(f"'{op}' of values that are not traced")
    result = Expression(graph, graph.node(op, *(node_of(graph, a) for a in args)))
    if op in ("above", "equal"):
        graph.conditions.add(result.i)
    return result


def any_traced(args: tuple[Any, ...]) -> bool:
    """Whether an argument is an expression."""
    return any(isinstance(a, Expression) for a in args)


def weight_of(graph: Graph, value: Any) -> Any:
    """A weight: conditions as they are, numbers and other values as `!= 0`."""
    if not isinstance(value, Expression):
        return 1.0 if value else 0.0
    return value if value.i in graph.conditions else logical_not(apply("equal", value, 0.0))


def _graph(*args: Any) -> Graph:
    found = next((a.graph for a in args if isinstance(a, Expression)), None)
    if found is None:
        raise NotTraceable("a condition without a traced value")
    return found


def _marked(value: Any) -> Any:
    if isinstance(value, Expression):
        value.graph.conditions.add(value.i)
    return value


def at_least(a: Any, b: Any) -> Any:
    """The condition a >= b: not (b > a)."""
    return logical_not(apply("above", b, a))


def logical_not(a: Any) -> Any:
    """1 - w."""
    return _marked(1.0 - weight_of(_graph(a), a))


def logical_and(a: Any, b: Any) -> Any:
    """The product w v."""
    graph = _graph(a, b)
    return _marked(weight_of(graph, a) * weight_of(graph, b))


def logical_or(a: Any, b: Any) -> Any:
    """The sum w + v - w v."""
    graph = _graph(a, b)
    w, v = weight_of(graph, a), weight_of(graph, b)
    return _marked(w + v - w * v)


def remainder(a: Any, b: Any) -> Any:
    """Python's and NumPy's %: the sign of b."""
    return a - apply("floor", apply("div", a, b)) * b
