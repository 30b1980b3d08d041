"""Exact derivatives of a graph, as nodes of the same graph: they share their work with the values.

Tangents are carried from the variables up,

    d op(a, b) = (d op / d a) d a + (d op / d b) d b,

so that a branch of a blend that is not taken is left out as a whole. Indicator terms have the
derivatives of their smoothed forms, which at eps = 0 are those of the branch that is taken. Where
an operation is infinitely steep, as the speed sqrt(vx^2 + vy^2) is at rest, its slope counts as
zero, which is one of its slopes there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from grounded.compile.trace.graph import Graph

Tangent = Mapping[int, int]  # variable -> node of the derivative; absent means zero
FLAT = ("floor", "rint", "trunc", "equal")  # their derivative is zero wherever there is one
Rule = Callable[[Graph, int, tuple[int, ...]], tuple[int, ...]]


def jacobian(
    graph: Graph, outputs: Sequence[int], variables: Sequence[int]
) -> list[dict[int, int]]:
    """For each output, the nodes of its non-zero derivatives by variables, leaves of the graph."""
    one = graph.const(1.0)
    tangents: dict[int, dict[int, int]] = {v: {v: one} for v in variables}
    for i in graph.live(outputs):
        if i not in tangents:
            tangents[i] = _tangent(graph, i, tangents)
    return [tangents[i] for i in outputs]


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
