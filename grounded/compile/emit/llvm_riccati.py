"""Kernel: linearise along a trajectory and sweep back, the compiled twin of `interpreted.sweep`.

Rows of the value's Hessian V are vectors. With the Jacobian [A B] sparse and the past inputs a
shift, the two products of Q = [A B]' V [A B] are the same routine twice,

    M = [A B]' V,   Q = [A B]' M'      row c of [A B]'X = sum over r of [A B](r, c) X(r, :)

with a transposition between (`llvm_product.py`). Rounding leaves V a little unsymmetric; where the
model is unstable that part grows from step to step, so it is taken out again and again.
"""

from __future__ import annotations

from grounded.compile.emit.llvm_batch import Words
from grounded.compile.emit.llvm_box import ONE, ZERO, Lower, clipped, factored, loaded, solved
from grounded.compile.emit.llvm_product import (
    Linearised,
    padded,
    pieces,
    pieces_of,
    placed,
    row_of,
    symmetric,
    transpose,
)
from grounded.compile.emit.llvm_rollout import wrap
from grounded.compile.emit.llvm_step import Dynamics
from grounded.compile.emit.llvm_text import Writer, number, splat
from grounded.compile.kernel_words import SWEEP, Layout


def sweep_kernel(d: Dynamics, layout: Layout, width: int) -> str:
    """`i64 @sweep(words)`: the step whose Q_uu was not positive definite, or -1."""
    f = Writer("i64 @sweep(ptr %words)")
    writer = _Sweep(f, d, layout, width)
    writer.end()
    with f.loop(writer.words.integer("H"), down=True) as t:
        with f.when(writer.along.begins(t)):
            writer.along.linearise(t)
            symmetric(f, writer.V, writer.P)
        writer.along.select(t)
        slopes = writer.product()
        writer.input_rows(t, slopes)
        writer.gains(t)
        writer.state_rows(t, slopes)
        writer.value()
    f.store(f.load(writer.sums, 0), writer.words.pointer("expected"), 0)
    f.store(f.load(writer.sums, 1), writer.words.pointer("expected"), 1)
    f.do("ret i64 -1")
    return f.text()


