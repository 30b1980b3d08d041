"""An expression graph: what a user's function computes, each value once.

Nodes are numbers; a node's arguments are smaller than itself, so counting up is a topological
order. The same operation on the same arguments is the same node (common subexpressions are shared),
operations on constants are done at once, and what can't change a value (x + 0, 1 x) is dropped.

    const(value)           in(letter, index)   letter x, u, p, d (dt)           op(arguments)

Indicator terms are smoothed by a width eps known only when the graph runs; eps = 0 means exactly
the branch that the user wrote:

    above(l, r)      1 where l > r, else 0          logistic((l - r) / eps)
    blend(w, a, b)   a where w = 1, b where w = 0    w a + (1 - w) b
    abs(x)           |x|                             sqrt(x^2 + eps^2)
    max(a, b)        the larger                      (a + b + sqrt((a - b)^2 + eps^2)) / 2
    sign(x)          -1, 0, 1                        x / sqrt(x^2 + eps^2)

What depends on no state and no input is no corner on the way, and is never smoothed: a guard like
max(tau, 1e-6) of a parameter keeps tau as it is.

A condition is a weight in [0, 1], so that "and", "or", "not" are w v, w + v - w v and 1 - w.
A NaN or infinity on a branch that is not taken never reaches the result. The last operations
(`slope`, `side`, `bend`, `gate`) only occur in derivatives.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

SATURATED = 40.0  # logistic(40) = 1 to the last bit

# Operations that are a NumPy function and no more, by their names there.
PLAIN = {
    **{name: name for name in ("sqrt", "cbrt", "exp", "expm1", "log", "log1p", "sin", "cos")},
    **{name: name for name in ("tan", "sinh", "cosh", "tanh", "floor", "rint", "trunc")},
    **{"add": "add", "sub": "subtract", "mul": "multiply", "div": "divide", "neg": "negative"},
    **{"pow": "power", "asin": "arcsin", "acos": "arccos", "atan": "arctan", "atan2": "arctan2"},
}


def _gated(x: Any, y: Any) -> Any:
    """The product, and 0 where x is 0 or the product is not finite."""
    return np.where((x != 0.0) & np.isfinite(x * y), x * y, 0.0)


NUMPY: dict[str, Callable[..., Any]] = {  # at eps = 0
    **{op: getattr(np, name) for op, name in PLAIN.items()},
    "above": lambda left, r: np.where(left > r, 1.0, 0.0),
    "equal": lambda left, r: np.where(left == r, 1.0, 0.0),
    "blend": lambda w, a, b: np.where(w >= 0.5, a, b),
    "abs": np.abs,
    "sign": np.sign,
    "max": lambda a, b: np.where(a > b, a, b),
    "side": lambda a, b: 0.5 * (1.0 + np.sign(a - b)),
    "bend": np.zeros_like,
    "slope": np.zeros_like,
    "gate": _gated,
}

MAX_NODES = 50_000


class TooLong(Exception):
    """The function unrolls to more operations than can be compiled."""


@dataclass(frozen=True)
class Node:
    """One value: its operation, its arguments (node numbers), and for a leaf what it is."""

    op: str
    args: tuple[int, ...] = ()
    leaf: tuple[str, int] | None = None  # of an "in": letter and index
    value: float = 0.0  # of a "const"


class Graph:
    """A growing graph; `node(op, a, b)` returns the number of a value."""

    def __init__(self, limit: int = MAX_NODES) -> None:
        self.nodes: list[Node] = []
        self.limit = limit
        self.conditions: set[int] = set()  # nodes that are weights in [0, 1]
        self.oracle: Callable[[int], bool] | None = None  # answers an `if` while tracing
        self.letters: list[frozenset[str]] = []  # of the leaves that each node depends on
        self._known: dict[Node | tuple[str, str], int] = {}

    def const(self, value: float) -> int:
        """A number."""
        value = float(value)
        return self._add(Node("const", value=value), ("const", value.hex()))

    def leaf(self, letter: str, index: int = 0) -> int:
        """An input: x, u, p by index, d for dt."""
        node = Node("in", leaf=(letter, index))
        return self._add(node, node)

    def node(self, op: str, *args: int) -> int:
        """An operation on nodes, simplified."""
        simple = self._simplified(op, args)
        if simple is not None:
            return simple
        node = Node(op, args)
        return self._add(node, node)

    def _add(self, node: Node, key: Node | tuple[str, str]) -> int:
        known = self._known.get(key)
        if known is not None:
            return known
        if len(self.nodes) >= self.limit:
            raise TooLong(f"more than {self.limit:,} operations")
        own = frozenset(node.leaf[0] if node.leaf else ())
        self.letters.append(own.union(*(self.letters[a] for a in node.args)))
        self.nodes.append(node)
        self._known[key] = len(self.nodes) - 1
        return len(self.nodes) - 1

    def varies(self, i: int, letters: str = "xu") -> bool:
        """Whether a node depends on a state or an input."""
        return not self.letters[i].isdisjoint(letters)

    def constant(self, i: int) -> float | None:
        """The value of a constant node, None for any other."""
        node = self.nodes[i]
        return node.value if node.op == "const" else None

    def _simplified(self, op: str, args: tuple[int, ...]) -> int | None:
        values = [self.constant(i) for i in args]
        if all(v is not None for v in values):
            with np.errstate(all="ignore"):
                result = float(NUMPY[op](*(np.float64(v) for v in values if v is not None)))
            return self.const(result)
        rule = _RULES.get(op)
        return None if rule is None else rule(self, args, values)

    def live(self, outputs: Iterable[int]) -> list[int]:
        """The nodes that outputs need, in order."""
        needed: set[int] = set()
        stack = list(outputs)
        while stack:
            i = stack.pop()
            if i not in needed:
                needed.add(i)
                stack.extend(self.nodes[i].args)
        return sorted(needed)

    def digest(self, outputs: Sequence[int]) -> str:
        """A hash of what outputs compute, the same in every process."""
        number: dict[int, int] = {}
        text = hashlib.sha256()
        for new, i in enumerate(self.live(outputs)):
            number[i] = new
            node = self.nodes[i]
            args = ",".join(str(number[a]) for a in node.args)
            text.update(f"{node.op}({args}){node.leaf}{node.value.hex()};".encode())
        text.update(",".join(str(number[i]) for i in outputs).encode())
        return text.hexdigest()


def evaluated(
    graph: Graph, outputs: Sequence[int], leaves: Mapping[tuple[str, int], Any]
) -> list[Any]:
    """Values of outputs at eps = 0, by NumPy."""
    values: dict[int, Any] = {}
    with np.errstate(all="ignore"):
        for i in graph.live(outputs):
            node = graph.nodes[i]
            if node.leaf is not None:
                values[i] = np.float64(leaves[node.leaf])
            elif node.op == "const":
                values[i] = np.float64(node.value)
            else:
                values[i] = NUMPY[node.op](*(values[a] for a in node.args))
    return [values[i] for i in outputs]


def _add(g: Graph, args: tuple[int, ...], v: list[float | None]) -> int | None:
    if v[0] == 0.0:
        return args[1]
    if v[1] == 0.0:
        return args[0]
    if g.nodes[args[1]].op == "neg":
        return g.node("sub", args[0], g.nodes[args[1]].args[0])
    if g.nodes[args[0]].op == "neg":
        return g.node("sub", args[1], g.nodes[args[0]].args[0])
    return g.node("add", args[1], args[0]) if args[0] > args[1] else None


def _sub(g: Graph, args: tuple[int, ...], v: list[float | None]) -> int | None:
    if v[0] == 0.0:
        return g.node("neg", args[1])
    if v[1] == 0.0:
        return args[0]
    if g.nodes[args[1]].op == "neg":
        return g.node("add", args[0], g.nodes[args[1]].args[0])
    return None


def _mul(g: Graph, args: tuple[int, ...], v: list[float | None]) -> int | None:
    for this, other in ((0, 1), (1, 0)):
        if v[this] == 0.0:
            return g.const(0.0)
        if v[this] == 1.0:
            return args[other]
        if v[this] == -1.0:
            return g.node("neg", args[other])
        if g.nodes[args[this]].op == "neg":
            return g.node("neg", g.node("mul", g.nodes[args[this]].args[0], args[other]))
    return g.node("mul", args[1], args[0]) if args[0] > args[1] else None


def _div(g: Graph, args: tuple[int, ...], v: list[float | None]) -> int | None:
    if v[1] == 1.0:
        return args[0]
    if v[0] == 0.0 and v[1] is None:
        return g.const(0.0)
    if g.varies(args[0]) and not g.varies(args[1]):  # one division a call, not one a sample
        return g.node("mul", args[0], g.node("div", g.const(1.0), args[1]))
    return None


def _neg(g: Graph, args: tuple[int, ...], v: list[float | None]) -> int | None:
    inner = g.nodes[args[0]]
    return inner.args[0] if inner.op == "neg" else None


def _pow(g: Graph, args: tuple[int, ...], v: list[float | None]) -> int | None:
    base, e = args[0], v[1]
    if e == 0.5:
        return g.node("sqrt", base)
    if e is None or not abs(e) <= 16 or e != int(e):
        return None
    power = int(abs(e))
    result, square = g.const(1.0), base
    while power:
        if power & 1:
            result = g.node("mul", result, square)
        power >>= 1
        if power:
            square = g.node("mul", square, square)
    return g.node("div", g.const(1.0), result) if e < 0 else result


def _blend(g: Graph, args: tuple[int, ...], v: list[float | None]) -> int | None:
    if args[1] == args[2] or v[0] == 1.0:
        return args[1]
    return args[2] if v[0] == 0.0 else None


def _max(g: Graph, args: tuple[int, ...], v: list[float | None]) -> int | None:
    for this, other in ((0, 1), (1, 0)):
        if v[this] == -np.inf:
            return args[other]
    return None


def _gate(g: Graph, args: tuple[int, ...], v: list[float | None]) -> int | None:
    return g.const(0.0) if 0.0 in v else None


_RULES = {
    "add": _add,
    "sub": _sub,
    "mul": _mul,
    "div": _div,
    "neg": _neg,
    "pow": _pow,
    "blend": _blend,
    "max": _max,
    "gate": _gate,
}
