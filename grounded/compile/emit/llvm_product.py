"""Writes products with the Jacobian [A B] of z along a trajectory, for the sweep.

Rows c of [A B]'X are sums of rows of X: over the non-zero places (r, c) of the model's Jacobian for
a state, the same with the delay's weights and a shifted row for a past input. So only what is not
zero costs anything, and every operation is on whole rows. The model's Jacobian is computed for W
steps at once, just before the sweep needs them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence, Set

from grounded.compile.emit.llvm_batch import Words, gather_rows, start_table
from grounded.compile.emit.llvm_rollout import received
from grounded.compile.emit.llvm_step import Dynamics
from grounded.compile.emit.llvm_text import Writer, number, splat, transposed, vector
from grounded.compile.kernel_words import Layout

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
