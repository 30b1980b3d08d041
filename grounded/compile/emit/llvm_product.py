"""Writes products with the Jacobian [A B] of z along a trajectory, for the sweep.

Rows c of [A B]'X are sums of rows of X: over the non-zero places (r, c) of the model's Jacobian for
a state, the same with the delay's weights and a shifted row for a past input. So only what is not
zero costs anything, and every operation is on whole rows. The model's Jacobian is computed for W
steps at once, just before the sweep needs them.
"""

from __future__ import annotations

from collections.abc import Callable

from grounded.compile.emit.llvm_batch import Words, gather_rows, start_table
from grounded.compile.emit.llvm_rollout import received
from grounded.compile.emit.llvm_step import Dynamics
from grounded.compile.emit.llvm_text import Writer, integers, number, splat, vector
from grounded.compile.kernel_words import Layout

Row = Callable[[int | str], str]  # loads (a piece of) row r of a matrix
UNROLLED = 400  # entries of the Jacobian whose products are written out; more are a loop


def padded(size: int, width: int = 4) -> int:
    """Rows are multiples of four doubles; what lies between them, of a vector.

    A vector that begins in one cache line and ends in the next costs two accesses.
    """
    lanes = width if size > 4 else 4
    return -(-size // lanes) * lanes


def pieces(size: int, width: int) -> list[tuple[int, int]]:
    """A padded row as vectors that the machine has: (first entry, W or 4 entries) of each."""
    wide = size // width * width
    cut = [(at, width) for at in range(0, wide, width)]
    return cut + [(at, 4) for at in range(wide, size, 4)]


def pieces_of(f: Writer, base: str, stride: int, at: int, size: int) -> Row:
    """Loads entries at .. at + size - 1 of a matrix's rows."""

    def piece(r: int | str) -> str:
        if isinstance(r, int):
            return f.load(base, r * stride + at, size)
        return f.load(base, f.integer("add", f.integer("mul", r, stride), at), size)

    return piece


def transpose(f: Writer, M: str, T: str, P: int, C: int, width: int) -> None:
    """T (P, C) = M' of M (C, P), stored in the pieces that T is read in.

    A store that a later load only partly covers would have to reach the cache first.
    """
    if C // width:
        with f.loop(C // width) as block:
            c = f.integer("mul", block, width)
            _transpose_rows(f, f.at(M, f.integer("mul", c, P)), f.at(T, c), (P, C), width)
    for tail in range(C // width * width, C, 4):
        _transpose_rows(f, f.at(M, tail * P), f.at(T, tail), (P, C), 4)


def _transpose_rows(f: Writer, source: str, target: str, size: tuple[int, int], count: int) -> None:
    """`count` rows of M to as many columns of T, in blocks of four by four."""
    P, C = size
    for r in range(0, P, 4):
        rows = [f.load(source, i * P + r, 4) for i in range(count)]
        if count > 4:  # blocks side by side are transposed at once
            rows = [_beside(f, a, b) for a, b in zip(rows[:4], rows[4:], strict=True)]
        for i, column in enumerate(_transpose_block(f, rows, count)):
            f.store(column, target, (r + i) * C, count)


def symmetric(f: Writer, V: str, P: int) -> None:
    """V (P, P) becomes (V + V') / 2, in blocks of four by four."""
    half = splat(0.5, 4)
    with f.loop(P // 4) as i, f.loop(f.integer("add", i, 1)) as j:
        first, second = f.integer("mul", i, 4), f.integer("mul", j, 4)
        below = f.at(V, f.integer("add", f.integer("mul", first, P), second))
        above = f.at(V, f.integer("add", f.integer("mul", second, P), first))
        mirrored = _transpose_block(f, [f.load(above, r * P, 4) for r in range(4)])
        mean = [
            f.mul(f.add(f.load(below, r * P, 4), row, 4), half, 4) for r, row in enumerate(mirrored)
        ]
        for r, row in enumerate(mean):
            f.store(row, below, r * P, 4)
        for r, row in enumerate(_transpose_block(f, mean)):
            f.store(row, above, r * P, 4)


def _transpose_block(f: Writer, a: list[str], size: int = 4) -> list[str]:
    """Columns of four rows of four; of two such blocks side by side where `size` is 8."""
    kind = vector(size)

    def shuffled(a: str, b: str, *lanes: int) -> str:
        """Lanes of a, from 4 on of b, in each block."""
        places = (i % 4 + i // 4 * size + block for block in range(0, size, 4) for i in lanes)
        inside = ", ".join(f"i32 {i}" for i in places)
        return f.emit(f"shufflevector {kind} {a}, {kind} {b}, <{size} x i32> <{inside}>")

    lo = [shuffled(a[i], a[i + 1], 0, 4, 2, 6) for i in (0, 2)]
    hi = [shuffled(a[i], a[i + 1], 1, 5, 3, 7) for i in (0, 2)]
    return [
        shuffled(lo[0], lo[1], 0, 1, 4, 5),
        shuffled(hi[0], hi[1], 0, 1, 4, 5),
        shuffled(lo[0], lo[1], 2, 3, 6, 7),
        shuffled(hi[0], hi[1], 2, 3, 6, 7),
    ]


def _beside(f: Writer, a: str, b: str) -> str:
    """Two vectors of four as one of eight."""
    kind, lanes = vector(4), ", ".join(f"i32 {i}" for i in range(8))
    return f.emit(f"shufflevector {kind} {a}, {kind} {b}, <8 x i32> <{lanes}>")


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
        self.jac = f.room((len(d.places) + 1) * width)  # the last is zero
        self.sums_room = f.room((n + m) * width)
        self.now = ""
        f.store(splat(0.0, width), self.jac, len(d.places) * width, width)

    def begins(self, t: str) -> str:
        """Whether t is the last step of a block, whose Jacobians are not there yet."""
        f = self.f
        last = f.emit(f"icmp eq i64 {t}, {f.integer('sub', self.words.integer('H'), 1)}")
        edge = f.emit(f"icmp eq i64 {f.integer('and', t, self.width - 1)}, {self.width - 1}")
        return f.emit(f"or i1 {last}, {edge}")

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

    def inputs(self, row: Row, size: int) -> tuple[list[str], list[str]]:
        """Rows of f_u'X, one an input, and of B'X, from pieces X(r, :) of `size` doubles."""
        f, layout, now = self.f, self.layout, self.words.pointer("now")
        G = self._sums(row, size, range(layout.n, layout.n + layout.m))
        return G, [
            f.fma(f.load_all(now, j, size), G[j], row(layout.slot(j)), size)
            for j in range(layout.m)
        ]

    def states(self, row: Row, size: int, G: list[str]) -> list[str]:
        """Rows of A'X, given those of f_u'X."""
        f, layout = self.f, self.layout
        out = self._sums(row, size, range(layout.n))
        past, D = self.words.pointer("past"), layout.nz - layout.n
        for j, depth in enumerate(layout.depths):
            for i in range(depth):
                weight = f.load_all(past, j * D + layout.slot(j, i) - layout.n, size)
                value = f.mul(weight, G[j], size)
                older = i + 1 < depth
                out.append(f.add(value, row(layout.slot(j, i + 1)), size) if older else value)
        return out

    def _sums(self, row: Row, size: int, columns: range) -> list[str]:
        """For each column c of the model's Jacobian, the sum over r of J(r, c) X(r, :)."""
        if len(self.d.places) > UNROLLED:
            return self._looped_sums(row, size, columns)
        f, sums = self.f, dict[int, str]()
        for e, (r, c) in enumerate(self.d.places):
            if c in columns:
                a, value = self._entry(e, size), row(r)
                sums[c] = f.fma(a, value, sums[c], size) if c in sums else f.mul(a, value, size)
        return [sums.get(c, splat(0.0, size)) for c in columns]

    def _looped_sums(self, row: Row, size: int, columns: range) -> list[str]:
        """The same for large models, by tables of indices."""
        f, count = self.f, len(columns)
        with f.loop(count) as i:
            c = f.integer("add", i, columns.start)
            first = f.index("@column_first", c)
            entries = f.integer("sub", f.index("@column_first", f.integer("add", c, 1)), first)
            with f.fold(entries, size, splat(0.0, size)) as total:
                q = f.integer("add", first, total.i)
                a = f.load_all(self.now, f.index("@column_entry", q), size)
                total.set(f.fma(a, row(f.index("@column_row", q)), total.value, size))
            f.store(total.result, self.sums_room, f.integer("mul", i, size), size)
        return [f.load(self.sums_room, i * size, size) for i in range(count)]

    def _entry(self, e: int, size: int) -> str:
        """Value e of the Jacobian of this step, in every lane."""
        # Read again at each use: a multiplication takes it from memory for nothing.
        return self.f.load_all(self.now, e * self.width, size)


def sweep_tables(d: Dynamics, width: int) -> str:
    """For large models: which entries each column of the Jacobian has, at least the zero one."""
    if len(d.places) <= UNROLLED:
        return ""
    first, rows, entries = [0], [], []
    for c in range(d.n + d.m):
        column = [(r, e) for e, (r, c2) in enumerate(d.places) if c2 == c] or [(0, len(d.places))]
        rows += [r for r, _ in column]
        entries += [e for _, e in column]
        first.append(len(rows))
    return (
        integers("column_first", first)
        + integers("column_row", rows)
        + integers("column_entry", [e * width for e in entries])
    )
