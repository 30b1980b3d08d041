"""Exact derivatives of a graph, as nodes of the same graph: they share their work with the values.

An edge from each node to each of its arguments carries the partial d op / d argument. By the chain
rule a node between the variables and the outputs can be eliminated: its products of an edge above
and one below become edges past it,

    d c / d a  +=  (d c / d b) (d b / d a).

In whatever order they go, what is left are the derivatives; the order decides how many products it
takes. Least first (Markowitz, 1957) is about half of what tangents (from the variables up) or
adjoints (from the outputs down) take. Where a graph blends branches, tangents are carried upwards,
d op(a, b) = (d op / d a) d a + (d op / d b) d b, so that a branch that is not taken is left out as
a whole. Indicator terms have the derivatives of their smoothed
forms, which at eps = 0 are those of the branch that is taken. Where an operation is infinitely
steep, as the speed sqrt(vx^2 + vy^2) is at rest, its slope counts as zero, which is one of its
slopes there.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from heapq import heapify, heappop, heappush

from grounded.compile.trace.graph import Graph

Tangent = Mapping[int, int]  # variable -> node of the derivative; absent means zero
FLAT = ("floor", "rint", "trunc", "equal")  # their derivative is zero wherever there is one
Rule = Callable[[Graph, int, tuple[int, ...]], tuple[int, ...]]


def jacobian(
    graph: Graph, outputs: Sequence[int], variables: Sequence[int]
) -> list[dict[int, int]]:
    """Derivatives d outputs / d variables: for each output, the nodes of its non-zero derivatives.

    Args:
        graph: grows by the derivatives' nodes.
        outputs: node numbers.
        variables: node numbers of leaves.
    """
    if any(graph.nodes[i].op == "blend" for i in graph.live(outputs)):
        return carried(graph, outputs, variables)
    return _Elimination(graph, outputs, variables).run()


def carried(graph: Graph, outputs: Sequence[int], variables: Sequence[int]) -> list[dict[int, int]]:
    """The same by tangents, from the variables up."""
    one = graph.const(1.0)
    tangents: dict[int, dict[int, int]] = {v: {v: one} for v in variables}
    for i in graph.live(outputs):
        if i not in tangents:
            tangents[i] = _tangent(graph, i, tangents)
    return [tangents[i] for i in outputs]


class _Elimination:
    """Edges that carry partials, to each node from below; above an output is -1, -2, ... for it."""

    def __init__(self, graph: Graph, outputs: Sequence[int], variables: Sequence[int]) -> None:
        self.graph, self.ends = graph, [-1 - place for place in range(len(outputs))]
        self.below = defaultdict[int, dict[int, int]](dict)  # node -> argument -> partial
        self.above = defaultdict[int, set[int]](set)
        # by node: how many edges to below and from above it have a weight of 0, 1 and 2
        self.lower = defaultdict[int, list[int]](lambda: [0, 0, 0])
        self.upper = defaultdict[int, list[int]](lambda: [0, 0, 0])
        moving = set(variables)
        for i in graph.live(outputs):
            node = graph.nodes[i]
            if i in moving or node.op in FLAT or moving.isdisjoint(node.args):
                continue
            moving.add(i)
            partials = RULES[node.op](graph, i, node.args)
            for argument, partial in zip(node.args, partials, strict=True):
                if argument in moving:
                    self._add(i, argument, partial)
        for end, i in zip(self.ends, outputs, strict=True):
            if i in moving:
                self._add(end, i, graph.const(1.0))
        self.inside = sorted(moving.difference(variables))

    def run(self) -> list[dict[int, int]]:
        """Eliminates the nodes between, the cheapest first."""
        costs = {i: self._cost(i) for i in self.inside}
        heap = [(cost, i) for i, cost in costs.items()]
        heapify(heap)
        while heap:
            cost, i = heappop(heap)
            if costs.get(i) != cost:  # it was eliminated, or its cost has changed since
                continue
            del costs[i]
            for other in self._eliminate(i) & costs.keys():
                if costs[other] != (cost := self._cost(other)):
                    costs[other] = cost
                    heappush(heap, (cost, other))
        constant = self.graph.constant
        lines = (sorted(self.below[end].items()) for end in self.ends)
        return [{v: d for v, d in line if constant(d) != 0.0} for line in lines]

    def _add(self, i: int, argument: int, partial: int) -> None:
        if self.graph.constant(partial) == 0.0:
            return
        known = self.below[i].get(argument)
        if known is not None:
            self._count(i, argument, known, -1)
            partial = self.graph.node("add", known, partial)
        self._count(i, argument, partial, 1)
        self.below[i][argument] = partial
        self.above[argument].add(i)

    def _count(self, i: int, argument: int, partial: int, by: int) -> None:
        weight = self._weight(partial)
        self.lower[i][weight] += by
        self.upper[argument][weight] += by

    def _cost(self, i: int) -> int:
        """Products that take the place of a node: 2 each, 1 where a factor is the same everywhere.

        Those with plus or minus 1, and of two factors that are the same everywhere, are free.
        """
        (_, low, lows), (_, up, ups) = self.lower[i], self.upper[i]
        return 2 * lows * ups + lows * up + low * ups

    def _weight(self, partial: int) -> int:
        """0 for plus or minus 1, 1 for a number that is the same in every sample, else 2."""
        if self.graph.constant(partial) in (1.0, -1.0):
            return 0
        return 2 if self.graph.varies(partial) else 1

    def _eliminate(self, i: int) -> set[int]:
        """Leads the edges of a node past it; returns its neighbours."""
        lower, upper = self.below.pop(i, {}), self.above.pop(i, set())
        for j in sorted(upper):
            partial = self.below[j].pop(i)
            self._count(j, i, partial, -1)
            for argument, d in lower.items():
                self._add(j, argument, self.graph.node("mul", partial, d))
        for argument, d in lower.items():
            self._count(i, argument, d, -1)
            self.above[argument].discard(i)
        return upper.union(lower)


def _tangent(graph: Graph, i: int, tangents: Mapping[int, Tangent]) -> dict[int, int]:
    node = graph.nodes[i]
    moving = [a for a in node.args if tangents[a]]
    if not moving or node.op in FLAT:
        return {}
    if node.op == "blend":
        return _blend(graph, node.args, tangents)
    partials = RULES[node.op](graph, i, node.args)
    result: dict[int, int] = {}
    for argument, partial in zip(node.args, partials, strict=True):
        for variable, d in tangents[argument].items():
            term = graph.node("mul", partial, d)
            if graph.constant(term) == 0.0:
                continue
            known = result.get(variable)
            result[variable] = term if known is None else graph.node("add", known, term)
    return {v: d for v, d in result.items() if graph.constant(d) != 0.0}


def _blend(graph: Graph, args: tuple[int, ...], tangents: Mapping[int, Tangent]) -> dict[int, int]:
    """blend(w, da, db) + (a - b) dw, where a NaN of the branch not taken stays where it is."""
    w, a, b = args
    zero, difference = graph.const(0.0), graph.node("sub", a, b)
    result: dict[int, int] = {}
    for variable in {**tangents[w], **tangents[a], **tangents[b]}:
        da, db = tangents[a].get(variable, zero), tangents[b].get(variable, zero)
        d = graph.node("blend", w, da, db)
        if variable in tangents[w]:
            d = graph.node("add", d, graph.node("gate", tangents[w][variable], difference))
        if graph.constant(d) != 0.0:
            result[variable] = d
    return result


def _reciprocal(g: Graph, i: int) -> int:
    return g.node("div", g.const(1.0), i)


def _div(g: Graph, i: int, args: tuple[int, ...]) -> tuple[int, ...]:
    inverse = _reciprocal(g, args[1])
    return inverse, g.node("neg", g.node("mul", i, inverse))


def _finite(g: Graph, i: int) -> int:
    """A slope, 0 where it is not finite."""
    return g.node("gate", g.const(1.0), i)


def _pow(g: Graph, i: int, args: tuple[int, ...]) -> tuple[int, ...]:
    x, e = args
    lower = g.node("pow", x, g.node("sub", e, g.const(1.0)))
    by_base = _finite(g, g.node("mul", e, lower))
    if g.constant(e) is not None:
        return by_base, g.const(0.0)
    return by_base, _finite(g, g.node("mul", i, g.node("log", x)))


def _atan2(g: Graph, i: int, args: tuple[int, ...]) -> tuple[int, ...]:
    y, x = args
    square = g.node("add", g.node("mul", x, x), g.node("mul", y, y))
    inverse = _reciprocal(g, square)
    by_y, by_x = g.node("mul", x, inverse), g.node("neg", g.node("mul", y, inverse))
    return _finite(g, by_y), _finite(g, by_x)


def _asin(g: Graph, i: int, args: tuple[int, ...]) -> tuple[int, ...]:
    rest = g.node("sub", g.const(1.0), g.node("mul", args[0], args[0]))
    return (_finite(g, _reciprocal(g, g.node("sqrt", rest))),)


def _atan(g: Graph, i: int, args: tuple[int, ...]) -> tuple[int, ...]:
    return (_reciprocal(g, g.node("add", g.const(1.0), g.node("mul", args[0], args[0]))),)


def _above(g: Graph, i: int, args: tuple[int, ...]) -> tuple[int, ...]:
    slope = g.node("slope", i)
    return slope, g.node("neg", slope)


def _max(g: Graph, i: int, args: tuple[int, ...]) -> tuple[int, ...]:
    share = g.node("side", *args)
    return share, g.node("sub", g.const(1.0), share)


def _cbrt(g: Graph, i: int, args: tuple[int, ...]) -> tuple[int, ...]:
    return (_finite(g, _reciprocal(g, g.node("mul", g.const(3.0), g.node("mul", i, i)))),)


RULES: dict[str, Rule] = {
    "add": lambda g, i, a: (g.const(1.0), g.const(1.0)),
    "sub": lambda g, i, a: (g.const(1.0), g.const(-1.0)),
    "mul": lambda g, i, a: (a[1], a[0]),
    "div": _div,
    "neg": lambda g, i, a: (g.const(-1.0),),
    "pow": _pow,
    "sqrt": lambda g, i, a: (_finite(g, g.node("div", g.const(0.5), i)),),
    "cbrt": _cbrt,
    "exp": lambda g, i, a: (i,),
    "expm1": lambda g, i, a: (g.node("add", i, g.const(1.0)),),
    "log": lambda g, i, a: (_reciprocal(g, a[0]),),
    "log1p": lambda g, i, a: (_reciprocal(g, g.node("add", g.const(1.0), a[0])),),
    "sin": lambda g, i, a: (g.node("cos", a[0]),),
    "cos": lambda g, i, a: (g.node("neg", g.node("sin", a[0])),),
    "tan": lambda g, i, a: (g.node("add", g.const(1.0), g.node("mul", i, i)),),
    "asin": _asin,
    "acos": lambda g, i, a: (g.node("neg", _asin(g, i, a)[0]),),
    "atan": _atan,
    "atan2": _atan2,
    "sinh": lambda g, i, a: (g.node("cosh", a[0]),),
    "cosh": lambda g, i, a: (g.node("sinh", a[0]),),
    "tanh": lambda g, i, a: (g.node("sub", g.const(1.0), g.node("mul", i, i)),),
    "above": _above,
    "abs": lambda g, i, a: (g.node("sign", a[0]),),
    "sign": lambda g, i, a: (g.node("bend", a[0]),),
    "max": _max,
}
