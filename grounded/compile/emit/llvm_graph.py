"""Writes a graph's nodes as instructions on W lanes.

Nodes that depend on parameters and the time step alone are `uniform`: the same for every sample of
a call. They are computed once a call by @uniforms into a table, and loops only read the few of
them that other nodes use.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

from grounded.compile.emit.llvm_math import Lanes
from grounded.compile.emit.llvm_text import Writer
from grounded.compile.trace.graph import SATURATED, Graph

EPS, INVERSE, DT, FIRST = 0, 1, 2, 3  # slots of the table: eps, 1/eps or 0, dt, then nodes


class Uniforms:
    """The table of uniform values that a set of outputs needs."""

    def __init__(self, graph: Graph, outputs: Sequence[int]) -> None:
        self.graph = graph
        varying = [graph.nodes[i] for i in graph.live(outputs) if graph.varies(i)]
        used = {a for node in varying for a in node.args}.union(outputs)  # or wanted themselves
        uniform = (i for i in sorted(used) if not graph.varies(i))
        read = [i for i in uniform if graph.nodes[i].op != "const"]
        self.slot = {i: FIRST + place for place, i in enumerate(read)}

    @property
    def size(self) -> int:
        """Doubles in the table."""
        return FIRST + len(self.slot)

    def function(self) -> str:
        """`void @uniforms(p, dt, eps, table)`, to be run at the start of a kernel."""
        f = Writer("internal void @uniforms(ptr %p, double %dt, double %eps, ptr %table)")
        inverse = f.div("0x3FF0000000000000", "%eps")
        sharp = f.compare("oeq", "%eps", "0x0000000000000000")
        f.store("%eps", "%table", EPS)
        f.store(f.select(sharp, "0x0000000000000000", inverse), "%table", INVERSE)
        f.store("%dt", "%table", DT)

        def leaf(letter: str, index: int) -> str:
            return "%dt" if letter == "d" else f.load("%p", index)

        body = Body(f, 1, self.graph, leaf, "%table", {})
        for i, slot in self.slot.items():
            f.store(body.value(i), "%table", slot)
        f.do("ret void")
        return f.text()


class Body:
    """Nodes written once each, in one place of one function."""

    def __init__(
        self,
        f: Writer,
        width: int,
        graph: Graph,
        leaf: Callable[[str, int], str],
        table: str,
        slots: Mapping[int, int],
    ) -> None:
        self.f, self.width, self.graph, self.leaf = f, width, graph, leaf
        self.table, self.slots = table, slots
        self.lanes = Lanes(f, width)
        self._known: dict[int, str] = {}
        self._settings: dict[int, str] = {}
        self._exact = False  # whether the node that is being written is never smoothed

    def values(self, outputs: Sequence[int]) -> list[str]:
        """Value names of outputs."""
        stack, wanted = list(outputs), set[int]()
        while stack:  # what is not written yet and outputs need
            i = stack.pop()
            if i not in wanted and i not in self._known:
                wanted.add(i)
                if i not in self.slots:
                    stack.extend(self.graph.nodes[i].args)
        for i in sorted(wanted):
            self._known[i] = self._written(i)
        return [self._known[i] for i in outputs]

    def value(self, i: int) -> str:
        """One value."""
        return self.values([i])[0]

    def _written(self, i: int) -> str:
        node, f, w = self.graph.nodes[i], self.f, self.width
        if i in self.slots:
            return f.load_all(self.table, self.slots[i], w)
        if node.op == "const":
            return self.lanes.const(node.value)
        if node.leaf is not None:
            return self.leaf(*node.leaf)
        args = [self._known[a] for a in node.args]
        self._exact = not self.graph.varies(i)
        if node.op in PLAIN:
            return f.op(PLAIN[node.op], args[0], args[1], w)
        if node.op in INTRINSIC:
            return f.call(INTRINSIC[node.op], args, w)
        return (
            WRITTEN[node.op](self, *args)
            if node.op in WRITTEN
            else self.lanes.library(node.op, *args)
        )

    def setting(self, slot: int) -> str:
        """An entry eps or 1/eps of the table in every lane; 0 for what is never smoothed."""
        if self._exact:
            return self.const(0.0)
        if slot not in self._settings:
            self._settings[slot] = self.f.load_all(self.table, slot, self.width)
        return self._settings[slot]

    # Indicator terms; see `graph.py` for what they mean.

    def pick(self, how: str, a: str, b: str, yes: str, no: str) -> str:
        """`yes` where a compares so to b."""
        return self.f.select(self.f.compare(how, a, b, self.width), yes, no, self.width)

    def const(self, value: float) -> str:
        """A constant in every lane."""
        return self.lanes.const(value)

    def sharp(self, exact: str, soft: str) -> str:
        """`exact` where eps = 0 or the soft value is not finite."""
        f, w = self.f, self.width
        size = f.call("fabs", [soft], w)
        kept = self.pick("olt", size, self.const(math.inf), soft, exact)
        return self.pick("oeq", self.setting(EPS), self.const(0.0), exact, kept)

    def root(self, x: str) -> str:
        """sqrt(x^2 + eps^2)."""
        f, w, eps = self.f, self.width, self.setting(EPS)
        return f.call("sqrt", [f.fma(x, x, f.mul(eps, eps, w), w)], w)

    def above(self, left: str, r: str) -> str:
        """Weight of l > r."""
        f, w, one, zero = self.f, self.width, self.const(1.0), self.const(0.0)
        exact = self.pick("ogt", left, r, one, zero)
        d = f.mul(f.sub(left, r, w), self.setting(INVERSE), w)
        limit, below = self.const(SATURATED), self.const(-SATURATED)
        near = self.pick("ogt", d, limit, limit, self.pick("olt", d, below, below, d))
        soft = f.div(one, f.add(one, self.lanes.exp_within(f.neg(near, w)), w), w)
        soft = self.pick("olt", d, below, zero, soft)
        soft = self.pick("uno", d, d, exact, soft)
        return self.pick("oeq", self.setting(EPS), zero, exact, soft)

    def equal(self, left: str, r: str) -> str:
        """1 where equal."""
        return self.pick("oeq", left, r, self.const(1.0), self.const(0.0))

    def blend(self, weight: str, a: str, b: str) -> str:
        """Weighted mean; the heavier branch where the mean is not finite."""
        f, w = self.f, self.width
        rest = f.sub(self.const(1.0), weight, w)
        mixed = f.fma(weight, a, f.mul(rest, b, w), w)
        pure = self.pick("oge", weight, self.const(0.5), a, b)
        mixed = self.pick("olt", f.call("fabs", [mixed], w), self.const(math.inf), mixed, pure)
        mixed = self.pick("ogt", weight, self.const(0.0), mixed, pure)
        return self.pick("olt", weight, self.const(1.0), mixed, pure)

    def absolute(self, x: str) -> str:
        """Smoothed absolute value."""
        return self.root(x)  # at eps = 0 the root of the square, which is exact

    def sign(self, x: str) -> str:
        """Smoothed sign."""
        zero = self.const(0.0)
        negative = self.pick("olt", x, zero, self.const(-1.0), x)
        exact = self.pick("ogt", x, zero, self.const(1.0), negative)
        return self.sharp(exact, self.f.div(x, self.root(x), self.width))

    def bend(self, x: str) -> str:
        """Derivative of the smoothed sign."""
        f, w, eps = self.f, self.width, self.setting(EPS)
        root = self.root(x)
        cube = f.mul(f.mul(root, root, w), root, w)
        return self.sharp(self.const(0.0), f.div(f.mul(eps, eps, w), cube, w))

    def maximum(self, a: str, b: str) -> str:
        """Smoothed maximum."""
        f, w = self.f, self.width
        total = f.add(f.add(a, b, w), self.root(f.sub(a, b, w)), w)
        return self.sharp(self.pick("ogt", a, b, a, b), f.mul(total, self.const(0.5), w))

    def side(self, a: str, b: str) -> str:
        """Share of a in the maximum."""
        f, w, one = self.f, self.width, self.const(1.0)
        d = f.sub(a, b, w)
        exact = self.pick(
            "ogt", a, b, one, self.pick("olt", a, b, self.const(0.0), self.const(0.5))
        )
        soft = f.add(one, f.div(d, self.root(d), w), w)
        return self.sharp(exact, f.mul(soft, self.const(0.5), w))

    def slope(self, weight: str) -> str:
        """Derivative of the weight `above`."""
        f, w = self.f, self.width
        rest = f.sub(self.const(1.0), weight, w)
        return f.mul(f.mul(weight, rest, w), self.setting(INVERSE), w)

    def gate(self, x: str, y: str) -> str:
        """The product, 0 where x is 0 or it is not finite."""
        f, w, zero = self.f, self.width, self.const(0.0)
        product = f.mul(x, y, w)
        finite = self.pick("olt", f.call("fabs", [product], w), self.const(math.inf), product, zero)
        return self.pick("oeq", x, zero, zero, finite)

    def tan(self, x: str) -> str:
        """Sine over cosine."""
        sine, cosine = self.lanes.sincos(x)
        return self.f.div(sine, cosine, self.width)


PLAIN = {"add": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv"}
INTRINSIC = {"sqrt": "sqrt", "floor": "floor", "rint": "rint", "trunc": "trunc"}
WRITTEN: dict[str, Callable[..., str]] = {
    "neg": lambda b, x: b.f.neg(x, b.width),
    "sin": lambda b, x: b.lanes.sincos(x)[0],
    "cos": lambda b, x: b.lanes.sincos(x)[1],
    "tan": Body.tan,
    "exp": lambda b, x: b.lanes.exp(x),
    "tanh": lambda b, x: b.lanes.tanh(x),
    "atan2": lambda b, y, x: b.lanes.atan2(y, x),
    "atan": lambda b, x: b.lanes.atan2(x, b.const(1.0)),
    "asin": lambda b, x: b.lanes.asin(x),
    "acos": lambda b, x: b.lanes.acos(x),
    "above": Body.above,
    "equal": Body.equal,
    "blend": Body.blend,
    "abs": Body.absolute,
    "sign": Body.sign,
    "max": Body.maximum,
    "side": Body.side,
    "bend": Body.bend,
    "slope": Body.slope,
    "gate": Body.gate,
}
