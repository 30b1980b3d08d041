"""Runs the user's function once on expressions and keeps the graph of what it computed.

An `if` on a parameter is decided by the parameter's value while tracing, and remembered: such a
trace holds only where the same decisions come out (`guards`), and another one is made where they
don't. An `if` on a state or an input can't be decided; the reason and its line become the note of
the slower path that is taken instead.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from grounded.checks import refused
from grounded.compile.names import Signature, check_names, raised_at, wrong_value
from grounded.compile.trace.derivative import jacobian
from grounded.compile.trace.expression import Expression, NotTraceable, node_of
from grounded.compile.trace.functions import rebound
from grounded.compile.trace.graph import MAX_NODES, Graph, TooLong, evaluated
from grounded.errors import GroundedError
from grounded.frozen import Array


@dataclass(frozen=True, eq=False)
class Trace:
    """The graph of a function: a node for each state, and the decisions it rests on."""

    graph: Graph
    outputs: tuple[int, ...]  # (n,)
    guards: tuple[tuple[int, bool], ...]
    sizes: tuple[int, int, int]  # n, m, k

    def holds(self, p: Array, dt: float) -> bool:
        """Whether the function would take the same branches with these parameters."""
        if not self.guards:
            return True
        found = evaluated(self.graph, [i for i, _ in self.guards], _uniform(p, dt))
        return all(bool(v) == outcome for v, (_, outcome) in zip(found, self.guards, strict=True))

    def _variables(self, width: int) -> list[int]:
        """The leaves of the first `width` of x, u, p."""
        letters = [(s, i) for s, size in zip("xup", self.sizes, strict=True) for i in range(size)]
        return [self.graph.leaf(*letter) for letter in letters[:width]]

    def entries(self, width: int) -> list[tuple[int, int, int]]:
        """(row, column, node) of the non-zero derivatives by the first `width` of x, u, p."""
        variables = self._variables(width)
        column = {v: c for c, v in enumerate(variables)}
        rows = jacobian(self.graph, self.outputs, variables)
        return sorted((r, column[v], i) for r, row in enumerate(rows) for v, i in row.items())

    @property
    def reads(self) -> NDArray[np.bool_]:
        """Which of x and u each output depends on, (n, n + m)."""
        leaves = np.array(self._variables(self.sizes[0] + self.sizes[1]))
        return np.array([np.isin(leaves, self.graph.live([output])) for output in self.outputs])


def trace(signature: Signature, p: Array | None, dt: float) -> Trace | str:
    """The trace, or why there is none, naming file and line.

    Parameter values p (k,) and dt decide an `if` on parameters; None: every `if` is taken.
    """
    graph, guards = Graph(MAX_NODES), []

    def oracle(i: int) -> bool:
        if graph.varies(i):
            raise NotTraceable("an `if` (or and, or, while) on a state or an input; use np.where")
        outcome = True if p is None else bool(evaluated(graph, [i], _uniform(p, dt))[0])
        guards.append((i, outcome))
        return outcome

    graph.oracle = oracle
    try:
        values = _call(signature, graph)
    except GroundedError:
        raise
    except TooLong as error:
        found = f"{raised_at(error, signature.function)}: it unrolls to {error} (a long loop?)"
        if signature.kind == "step":  # a simulator of one's own runs as it is
            return found
        raise refused("model.untraced", why=found, long=1) from None
    except NotTraceable as error:
        return f"{raised_at(error, signature.function)}: {error}"
    except Exception as error:  # the plain call will tell whether this is the user's mistake
        return f"{raised_at(error, signature.function)}: {type(error).__name__}: {error}"
    check_names(values, signature.states, signature.function)
    outputs = tuple(_output(graph, name, values[name], signature) for name in signature.states)
    return Trace(graph, outputs, tuple(guards), signature.sizes)


def _call(signature: Signature, graph: Graph) -> Mapping[str, Any]:
    def leaves(letter: str, count: int) -> list[Expression]:
        return [Expression(graph, graph.leaf(letter, i)) for i in range(count)]

    x, u, p = (leaves(letter, size) for letter, size in zip("xup", signature.sizes, strict=True))
    dt = Expression(graph, graph.leaf("d")) if signature.kind == "step" else None
    return replace(signature, function=rebound(signature.function)).call(x, u, p, dt)


def _output(graph: Graph, name: str, value: Any, signature: Signature) -> int:
    if getattr(value, "size", 1) == 1 and hasattr(value, "reshape"):
        value = value.reshape(-1)[0]
    try:
        return node_of(graph, value)
    except NotTraceable:
        raise wrong_value(name, value, signature.function) from None


def _uniform(p: Array, dt: float) -> dict[tuple[str, int], Any]:
    return {("d", 0): dt} | {("p", i): value for i, value in enumerate(p)}