class _Sweep:
    """The parts of the kernel. P and C are the padded widths of a row over z and over [z, u]."""

    def __init__(self, f: Writer, d: Dynamics, layout: Layout, width: int) -> None:
        self.f, self.layout, self.width, self.words = f, layout, width, Words(f, SWEEP)
        m, nz = layout.m, layout.nz
        self.P, self.C = padded(nz, width), padded(nz + m, width)
        self.cut = pieces(self.P, width)
        self.along = Linearised(f, d, layout, width, self.words)
        self.V, self.v = f.room(self.P * self.P), f.room(self.P)
        self.M, self.T = f.room(self.C * self.P), f.room(self.P * self.C)
        self.U, self.G = f.room(m * self.C), f.room(m * self.C)  # rows of [Q_uz Q_uu], f_u'T
        self.g_u = f.room(m)
        self.H, self.L, self.inv = f.room(m * m), f.room(m * m), f.room(m)
        self.k, self.free, self.low, self.high = (f.room(m) for _ in range(4))
        self.K, self.F, self.sums = f.room(m * self.P), f.room(m * self.P), f.room(2)

    def end(self) -> None:
        """V and v of the last state; zeros in the padding."""
        f = self.f
        for room, size in ((self.V, self.P**2), (self.M, self.C * self.P), (self.v, self.P)):
            with f.loop(size // 4) as four:
                f.store(splat(0.0, 4), room, f.integer("mul", four, 4), 4)
        f.store(splat(0.0, 2), self.sums, 0, 2)
        for i, (slope, curvature) in enumerate(self._tracking(self.words.integer("H"))):
            f.store(slope, self.v, i)
            f.store(curvature, self.V, i * self.P + i)

    def _tracking(self, t: str) -> list[tuple[str, str]]:
        """(2 W e, 2 W) of each state at step t."""
        f, n = self.f, self.layout.n
        z, target = self.words.row("z_run", t, self.layout.nz), self.words.row("target", t, n)
        weight, out = self.words.row("weight", t, n), []
        for i in range(n):
            e = f.sub(f.load(z, i), f.load(target, i))
            e = wrap(f, e, 1) if self.layout.angles[i] else e
            once = f.load(weight, i)
            twice = f.add(once, once)
            out.append((f.mul(twice, e), twice))
        return out

    def product(self) -> list[str]:
        """V [A B], transposed into T; returns the products with v, z first and then u."""
        f, P = self.f, self.P
        for at, size in self.cut:
            row = pieces_of(f, self.V, P, at, size)
            G, inputs = self.along.inputs(row, size)
            for c, value in enumerate([*self.along.states(row, size, G), *inputs]):
                f.store(value, self.M, c * P + at, size)
        G, inputs = self.along.inputs(lambda r: f.load(self.v, r), 1)
        slopes = self.along.states(lambda r: f.load(self.v, r), 1, G) + inputs
        transpose(f, self.M, self.T, P, self.C, self.width)
        return slopes

    def input_rows(self, t: str, slopes: list[str]) -> None:
        """[Q_uz Q_uu] into U, Q_u into g_u: first, so that their factor is under way early."""
        f, layout, C = self.f, self.layout, self.C
        doubled = []
        for j in range(layout.m):
            S, R = (f.load(self.words.pointer(name), j) for name in ("S", "R"))
            doubled.append((f.add(S, S), f.add(R, R)))
        for at, size in pieces(C, self.width):
            G, rows = self.along.inputs(pieces_of(f, self.T, C, at, size), size)
            for j, row in enumerate(rows):
                S, R = doubled[j]
                for place, value in ((layout.slot(j), f.neg(S)), (layout.nz + j, f.add(R, S))):
                    if at <= place < at + size:
                        row = placed(f, value, place - at, row, size)
                f.store(G[j], self.G, j * C + at, size)
                f.store(row, self.U, j * C + at, size)
        before, u = self.words.row("z_run", t, layout.nz), self.words.row("u_run", t, layout.m)
        target = self.words.row("input_target", t, layout.m)
        for j, (S, R) in enumerate(doubled):
            value = f.load(u, j)
            slope = f.fma(R, f.sub(value, f.load(target, j)), slopes[layout.nz + j])
            slope = f.fma(S, f.sub(value, f.load(before, layout.slot(j))), slope)
            f.store(slope, self.g_u, j)

    def state_rows(self, t: str, slopes: list[str]) -> None:
        """Q_zz into V, Q_z into v."""
        f, P, C = self.f, self.P, self.C
        cost = self._state_cost(t)
        for at, size in self.cut:
            G = [f.load(self.G, j * C + at, size) for j in range(self.layout.m)]
            rows = self.along.states(pieces_of(f, self.T, C, at, size), size, G)
            for c, row in enumerate(rows):
                own = cost[c]
                if own and at <= c < at + size:
                    row = placed(f, own[1], c - at, row, size)
                f.store(row, self.V, c * P + at, size)
            here = zip(slopes[at : at + size], cost[at : at + size], strict=False)
            slope = [f.add(value, own[0]) if own else value for value, own in here]
            f.store(row_of(f, slope, size), self.v, at, size)

    def _state_cost(self, t: str) -> list[tuple[str, str] | None]:
        """(l_z, l_zz) for each entry of z, None where it has no cost."""
        f, layout = self.f, self.layout
        before, u = self.words.row("z_run", t, layout.nz), self.words.row("u_run", t, layout.m)
        cost: list[tuple[str, str] | None] = [*self._tracking(t)]
        for j, depth in enumerate(layout.depths):
            S = f.load(self.words.pointer("S"), j)
            twice = f.add(S, S)
            step = f.sub(f.load(before, layout.slot(j)), f.load(u, j))
            cost += [(f.mul(twice, step), twice), *[None] * (depth - 1)]
        return cost

    def gains(self, t: str) -> None:
        """Gains k and K of step t inside the limits; the promise d1, d2."""
        f, layout, C = self.f, self.layout, self.C
        m, nz = layout.m, layout.nz
        damping = [f.load(self.words.pointer("damping"), i) for i in range(m)]
        H = [[f.load(self.U, i * C + nz + j) for j in range(m)] for i in range(m)]
        for i in range(m):
            H[i][i] = f.add(H[i][i], damping[i])
        L, inverse, good = factored(f, H)
        g, infinity = [f.load(self.g_u, i) for i in range(m)], number(float("inf"))
        for value in g:
            finite = f.compare("olt", f.call("fabs", [value]), infinity)
            good = f.emit(f"and i1 {good}, {finite}")
        f.return_if(f.emit(f"xor i1 {good}, true"), f"i64 {t}")
        inverse = [f.neg(value) for value in inverse]  # of -H: k and K are minus a solution
        k = solved(f, g, L, inverse, 1)
        L, inverse, k = self._limited(t, H, (L, inverse, k))
        self._promise(k, g)
        self._feedback(t, L, inverse, k)

    def _limited(
        self, t: str, H: list[list[str]], usual: tuple[Lower, list[str], list[str]]
    ) -> tuple[Lower, list[str], list[str]]:
        """L, -1/D and k; of the box-limited programme where the unlimited k breaks a limit."""
        f, m, u = self.f, self.layout.m, self.words.row("u_run", t, self.layout.m)
        L, inverse, k = usual
        low, high = (
            [f.sub(f.load(self.words.pointer(name), i), f.load(u, i)) for i in range(m)]
            for name in ("low", "high")
        )
        broken = "false"
        for value, lowest, highest in zip(k, low, high, strict=True):
            outside = f.compare("une", clipped(f, value, lowest, highest), value)
            broken = f.emit(f"or i1 {broken}, {outside}")
        with f.unless([*L.values(), *inverse, *k], broken) as values:
            rooms = (self.k, k), (self.low, low), (self.high, high), (self.free, [ONE] * m)
            for room, row in (*rooms, (self.H, [value for line in H for value in line])):
                for i, value in enumerate(row):
                    f.store(value, room, i)
            values[:] = self._boxed()
        below, last = len(L), len(L) + m
        return dict(zip(L, values[:below], strict=True)), values[below:last], values[last:]

    def _boxed(self) -> list[str]:
        """The box-limited programme; clamped inputs get 0 for -1/D, and so no feedback."""
        f, m = self.f, self.layout.m
        f.do(
            f"call void @box(ptr {self.H}, ptr {self.g_u}, ptr {self.low}, ptr {self.high}, "
            f"ptr {self.k}, ptr {self.free}, ptr {self.L}, ptr {self.inv})"
        )
        f.emit(f"call i1 @factor(ptr {self.H}, ptr {self.free}, ptr {self.L}, ptr {self.inv})")
        L, inverse = loaded(f, m, self.L, self.inv)
        inverse = [f.mul(f.neg(value), f.load(self.free, i)) for i, value in enumerate(inverse)]
        return [*L.values(), *inverse, *(f.load(self.k, i) for i in range(m))]

    def _promise(self, k: list[str], g: list[str]) -> None:
        f, m, nz = self.f, self.layout.m, self.layout.nz
        d1, d2 = f.load(self.sums, 0), ZERO
        for i in range(m):
            d1 = f.fma(k[i], g[i], d1)
            row = f.mul(f.load(self.U, i * self.C + nz), k[0])
            for j in range(1, m):
                row = f.fma(f.load(self.U, i * self.C + nz + j), k[j], row)
            d2 = f.fma(k[i], row, d2)
        f.store(d1, self.sums, 0)
        f.store(f.fma(d2, number(0.5), f.load(self.sums, 1)), self.sums, 1)

    def _feedback(self, t: str, L: Lower, inverse: list[str], k: list[str]) -> None:
        """K = -Q_uu^-1 Q_uz on the free inputs, k and K to memory."""
        f, m, nz, P = self.f, self.layout.m, self.layout.nz, self.P
        for at, size in self.cut:
            Q_uz = [f.load(self.U, j * self.C + at, size) for j in range(m)]
            for j, row in enumerate(solved(f, Q_uz, L, inverse, size)):
                f.store(row, self.K, j * P + at, size)
        to_K, to_k = self.words.row("K", t, m * nz), self.words.row("k", t, m)
        for j in range(m):
            f.store(k[j], self.k, j)
            f.store(k[j], to_k, j)
            for i in range(0, nz - nz % 4, 4):
                f.store(f.load(self.K, j * P + i, 4), to_K, j * nz + i, 4)
            for i in range(nz - nz % 4, nz):
                f.store(f.load(self.K, j * P + i), to_K, j * nz + i)

    def value(self) -> None:
        """V = Q_zz + Q_uz'K - K'diag(damping)K, v = Q_z + Q_uz'k - K'diag(damping)k."""
        self._add(self.U, self.C, "fadd")
        f, m, P = self.f, self.layout.m, self.P
        damping = [f.load(self.words.pointer("damping"), j) for j in range(m)]
        damped = "false"
        for value in damping:
            damped = f.emit(f"or i1 {damped}, {f.compare('une', value, ZERO)}")
        with f.when(damped):
            for at, size in self.cut:
                for j in range(m):
                    row = f.mul(f.spread(damping[j], size), f.load(self.K, j * P + at, size), size)
                    f.store(row, self.F, j * P + at, size)
            self._add(self.F, P, "fsub")

    def _add(self, F: str, stride: int, op: str) -> None:
        """V += F'K, v += F'k, or -=, for rows F_j."""
        f, m, P = self.f, self.layout.m, self.P
        K = {(j, at): f.load(self.K, j * P + at, size) for j in range(m) for at, size in self.cut}
        for at, size in self.cut:
            v = f.load(self.v, at, size)
            for j in range(m):
                k = f.load_all(self.k, j, size)
                v = f.op(op, v, f.mul(k, f.load(F, j * stride + at, size), size), size)
            f.store(v, self.v, at, size)
        with f.loop(self.layout.nz) as c:
            start, column = f.at(self.V, f.integer("mul", c, P)), f.at(F, c)
            factors = [f.load_all(column, j * stride, self.cut[0][1]) for j in range(m)]
            for at, size in self.cut:
                row = f.load(start, at, size)
                for j, factor in enumerate(factors):
                    row = f.op(op, row, f.mul(factor, K[j, at], size), size)
                f.store(row, start, at, size)
