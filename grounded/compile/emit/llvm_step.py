"""Writes one control step: the next state, and its sparse Jacobian, of W lanes at once.

The stages of Runge-Kutta are a loop around one copy of the model, so that the code stays small; so
is the Jacobian's chain rule around one column. Its stages are those of `traced.py`,

    K_i = f_x T_i + [0 f_u f_p],    T_i = I + c_i dt K_{i-1},    A = I + dt sum_i b_i K_i,

kept as the values of a pattern: the places that can be non-zero after any number of stages.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

from grounded.compile.emit.llvm_graph import DT, Body, Uniforms
from grounded.compile.emit.llvm_text import Writer, doubles, integers, number, splat
from grounded.compile.names import STAGES
from grounded.compile.trace.graph import Graph
from grounded.compile.trace.tracing import Trace

Place = tuple[int, int]  # row, column of a Jacobian
WIDEST = 8  # doubles in a vector
FLAT = 120  # operations of a model whose stages are written out: nothing waits for memory then
Rows = tuple[int, ...]
Group = tuple[Rows, list[int]]  # rows, and the columns that are non-zero in them


@dataclass(frozen=True, eq=False)
class Dynamics:
    """What the writers know of a model: graph, sizes, integrator, patterns."""

    graph: Graph
    outputs: tuple[int, ...]
    entries: dict[Place, int]  # non-zero derivatives of the outputs: node numbers
    n: int
    m: int
    stages: tuple[tuple[float, float], ...]  # empty: the function is the step itself

    @cached_property
    def uniforms(self) -> Uniforms:
        """Values that are the same for every sample."""
        return Uniforms(self.graph, [*self.outputs, *self.entries.values()])

    @cached_property
    def short(self) -> bool:
        """Whether a step is written out: its values wait for each other, not for room."""
        return bool(self.stages) and len(self.graph.live(self.outputs)) <= FLAT

    @cached_property
    def groups(self) -> list[Group]:
        """The pattern of K: columns that are non-zero in the same rows; they share their code."""
        pattern = set(self.entries)
        for _ in self.stages[1:]:
            rows: dict[int, set[int]] = {}
            for s, c in pattern:
                rows.setdefault(s, set()).add(c)
            pattern |= {(r, c) for r, s in self.entries if s < self.n for c in rows.get(s, ())}
        columns, alike = defaultdict[int, list[int]](list), defaultdict[Rows, list[int]](list)
        for r, c in sorted(pattern):
            columns[c].append(r)
        for c in sorted(columns):
            alike[tuple(columns[c])].append(c)
        return list(alike.items())

    @cached_property
    def rates(self) -> dict[Place, tuple[int, ...]]:
        """The places of K, group by group: for each, the s with f_x[r, s] K[s, c] to be summed."""
        return {
            (r, c): tuple(s for s in rows if (r, s) in self.entries)
            for rows, some in self.groups
            for c in some
            for r in rows
        }

    @cached_property
    def products(self) -> int:
        """Multiplications of the chain rule that are written out."""
        sums = sum(len(self.rates[r, some[0]]) for rows, some in self.groups for r in rows)
        return max(len(self.stages) - 1, 0) * sums

    @property
    def operations(self) -> int:
        """Operations that are written for a step, its Jacobian, and a sweep with it."""
        live = self.graph.live([*self.outputs, *self.entries.values()])
        pieces = -(-(self.n + self.m) // WIDEST)  # of a row
        return len(live) + self.products + 3 * pieces * len(self.places)

    @cached_property
    def places(self) -> list[Place]:
        """The pattern of the step's Jacobian, in the order of its values."""
        if not self.stages:
            return sorted(self.entries)
        diagonal = ((i, i) for i in range(self.n))
        return [*self.rates, *(at for at in diagonal if at not in self.rates)]

    def constant(self, place: int) -> bool:
        """Whether a place is always 1: of a state that no stage lets depend on itself."""
        return bool(self.stages) and place >= len(self.rates)


