"""Kernel: linearise along a trajectory and sweep back, the compiled twin of `interpreted.sweep`.

Rows of the value's Hessian V are vectors. With the Jacobian [A B] sparse and the past inputs a
shift, the two products of Q = [A B]' V [A B] are the same routine twice,

    M = [A B]' V,   Q = [A B]' M'      row c of [A B]'X = sum over r of [A B](r, c) X(r, :)

with a transposition between (`Linearised`): over the non-zero places (r, c) of the model's Jacobian
for a state, the same with the delay's weights and a shifted row for a past input. So only what is
not zero costs anything, and every operation is on whole rows. The model's Jacobian is computed for
W steps at once, just before the sweep needs them. A past input that is only there for the cost of
changes has no column in [A B], and in Q only that cost. Q_uu comes first: while its factor waits
for one division after the other, the machine has Q_zz to add up. Rounding leaves V a little
unsymmetric; where the model is unstable that part grows from step to step, so it is taken out again
and again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence, Set

from grounded.compile.emit.llvm_batch import Words, gather_rows, start_table
from grounded.compile.emit.llvm_box import ONE, ZERO, Lower, clipped, factored, loaded, solved
from grounded.compile.emit.llvm_rollout import received, wrap
from grounded.compile.emit.llvm_step import Dynamics
from grounded.compile.emit.llvm_text import Writer, number, splat, transposed, vector
from grounded.compile.kernel_words import SWEEP, Layout

Row = Callable[[int], list[str]]  # row r of a matrix, or some of its pieces: vectors


def pieces(size: int, width: int) -> range:
    """Where the vectors of a row begin that is padded to whole ones.

    A vector that begins in one cache line and ends in the next costs two accesses.
    """
    return range(0, -(-size // width) * width, width)


def pieces_of(f: Writer, base: str, stride: int, cut: Sequence[int], size: int) -> Row:
    """Loads vectors of `size` doubles of a matrix's rows, from where each of `cut` says."""
    return lambda r: [f.load(base, r * stride + at, size) for at in cut]


