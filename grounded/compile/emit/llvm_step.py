"""Writes one control step: the next state, and its sparse Jacobian, of W lanes at once.

The stages of Runge-Kutta are a loop around one copy of the model, so that the code stays small. The
Jacobian's stages are those of `traced.py`,

    K_i = f_x T_i + [0 f_u f_p],    T_i = I + c_i dt K_{i-1},    A = I + dt sum_i b_i K_i,

kept as the values of a pattern: the places that can be non-zero after any number of stages.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

from grounded.compile.emit.llvm_graph import DT, Body, Uniforms
from grounded.compile.emit.llvm_text import Writer, doubles, integers, number, splat
from grounded.compile.problem import STAGES
from grounded.compile.trace.graph import Graph
from grounded.compile.trace.tracing import Variant

Place = tuple[int, int]  # row, column of a Jacobian
FLAT = 120  # operations of a model whose stages are written out: nothing waits for memory then
UNROLLED = 2000  # products of the chain rule that are written out; more are a loop over indices


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
    def rates(self) -> dict[Place, tuple[int, ...]]:
        """The pattern of K: for each place, the s with f_x[r, s] K[s, c] to be summed."""
        pattern = set(self.entries)
        for _ in self.stages[1:]:
            rows: dict[int, set[int]] = {}
            for s, c in pattern:
                rows.setdefault(s, set()).add(c)
            pattern |= {(r, c) for r, s in self.entries if s < self.n for c in rows.get(s, ())}
        return {
            (r, c): tuple(s for s in range(self.n) if (r, s) in self.entries and (s, c) in pattern)
            for (r, c) in sorted(pattern)
        }

    @cached_property
    def products(self) -> int:
        """Multiplications in a stage of the chain rule."""
        return sum(len(sums) for sums in self.rates.values()) if len(self.stages) > 1 else 0

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


def dynamics_of(
    variant: Variant, n: int, m: int, width: int, kind: str, integrator: str
) -> Dynamics:
    """The dynamics with derivatives for the first `width` of x, u, p."""
    entries = {(r, c): i for r, c, i in variant.entries(width)}
    stages = STAGES[integrator] if kind == "derivative" else ()
    return Dynamics(variant.trace.graph, variant.trace.outputs, entries, n, m, stages)


class StepWriter:
    """Writes steps of W lanes into a function."""

    def __init__(self, f: Writer, d: Dynamics, width: int, table: str) -> None:
        self.f, self.d, self.width, self.table = f, d, width, table
        self.x = f.room(d.n * width)  # the state at the step's start, SoA: [n][W]
        self.u = f.room(d.m * width)
        self.next = f.room(d.n * width)
        self.k = f.room(d.n * width) if d.stages else ""
        self.held: dict[int, str] = {}  # values of the inputs alone, the same in every stage

    def _body(self, state: Callable[[int], str]) -> Body:
        f, d, w = self.f, self.d, self.width

        def leaf(letter: str, index: int) -> str:
            if letter == "d":
                return f.load_all(self.table, DT, w)
            return state(index) if letter == "x" else f.load(self.u, index * w, w)

        return Body(f, w, d.graph, leaf, self.table, d.uniforms.slot, self.held)

    def step(self) -> list[str]:
        """From x and u to next, whose values are returned too."""
        f, d, w = self.f, self.d, self.width
        if not d.stages:
            following = self._body(lambda i: f.load(self.x, i * w, w)).values(d.outputs)
        elif len(d.graph.live(d.outputs)) <= FLAT:
            following = self._flat()
        else:
            self._start(d.outputs)
            with f.loop(len(d.stages)) as stage:
                self._rates(stage)
            return self._finish()
        for i, value in enumerate(following):
            f.store(value, self.next, i * w, w)
        return following

    def _flat(self) -> list[str]:
        """The stages one after the other, the sums of `_rates` and `_finish` in registers."""
        f, d, w = self.f, self.d, self.width
        self._hold(d.outputs)
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

    def _hold(self, outputs: Sequence[int]) -> None:
        held = self.d.uniforms.held(outputs)
        self.held = {}
        self.held = dict(zip(held, self._body(lambda i: "").values(held), strict=True))

    def _start(self, outputs: Sequence[int]) -> None:
        f, d, w = self.f, self.d, self.width
        self._hold(outputs)
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
        looped, size = d.products > UNROLLED, len(d.rates) * w
        rates = f.room((2 if looped else 1) * size)  # K of the stage, and of the one before
        self._start([*d.outputs, *d.entries.values()])
        if looped:
            self._begin_loops(rates, out)
        with f.loop(len(d.stages)) as stage:
            body, c_dt, b_dt = self._rates(stage)
            if looped:
                odd = f.integer("and", stage, 1)
                old = f.at(rates, f.integer("mul", odd, size))
                new = f.at(rates, f.integer("mul", f.integer("xor", odd, 1), size))
                self._looped_chain(body, (c_dt, b_dt), (old, new), out)
            else:
                self._chain(body, (c_dt, b_dt), stage, rates, out)
        self._finish()
        for e in range(len(d.rates), len(d.places)):
            f.store(splat(1.0, w), out, e * w, w)

    def _begin_loops(self, rates: str, out: str) -> None:
        """No K yet, and A = I."""
        f, d, w = self.f, self.d, self.width
        if d.rates:  # a loop runs at least once: not for rates that depend on nothing
            with f.loop(len(d.rates)) as rate:
                at = f.integer("mul", rate, w)
                f.store(splat(0.0, w), rates, at, w)
                f.store(f.load_all("@chain_diagonal", rate, w), out, at, w)

    def _chain(self, body: Body, steps: tuple[str, str], stage: str, rates: str, out: str) -> None:
        """K = f_x T + own takes the place of the K before, some columns at a time; A += b dt K.

        What a column becomes depends on that column alone. Two at once share what is read of f_x.
        """
        f, d, w = self.f, self.d, self.width
        c_dt, b_dt = steps
        own = dict(zip(d.entries, body.values(list(d.entries.values())), strict=True))
        slot = {at: e * w for e, at in enumerate(d.rates)}
        read = {s for _, s in d.entries}  # rows of K that another stage needs
        with f.when(f.emit(f"icmp eq i64 {stage}, 0")):  # nothing to chain with yet
            for (r, c), e in slot.items():
                value = own.get((r, c), splat(0.0, w))
                if r in read:
                    f.store(value, rates, e, w)
                f.store(f.fma(b_dt, value, splat(float(r == c), w), w), out, e, w)
        if len(d.stages) == 1:
            return
        with f.when(f.emit(f"icmp ne i64 {stage}, 0")):
            scaled = f.room(len(own) * w)
            for e, ((_, c), value) in enumerate(own.items()):
                if c < d.n:
                    f.store(f.mul(c_dt, value, w), scaled, e * w, w)
            place = {at: e * w for e, at in enumerate(own)}
            columns = _columns(d)
            for first in range(0, len(columns), 2):
                some = columns[first : first + 2]
                before = {at: f.load(rates, slot[at], w) for c in some for at in c if at[0] in read}
                factors: dict[Place, str] = {}
                for at in sorted(at for column in some for at in column):
                    value, row = own.get(at, ""), [(at[0], s) for s in d.rates[at]]
                    factors |= {to: f.load(scaled, place[to], w) for to in row if to not in factors}
                    for to in row:
                        term = factors[to], before[to[1], at[1]]
                        value = f.fma(*term, value, w) if value else f.mul(*term, w)
                    if at[0] in read:
                        f.store(value, rates, slot[at], w)
                    f.store(f.fma(b_dt, value, f.load(out, slot[at], w), w), out, slot[at], w)

    def _looped_chain(
        self, body: Body, steps: tuple[str, str], buffers: tuple[str, str], out: str
    ) -> None:
        """The same sums for large models: small code that runs through tables of indices."""
        f, d, w = self.f, self.d, self.width
        (c_dt, b_dt), (old, new) = steps, buffers
        own = f.room((len(d.entries) + 1) * w)  # the last is zero
        for e, value in enumerate(body.values(list(d.entries.values()))):
            f.store(value, own, e * w, w)
        f.store(splat(0.0, w), own, len(d.entries) * w, w)
        with f.loop(len(d.rates)) as rate:
            first = f.index("@chain_first", rate)
            count = f.integer("sub", f.index("@chain_first", f.integer("add", rate, 1)), first)
            with f.fold(count, w, splat(0.0, w)) as total:
                q = f.integer("add", first, total.i)
                left = f.integer("mul", f.index("@chain_left", q), w)
                right = f.integer("mul", f.index("@chain_right", q), w)
                total.set(f.fma(f.load(own, left, w), f.load(old, right, w), total.value, w))
            mine = f.load(own, f.integer("mul", f.index("@chain_own", rate), w), w)
            value, at = f.fma(c_dt, total.result, mine, w), f.integer("mul", rate, w)
            f.store(value, new, at, w)
            f.store(f.fma(b_dt, value, f.load(out, at, w), w), out, at, w)


def _columns(d: Dynamics) -> list[list[Place]]:
    """Places column by column: what a column of K becomes depends on that column alone."""
    columns: dict[int, list[Place]] = {}
    for r, c in d.rates:
        columns.setdefault(c, []).append((r, c))
    return list(columns.values())


def _chain_tables(d: Dynamics) -> str:
    """For `_looped_chain`: sums of products by index, at least one a place."""
    own = {place: e for e, place in enumerate(d.entries)}
    slot = {place: e for e, place in enumerate(d.rates)}
    first, left, right = [0], list[int](), list[int]()
    for (r, c), sums in d.rates.items():
        left += [own[r, s] for s in sums] or [len(own)]
        right += [slot[s, c] for s in sums] or [0]
        first.append(len(left))
    return (
        integers("chain_own", [own.get(at, len(own)) for at in d.rates])
        + integers("chain_first", first)
        + integers("chain_left", left)
        + integers("chain_right", right)
    )


def stage_tables(d: Dynamics) -> str:
    """The stages' c and b as global constants, and the chain's indices where it is a loop."""
    if not d.stages:
        return ""
    columns = {"stage_c": [c for c, _ in d.stages], "stage_b": [b for _, b in d.stages]}
    columns["chain_diagonal"] = [float(r == c) for r, c in d.rates]
    tables = "".join(doubles(name, values) for name, values in columns.items())
    return tables + (_chain_tables(d) if d.products > UNROLLED else "")


def jacobian_function(d: Dynamics, width: int) -> str:
    """`i64 @jacobian(xu, table, next, out)`: xu is [n + m][W], next [n][W], out [places][W]."""
    f = Writer("i64 @jacobian(ptr %xu, ptr %table, ptr %next, ptr %out)")
    writer = StepWriter(f, d, width, "%table")
    writer.x, writer.u, writer.next = "%xu", f.at("%xu", d.n * width), "%next"
    writer.jacobian("%out")
    f.do("ret i64 0")
    return f.text()
