"""Exact derivatives of a graph on numbers: forward mode, where `derivative` writes them out.

The same chain rule and the same partials d op / d a, each a node of the graph. But the tangents
d node / d variables are arrays, one row a variable, and no nodes: what is run is about as long as
the graph itself, however many variables there are. Written out, the derivatives of a model with a
few adopted effects by all its parameters are a hundred thousand operations.

A tangent has rows for the variables that its node depends on and for no others, so that a partial
that is not finite (the root of 0) reaches nothing that it doesn't belong to.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from grounded.compile.trace.derivative import FLAT, RULES
from grounded.compile.trace.graph import NUMPY, Graph, Program
from grounded.frozen import Array

PARTIALS = 8  # nodes that one node's partials take at the most


@dataclass(frozen=True)
class _Term:
    """partial times the tangent of `argument`, and the rows that it fills."""

    argument: int
    partial: int | None  # place among the values; None: 1
    rows: slice | list[int]


@dataclass(frozen=True)
class _Blend:
    """blend(w, da, db) + (a - b) dw: places of w and a - b; rows that each tangent fills."""

    weight: int
    difference: int
    terms: tuple[_Term | None, _Term | None, _Term | None]  # of w, a, b


class Tangents:
    """Outputs of a graph and their Jacobian by some of its leaves, for many samples at once.

    Args:
        graph: grows by the partials.
        outputs: node numbers.
        variables: node numbers of leaves.
    """

    def __init__(self, graph: Graph, outputs: Sequence[int], variables: Sequence[int]) -> None:
        self._variables, self._outputs = list(variables), list(outputs)
        self._columns = {v: [c] for c, v in enumerate(variables)}
        self._needed: dict[int, int] = {}  # node -> place among the values
        self._steps: list[tuple[int, list[_Term] | _Blend]] = []
        live = graph.live(outputs)
        graph.limit = max(graph.limit, len(graph.nodes) + PARTIALS * len(live))
        for i in live:
            node = graph.nodes[i]
            moving = {c for a in node.args for c in self._columns.get(a, ())}
            if i not in self._columns and moving and node.op not in FLAT:
                self._columns[i] = sorted(moving)
                self._steps.append((i, self._step(graph, i)))
        self._last = self._uses()
        for output in self._outputs:
            self._place(output)
        self._program = Program(graph, list(self._needed))

    def __call__(
        self, leaves: Mapping[tuple[str, int], Any], eps: float, samples: int
    ) -> tuple[Array, Array]:
        """Values (samples, r) and Jacobian (samples, r, width)."""
        values = self._program(leaves, eps)
        tangents: dict[int, Array] = {v: np.ones((1, 1)) for v in self._variables}
        with np.errstate(all="ignore"):
            for (i, step), done in zip(self._steps, self._last, strict=True):
                rows = len(self._columns[i])
                if isinstance(step, _Blend):
                    tangents[i] = _blended(step, rows, values, tangents, eps)
                else:
                    tangents[i] = _summed(step, rows, values, tangents)
                for argument in done:
                    del tangents[argument]
        J = np.zeros((samples, len(self._outputs), len(self._variables)))
        found = np.empty((samples, len(self._outputs)))
        for r, i in enumerate(self._outputs):
            found[:, r] = values[self._needed[i]]
            if i in tangents:
                J[:, r, self._columns[i]] = tangents[i].T
        return found, J

    def _place(self, node: int) -> int:
        return self._needed.setdefault(node, len(self._needed))

    def _step(self, graph: Graph, i: int) -> list[_Term] | _Blend:
        node = graph.nodes[i]
        if node.op == "blend":
            w, a, b = node.args
            difference = self._place(graph.node("sub", a, b))
            terms = (self._term(i, w, None), self._term(i, a, None), self._term(i, b, None))
            return _Blend(self._place(w), difference, terms)
        terms_of: list[_Term | None] = []
        for argument, partial in zip(node.args, RULES[node.op](graph, i, node.args), strict=True):
            if argument in self._columns and graph.constant(partial) != 0.0:
                one = graph.constant(partial) == 1.0
                terms_of.append(self._term(i, argument, None if one else self._place(partial)))
        return [term for term in terms_of if term is not None]

    def _term(self, i: int, argument: int, partial: int | None) -> _Term | None:
        """None for an argument that depends on no variable."""
        if argument not in self._columns:
            return None
        own, all_of_them = self._columns[argument], self._columns[i]
        if own == all_of_them:
            return _Term(argument, partial, slice(None))
        rows = [all_of_them.index(c) for c in own]
        beside = all(later - row == 1 for row, later in pairwise(rows))
        return _Term(argument, partial, slice(rows[0], rows[-1] + 1) if beside else rows)

    def _uses(self) -> list[list[int]]:
        """After each step, the nodes whose tangents nobody needs any more."""
        seen = set(self._outputs)
        last: list[list[int]] = []
        for _, step in reversed(self._steps):
            terms = step.terms if isinstance(step, _Blend) else step
            done = {term.argument for term in terms if term is not None} - seen
            seen |= done
            last.append(sorted(done))
        return last[::-1]


def _spread(term: _Term, rows: int, tangent: Array) -> Array:
    """A tangent among `rows` rows, zero elsewhere."""
    if term.rows == slice(None):
        return tangent
    whole = np.zeros((rows, tangent.shape[1]))
    whole[term.rows] = tangent
    return whole


def _summed(
    terms: Sequence[_Term], rows: int, values: Sequence[Any], tangents: Mapping[int, Array]
) -> Array:
    products = []
    for term in terms:
        d = tangents[term.argument]
        products.append((term, d if term.partial is None else values[term.partial] * d))
    if all(term.rows == slice(None) for term, _ in products):
        return np.asarray(sum(d for _, d in products)) if products else np.zeros((rows, 1))
    total = np.zeros((rows, max(d.shape[1] for _, d in products)))
    for term, d in products:
        total[term.rows] += d
    return total


def _blended(
    step: _Blend, rows: int, values: Sequence[Any], tangents: Mapping[int, Array], eps: float
) -> Array:
    of_w, *sides = step.terms
    da, db = (
        np.zeros((rows, 1)) if term is None else _spread(term, rows, tangents[term.argument])
        for term in sides
    )
    d = np.asarray(NUMPY["blend"](eps, values[step.weight], da, db))
    if of_w is None:
        return d
    more = NUMPY["gate"](eps, tangents[of_w.argument], values[step.difference])
    return np.asarray(d + _spread(of_w, rows, more))