def chosen(f: Writer, row: list[str], places: list[int | None], size: int) -> str:
    """Entries of a row in pieces, by their places, as one vector; 0 for None."""
    used = sorted({place // size for place in places if place is not None})
    if not used:
        return splat(0.0, size)
    first, last = row[used[0]], row[used[-1]]
    kind, inside = vector(size), []
    for place in places:
        lane = "poison" if place is None else str(place % size + size * (place // size > used[0]))
        inside.append(f"i32 {lane}")
    lanes = ", ".join(inside)
    same = all(p is None or p == used[0] * size + i for i, p in enumerate(places))
    found = (
        first
        if same
        else f.emit(f"shufflevector {kind} {first}, {kind} {last}, <{size} x i32> <{lanes}>")
    )
    if None not in places:
        return found
    kept = ", ".join(f"i32 {i + size * (place is None)}" for i, place in enumerate(places))
    return f.emit(f"shufflevector {kind} {found}, {kind} zeroinitializer, <{size} x i32> <{kept}>")


def symmetric(f: Writer, V: str, P: int) -> None:
    """V (P, P) becomes (V + V') / 2, in blocks of four by four."""
    half = splat(0.5, 4)
    with f.loop(P // 4) as i, f.loop(f.integer("add", i, 1)) as j:
        first, second = f.integer("mul", i, 4), f.integer("mul", j, 4)
        below = f.at(V, f.integer("add", f.integer("mul", first, P), second))
        above = f.at(V, f.integer("add", f.integer("mul", second, P), first))
        mirrored = transposed(f, [f.load(above, r * P, 4) for r in range(4)])
        mean = [
            f.mul(f.add(f.load(below, r * P, 4), row, 4), half, 4) for r, row in enumerate(mirrored)
        ]
        for r, row in enumerate(mean):
            f.store(row, below, r * P, 4)
        for r, row in enumerate(transposed(f, mean)):
            f.store(row, above, r * P, 4)


def placed(f: Writer, value: str, lane: int, row: str, size: int) -> str:
    """A row with `value` added in one lane."""
    unit = ", ".join(f"double {number(float(i == lane))}" for i in range(size))
    return f.fma(f.spread(value, size), f"<{unit}>", row, size)


def row_of(f: Writer, values: list[str], size: int) -> str:
    """Numbers as a vector, zeros after them."""
    row = "zeroinitializer"
    for i, value in enumerate(values):
        row = f.emit(f"insertelement {vector(size)} {row}, double {value}, i64 {i}")
    return row


class Linearised:
    """The Jacobian along a trajectory, W steps of it at a time."""

    def __init__(self, f: Writer, d: Dynamics, layout: Layout, width: int, words: Words) -> None:
        self.f, self.d, self.layout, self.width, self.words = f, d, layout, width, words
        n, m, nz = layout.n, layout.m, layout.nz
        self.table = start_table(f, words, d)
        self.soa = f.room((nz + m) * width)  # [z, u] of W steps
        self.shift = f.room(m * width)  # of the received inputs
        self.xu, self.following = f.room((n + m) * width), f.room(n * width)
        self.jac = f.room(len(d.places) * width)
        self.now = ""

    def begins(self, t: str) -> str:
        """Whether t is the last step of a block, whose Jacobians are not there yet."""
        f = self.f
        last = f.compare_integers("eq", t, f.integer("sub", self.words.integer("H"), 1))
        edge = f.integer("and", t, self.width - 1)
        return f.any(last, f.compare_integers("eq", edge, self.width - 1))

    def linearise(self, t: str) -> None:
        """The Jacobians of the W steps of the block of t."""
        f, layout, w = self.f, self.layout, self.width
        first, H = f.integer("and", t, -w), self.words.integer("H")
        u_soa = f.at(self.soa, layout.nz * w)
        z_run, u_run = self.words.pointer("z_run"), self.words.pointer("u_run")
        shift = (self.words.pointer("shift"), layout.m, self.shift)
        rows = [(z_run, layout.nz, self.soa), (u_run, layout.m, u_soa), shift]
        gather_rows(f, rows, first, H, w)
        z = [f.load(self.soa, i * w, w) for i in range(layout.nz)]
        u = [f.load(u_soa, j * w, w) for j in range(layout.m)]
        sent = received(f, self.words, layout, z, u, w)
        sent = [f.sub(v, f.load(self.shift, j * w, w), w) for j, v in enumerate(sent)]
        for i, value in enumerate([*z[: layout.n], *sent]):
            f.store(value, self.xu, i * w, w)
        f.do(
            f"call i64 {self.words.pointer('jacobian')}(ptr {self.xu}, ptr {self.table}, "
            f"ptr {self.following}, ptr {self.jac})"
        )

    def select(self, t: str) -> None:
        """From here on `rows` means those of step t."""
        self.now = self.f.at(self.jac, self.f.integer("and", t, self.width - 1))

    def columns(self, row: Row, size: int, some: Sequence[int]) -> list[list[str]]:
        """Rows c of [A B]'X for some of the c, below nz a moving entry of z, nz + j for u_j.

        Args:
            row: pieces of X(r, :), vectors of `size` doubles.
            size: see `row`.
            some: the c.
        """
        layout, own = self.layout, list[int]()
        for c in some:
            j = c - layout.nz if c >= layout.nz else layout.input_of(c) if c >= layout.n else 0
            own.append(c if c < layout.n else layout.n + j)
        sums = self._sums(row, size, set(own))
        return [self._column(c, sums[i], row, size) for c, i in zip(some, own, strict=True)]

    def _column(self, c: int, own: list[str], row: Row, size: int) -> list[str]:
        """What column c of [A B] is made of the model's own one."""
        f, layout = self.f, self.layout
        if c < layout.n:
            return own
        if c >= layout.nz:
            j = c - layout.nz
            if not layout.prompt[j]:
                now = f.load_all(self.words.pointer("now"), j, size)
                own = [f.mul(now, a, size) for a in own]
            return [f.add(a, b, size) for a, b in zip(own, row(layout.slot(j)), strict=True)]
        j, D = layout.input_of(c), layout.nz - layout.n
        weight = f.load_all(self.words.pointer("past"), j * D + c - layout.n, size)
        own = [f.mul(weight, a, size) for a in own]
        if c + 1 == layout.nz or layout.input_of(c + 1) != j:  # the oldest
            return own
        return [f.add(a, b, size) for a, b in zip(own, row(c + 1), strict=True)]

    def _sums(self, row: Row, size: int, columns: Set[int]) -> dict[int, list[str]]:
        """For some columns c of the model's Jacobian, the sums over r of J(r, c) X(r, :)."""
        f, d = self.f, self.d
        sums, known = dict[int, list[str]](), dict[int, list[str]]()
        for e, (r, c) in enumerate(d.places):
            if c not in columns:
                continue
            known[r] = values = known[r] if r in known else row(r)
            if d.constant(e):
                sums[c] = (
                    [f.add(a, b, size) for a, b in zip(values, sums[c], strict=True)]
                    if c in sums
                    else values
                )
                continue
            a = f.load_all(self.now, e * self.width, size)
            if c in sums:
                sums[c] = [f.fma(a, x, b, size) for x, b in zip(values, sums[c], strict=True)]
            else:
                sums[c] = [f.mul(a, x, size) for x in values]
        nothing = [splat(0.0, size)] * len(row(0))
        return {c: sums.get(c, nothing) for c in columns}


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
        writer.factor(t)
        writer.state_rows(t)
        writer.gains(t)
        writer.value(t, slopes)
    f.store(f.load(writer.sums, 0), writer.words.pointer("expected"), 0)
    f.store(f.load(writer.sums, 1), writer.words.pointer("expected"), 1)
    f.do("ret i64 -1")
    return f.text()


class _Sweep:
    """The parts of the kernel.

    P and C are the padded widths of a row over z and over [the moving entries of z, u], both in
    vectors of `size` doubles.
    """

    def __init__(self, f: Writer, d: Dynamics, layout: Layout, width: int) -> None:
        self.f, self.layout, self.words = f, layout, Words(f, SWEEP)
        m, nz, self.moving = layout.m, layout.nz, layout.moving
        self.size = size = width if nz > 4 else 4
        self.cut, self.wide = pieces(nz, size), pieces(len(self.moving) + m, size)
        self.P, self.C = size * len(self.cut), size * len(self.wide)
        self.along = Linearised(f, d, layout, width, self.words)
        self.V, self.v = f.room(self.P * self.P), f.room(self.P)
        self.T, self.U = f.room(self.P * self.C), f.room(m * self.C)  # V [A B]; rows of B'T
        self.F = f.room(m * self.P)  # rows of Q_uz
        self.g_u, self.Q_uu = f.room(m), list[list[str]]()
        self.H, self.L, self.inv = f.room(m * m), f.room(m * m), f.room(m)
        self.k, self.free, self.low, self.high = (f.room(m) for _ in range(4))
        self.K, self.sums = f.room(m * self.P), f.room(2)

    def end(self) -> None:
        """V and v of the last state; zeros in the padding."""
        f = self.f
        for room, size in ((self.V, self.P**2), (self.v, self.P)):
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
        """V [A B] into T; returns the products with v, moving entries of z first and then u."""
        f, layout, size = self.f, self.layout, self.size
        order = [*self.moving, *range(layout.nz, layout.nz + layout.m)]
        slopes = list[str]()

        for some in self._grouped(self.cut):
            row = pieces_of(f, self.V, self.P, some, size)
            with_v, both = (lambda r, row=row: [*row(r), f.load_all(self.v, r, size)]), not slopes
            for first, block in self._blocks(order):
                found = self.along.columns(with_v if both else row, size, block)
                if both:
                    slopes += [self._first_lane(line[-1]) for line in found]
                found += [[splat(0.0, size)] * len(some)] * (-len(found) % size)
                for i, at in enumerate(some):
                    self._turned([line[i] for line in found], at, first)
        return slopes

    def _first_lane(self, value: str) -> str:
        """One number of a vector of equal ones; through memory, or LLVM would redo it alone."""
        room = self.f.room(self.size)
        self.f.store(value, room, 0, self.size)
        return self.f.load(room)

    def _turned(self, rows: list[str], at: int, first: int) -> None:
        """Columns of rows first .. of M, a piece that begins `at`, as rows of T."""
        size, C = self.size, self.C
        for begin in range(0, len(rows), size):
            for i, column in enumerate(transposed(self.f, rows[begin : begin + size])):
                if at + i < self.layout.nz:
                    self.f.store(column, self.T, (at + i) * C + first + begin, size)

    def _grouped(self, cut: Sequence[int]) -> list[Sequence[int]]:
        """Pieces that share what is read of the Jacobian."""
        return [cut[i : i + 2] for i in range(0, len(cut), 2)]

    def _blocks(self, columns: list[int]) -> list[tuple[int, list[int]]]:
        """Columns that are summed up at once, as registers allow, after the place of the first."""
        return [(i, columns[i : i + self.size]) for i in range(0, len(columns), self.size)]

    def _over_z(self, row: list[str], at: int) -> str:
        """Entries at .. of a row over z, from a row over the moving entries; 0 for the others."""
        place = {i: c for c, i in enumerate(self.moving)}
        lanes = [place.get(i) for i in range(at, at + self.size)]
        return chosen(self.f, row, lanes, self.size)

    def input_rows(self, t: str, slopes: list[str]) -> None:
        """Rows of Q_uz into F, Q_uu, Q_u into g_u."""
        f, layout, size = self.f, self.layout, self.size
        rows: list[list[str]] = [[] for _ in range(layout.m)]
        own = range(layout.nz, layout.nz + layout.m)
        for some in self._grouped(self.wide):
            B = self.along.columns(pieces_of(f, self.T, self.C, some, size), size, own)
            for j, line in enumerate(B):
                rows[j] += line
                for at, piece in zip(some, line, strict=True):
                    f.store(piece, self.U, j * self.C + at, size)
        before, u = self.words.row("z_run", t, layout.nz), self.words.row("u_run", t, layout.m)
        target = self.words.row("input_target", t, layout.m)
        first, self.Q_uu = len(self.moving), []
        for j, whole in enumerate(rows):
            S, R = (f.load(self.words.pointer(name), j) for name in ("S", "R"))
            S, R, slot = f.add(S, S), f.add(R, R), layout.slot(j)
            for at in self.cut:
                row = self._over_z(whole, at)
                if at <= slot < at + size:
                    row = placed(f, f.neg(S), slot - at, row, size)
                f.store(row, self.F, j * self.P + at, size)
            line = [f.load(self.U, j * self.C + first + i) for i in range(layout.m)]
            line[j] = f.add(line[j], f.add(R, S))
            self.Q_uu.append(line)
            value = f.load(u, j)
            slope = f.fma(R, f.sub(value, f.load(target, j)), slopes[first + j])
            slope = f.fma(S, f.sub(value, f.load(before, slot)), slope)
            f.store(slope, self.g_u, j)

    def state_rows(self, t: str) -> None:
        """Q_zz into V."""
        f, size, cost = self.f, self.size, self._state_cost(t)
        rows: dict[int, list[str]] = {c: [] for c in range(self.layout.nz)}
        for some in self._grouped(self.cut):
            row = pieces_of(f, self.T, self.C, some, size)
            for _, block in self._blocks(self.moving):
                for c, line in zip(block, self.along.columns(row, size, block), strict=True):
                    rows[c] += line
            for c, own in enumerate(cost):
                for at in some:
                    piece = self._over_z(rows[c], at) if rows[c] else splat(0.0, size)
                    if own and at <= c < at + size:
                        piece = placed(f, own[1], c - at, piece, size)
                    f.store(piece, self.V, c * self.P + at, size)

    def value(self, t: str, slopes: list[str]) -> None:
        """V = Q_zz + F'K, v = Q_z + F'k, for F = Q_uz less the damping's part."""
        f, m, size, P = self.f, self.layout.m, self.size, self.P
        self._gradient(self._state_cost(t), dict(zip(self.moving, slopes, strict=False)))
        for some in self._grouped(self.cut):
            K = [pieces_of(f, self.K, P, some, size)(j) for j in range(m)]
            for c in range(self.layout.nz):
                row = f.at(self.V, c * P)
                values = [f.load(row, at, size) for at in some]
                for j, gains in enumerate(K):
                    factor = f.load_all(self.F, j * P + c, size)
                    values = [f.fma(factor, k, a, size) for k, a in zip(gains, values, strict=True)]
                for at, value in zip(some, values, strict=True):
                    f.store(value, row, at, size)

    def _gradient(self, cost: list[tuple[str, str] | None], slopes: dict[int, str]) -> None:
        """The value's gradient v, from the products of [A B] with the one of the next step."""
        f, size, nz = self.f, self.size, self.layout.nz
        k = [f.load_all(self.k, j, size) for j in range(self.layout.m)]
        for at in self.cut:
            terms = [slopes.get(i, ZERO) for i in range(at, min(at + size, nz))]
            for i, own in enumerate(cost[at : at + size]):
                terms[i] = f.add(terms[i], own[0]) if own else terms[i]
            v = row_of(f, terms, size)
            for j, alone in enumerate(k):
                v = f.fma(alone, f.load(self.F, j * self.P + at, size), v, size)
            f.store(v, self.v, at, size)

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

    def factor(self, t: str) -> None:
        """The factor of Q_uu + diag(damping), and the unlimited k; returns where there is none.

        The branch also keeps LLVM from moving this behind what does not need it.
        """
        f, m = self.f, self.layout.m
        self.damping = [f.load(self.words.pointer("damping"), i) for i in range(m)]
        self.damped = [list(line) for line in self.Q_uu]
        for i in range(m):
            self.damped[i][i] = f.add(self.damped[i][i], self.damping[i])
        L, inverse, good = factored(f, self.damped)
        inverse = [f.neg(value) for value in inverse]  # of -H: k and K are minus a solution
        self.g = [f.load(self.g_u, i) for i in range(m)]
        self.usual, infinity = (L, inverse, solved(f, self.g, L, inverse, 1)), number(float("inf"))
        for value in self.g:
            good = f.both(good, f.compare("olt", f.call("fabs", [value]), infinity))
        f.return_if(f.negated(good), f"i64 {t}")

    def gains(self, t: str) -> None:
        """Gains k and K of step t inside the limits; the promise d1, d2."""
        L, inverse, k = self._limited(t, self.damped, self.usual)
        self._promise(k, self.g)
        self._feedback(t, L, inverse, k)
        self._damp(self.damping)

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
        limits = zip(k, low, high, strict=True)
        broken = f.any(*(f.compare("une", clipped(f, *each), each[0]) for each in limits))

        def boxed() -> list[str]:
            rooms = (self.k, k), (self.low, low), (self.high, high), (self.free, [ONE] * m)
            for room, row in (*rooms, (self.H, [value for line in H for value in line])):
                for i, value in enumerate(row):
                    f.store(value, room, i)
            return self._boxed()

        values = f.either(broken, boxed, lambda: [*L.values(), *inverse, *k])
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
        f, d1, d2 = self.f, self.f.load(self.sums, 0), ZERO
        for i, line in enumerate(self.Q_uu):
            d1 = f.fma(k[i], g[i], d1)
            row = f.mul(line[0], k[0])
            for value, other in zip(line[1:], k[1:], strict=True):
                row = f.fma(value, other, row)
            d2 = f.fma(k[i], row, d2)
        f.store(d1, self.sums, 0)
        f.store(f.fma(d2, number(0.5), f.load(self.sums, 1)), self.sums, 1)

    def _feedback(self, t: str, L: Lower, inverse: list[str], k: list[str]) -> None:
        """K = -Q_uu^-1 Q_uz on the free inputs, k and K to memory."""
        f, m, nz, size, P = self.f, self.layout.m, self.layout.nz, self.size, self.P
        to_K, to_k = self.words.row("K", t, m * nz), self.words.row("k", t, m)
        for at in self.cut:
            Q_uz = [f.load(self.F, j * P + at, size) for j in range(m)]
            for j, row in enumerate(solved(f, Q_uz, L, inverse, size)):
                f.store(row, self.K, j * P + at, size)
                if at + size <= nz:
                    f.store(row, to_K, j * nz + at, size)
        for j in range(m):
            f.store(k[j], self.k, j)
            f.store(k[j], to_k, j)
            for i in range(nz - nz % size, nz):
                f.store(f.load(self.K, j * P + i), to_K, j * nz + i)

    def _damp(self, damping: list[str]) -> None:
        """F = Q_uz - diag(damping) K: what of it belongs to the value."""
        f, P, size = self.f, self.P, self.size
        with f.when(f.any(*(f.compare("une", value, ZERO) for value in damping))):
            for j, value in enumerate(damping):
                less = f.spread(f.neg(value), size)
                for at in self.cut:
                    row = f.load(self.F, j * P + at, size)
                    row = f.fma(less, f.load(self.K, j * P + at, size), row, size)
                    f.store(row, self.F, j * P + at, size)