def dynamics_of(trace: Trace, width: int, kind: str, integrator: str) -> Dynamics:
    """The dynamics with derivatives for the first `width` of x, u, p."""
    entries = {(r, c): i for r, c, i in (trace.entries(width) if width else ())}
    stages = STAGES[integrator] if kind == "derivative" else ()
    return Dynamics(trace.graph, trace.outputs, entries, *trace.sizes[:2], stages)


class StepWriter:
    """Writes steps of W lanes into a function."""

    def __init__(self, f: Writer, d: Dynamics, width: int, table: str) -> None:
        self.f, self.d, self.width, self.table = f, d, width, table
        self.x = f.room(d.n * width)  # the state at the step's start, SoA: [n][W]
        self.u = f.room(d.m * width)
        self.next = f.room(d.n * width)
        self.k = f.room(d.n * width) if d.stages else ""

    def _body(self, state: Callable[[int], str]) -> Body:
        f, d, w = self.f, self.d, self.width

        def leaf(letter: str, index: int) -> str:
            if letter == "d":
                return f.load_all(self.table, DT, w)
            return state(index) if letter == "x" else f.load(self.u, index * w, w)

        return Body(f, w, d.graph, leaf, self.table, d.uniforms.slot)

    def step(self) -> list[str]:
        """From x and u to next, whose values are returned too."""
        f, d, w = self.f, self.d, self.width
        if not d.stages:
            following = self._body(lambda i: f.load(self.x, i * w, w)).values(d.outputs)
        elif d.short:
            following = self._flat()
        else:
            self._start()
            with f.loop(len(d.stages)) as stage:
                self._rates(stage)
            return self._finish()
        for i, value in enumerate(following):
            f.store(value, self.next, i * w, w)
        return following

    def _flat(self) -> list[str]:
        """The stages one after the other, the sums of `_rates` and `_finish` in registers."""
        f, d, w = self.f, self.d, self.width
        dt, x = f.load(self.table, DT), [f.load(self.x, i * w, w) for i in range(d.n)]
        now, k, total = x, list[str](), list[str]()
        for c, b in d.stages:
            if k:
                c_dt = f.spread(f.mul(dt, number(c)), w)
                now = [f.fma(c_dt, k, value, w) for k, value in zip(k, x, strict=True)]
            k = self._body(now.__getitem__).values(d.outputs)
            b_dt = f.spread(f.mul(dt, number(b)), w)
            total = [
                f.fma(b_dt, rate, total[i], w) if total else f.mul(b_dt, rate, w)
                for i, rate in enumerate(k)
            ]
        return [f.add(a, b, w) for a, b in zip(x, total, strict=True)]

    def _start(self) -> None:
        f, d, w = self.f, self.d, self.width
        zero = splat(0.0, w)
        for i in range(d.n):
            f.store(zero, self.next, i * w, w)
            f.store(zero, self.k, i * w, w)

    def _finish(self) -> list[str]:
        f, w, following = self.f, self.width, []
        for i in range(self.d.n):
            x = f.add(f.load(self.x, i * w, w), f.load(self.next, i * w, w), w)
            f.store(x, self.next, i * w, w)
            following.append(x)
        return following

    def _rates(self, stage: str) -> tuple[Body, str, str]:
        """One stage: k = f(x + c dt k), next += b dt k; next starts at zero. With c dt, b dt."""
        f, d, w = self.f, self.d, self.width
        dt = f.load(self.table, DT)
        c, b = (f.mul(dt, f.load(name, stage)) for name in ("@stage_c", "@stage_b"))
        c, b = f.spread(c, w), f.spread(b, w)
        states = [
            f.fma(c, f.load(self.k, i * w, w), f.load(self.x, i * w, w), w) for i in range(d.n)
        ]
        body = self._body(states.__getitem__)
        for i, value in enumerate(body.values(d.outputs)):
            f.store(value, self.k, i * w, w)
            f.store(f.fma(b, value, f.load(self.next, i * w, w), w), self.next, i * w, w)
        return body, c, b

    def jacobian(self, out: str) -> None:
        """From x and u to next, and the values of the Jacobian's places to out, [places][W]."""
        f, d, w = self.f, self.d, self.width
        if not d.stages:
            self.step()
            body = self._body(lambda i: f.load(self.x, i * w, w))
            for e, value in enumerate(body.values([d.entries[p] for p in d.places])):
                f.store(value, out, e * w, w)
            return
        self._start()
        self._stages(out)
        self._finish()
        for e in range(len(d.rates), len(d.places)):
            f.store(splat(1.0, w), out, e * w, w)

    def _stages(self, out: str) -> None:
        """The derivatives of every stage to memory, a zero after them; then the chain."""
        f, d, w = self.f, self.d, self.width
        size = (len(d.entries) + 1) * w
        kept = f.room(len(d.stages) * size)
        with f.loop(len(d.stages)) as stage:
            body, _, _ = self._rates(stage)
            to = f.at(kept, f.integer("mul", stage, size))
            for e, node in enumerate(d.entries.values()):
                f.store(body.value(node), to, e * w, w)
            f.store(splat(0.0, w), to, len(d.entries) * w, w)
        self._chain(kept, out)

    def _chain(self, kept: str, out: str) -> None:
        """K = f_x T + own and A += b dt K of all stages, one column of K after the other.

        What a column becomes depends on that column alone: it stays in registers.
        """
        f, first = self.f, 0
        for rows, some in self.d.groups:
            with f.loop(len(some)) as i:
                at = f.integer("add", first, f.integer("mul", i, len(rows)))
                self._column(kept, out, rows, some[0], at)
            first += len(rows) * len(some)

    def _column(self, kept: str, out: str, rows: Sequence[int], c: int, first: str) -> None:
        """A column of a group, of which `c` is one; `first` is its own first place."""
        f, d, w, dt = self.f, self.d, self.width, self.f.load(self.table, DT)
        size, place = (len(d.entries) + 1) * w, {at: e * w for e, at in enumerate(d.entries)}
        places = {r: f.integer("add", first, i) for i, r in enumerate(rows)}
        own = {r: f.integer("mul", f.index("@chain_own", e), w) for r, e in places.items()}
        total = {r: f.load_all("@chain_diagonal", e, w) for r, e in places.items()}
        before = dict[int, str]()  # K of the stage before
        for i, stage in enumerate(d.stages):
            at = f.at(kept, i * size)
            c_dt, b_dt = (f.spread(f.mul(dt, number(value)), w) for value in stage)
            scaled = {r: f.mul(c_dt, value, w) for r, value in before.items()}
            for r in rows:
                value = f.load(at, own[r], w)
                for s in d.rates[r, c] if i else ():
                    value = f.fma(f.load(at, place[r, s], w), scaled[s], value, w)
                before[r] = value
                total[r] = f.fma(b_dt, value, total[r], w)
        for r, e in places.items():
            f.store(total[r], out, f.integer("mul", e, w), w)


def stage_tables(d: Dynamics) -> str:
    """The stages' c and b as global constants, and of the places of K their own derivatives."""
    if not d.stages:
        return ""
    columns = {"stage_c": [c for c, _ in d.stages], "stage_b": [b for _, b in d.stages]}
    columns["chain_diagonal"] = [float(r == c) for r, c in d.rates]
    tables = "".join(doubles(name, values) for name, values in columns.items())
    own = {place: e for e, place in enumerate(d.entries)}
    return tables + integers("chain_own", [own.get(at, len(own)) for at in d.rates])


def jacobian_function(d: Dynamics, width: int) -> str:
    """`i64 @jacobian(xu, table, next, out)`: xu is [n + m][W], next [n][W], out [places][W]."""
    f = Writer("i64 @jacobian(ptr %xu, ptr %table, ptr %next, ptr %out)")
    writer = StepWriter(f, d, width, "%table")
    writer.x, writer.u, writer.next = "%xu", f.at("%xu", d.n * width), "%next"
    writer.jacobian("%out")
    f.do("ret i64 0")
    return f.text()
