"""Kernels over N independent samples, W lanes at a time: the step, and its Jacobian.

A kernel takes one pointer, to a table of 64-bit words: addresses, integers, doubles. The Jacobian
is computed as the values of its places and scattered into matrices that are zero elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from grounded.compile.emit.llvm_step import Dynamics, StepWriter
from grounded.compile.emit.llvm_text import Writer
from grounded.compile.kernel_words import BATCH, MARCH


class Words:
    """The table of words that a kernel is called with."""

    def __init__(self, f: Writer, names: Sequence[str]) -> None:
        self.f, self.names = f, tuple(names)

    def _address(self, name: str) -> str:
        return self.f.at("%words", self.names.index(name), "i64")

    def _load(self, kind: str, name: str) -> str:
        return self.f.emit(f"load {kind}, ptr {self._address(name)}, align 8")

    def pointer(self, name: str) -> str:
        """An array."""
        return self._load("ptr", name)

    def row(self, name: str, t: str, size: int) -> str:
        """The address of row t of an array of rows."""
        return self.f.at(self.pointer(name), self.f.integer("mul", t, size))

    def integer(self, name: str) -> str:
        """An i64."""
        return self._load("i64", name)

    def double(self, name: str) -> str:
        """A double."""
        return self._load("double", name)

    def set(self, name: str, value: str) -> None:
        """Change a word, to a value after its type."""
        self.f.do(f"store {value}, ptr {self._address(name)}, align 8")

    def move(self, name: str, by: str) -> None:
        """Move an array's address on, by a number of bytes."""
        self.set(name, f"i64 {self.f.integer('add', self.integer(name), by)}")


def start_table(f: Writer, words: Words, d: Dynamics) -> str:
    """Room for the uniform values, filled."""
    table = f.room(d.uniforms.size)
    p, dt, eps = words.pointer("p"), words.double("dt"), words.double("eps")
    f.do(f"call void @uniforms(ptr {p}, double {dt}, double {eps}, ptr {table})")
    return table


def gather_rows(
    f: Writer, arrays: Sequence[tuple[str, int, str]], first: str, count: str, width: int
) -> None:
    """Rows first .. first + W - 1 of (count, size) arrays to [size][W], the last row repeated.

    `arrays`: (address, size, destination) of each.
    """
    last, index = f.integer("sub", count, 1), list[str]()
    for lane in range(width):
        i = f.integer("add", first, lane)
        index.append(f.pick(f.compare_integers("sgt", i, last), last, i))
    for base, size, out in arrays:
        rows = [f.at(base, f.integer("mul", i, size)) for i in index]
        for j in range(size):
            f.store(f.vector_of([f.load(row, j) for row in rows]), out, j * width, width)


def _each_sample(
    f: Writer,
    arrays: Sequence[tuple[str, int, str]],
    words: Words,
    width: int,
    compute: Callable[[], object],
    scatter: Callable[[str, str], None],
) -> None:
    """Samples in blocks of W: `compute` on gathered rows, `scatter(row, lane)` for each."""
    count = words.integer("N")
    with f.loop(f.integer("sdiv", f.integer("add", count, width - 1), width)) as block:
        first = f.integer("mul", block, width)
        gather_rows(f, arrays, first, count, width)
        compute()
        left = f.integer("sub", count, first)
        with f.loop(f.pick(f.compare_integers("sgt", left, width), width, left)) as lane:
            scatter(f.integer("add", first, lane), lane)


def step_kernel(d: Dynamics, width: int) -> str:
    """`void @step(words)`: out (N, n)."""
    f = Writer("void @step(ptr %words)")
    words = Words(f, BATCH)
    x, u, out = (words.pointer(name) for name in ("x", "u", "out"))
    writer = StepWriter(f, d, width, start_table(f, words, d))

    def scatter(row: str, lane: str) -> None:
        to, source = f.at(out, f.integer("mul", row, d.n)), f.at(writer.next, lane)
        for i in range(d.n):
            f.store(f.load(source, i * width), to, i)

    arrays = [(x, d.n, writer.x), (u, d.m, writer.u)]
    _each_sample(f, arrays, words, width, writer.step, scatter)
    f.do("ret void")
    return f.text()


def march_kernel(d: Dynamics) -> str:
    """`void @march(words)`: steps one after the other, out (T, N, n); uses up its words."""
    f = Writer("void @march(ptr %words)")
    words = Words(f, MARCH)
    lengths, rows = words.pointer("lengths"), f.integer("mul", words.integer("N"), 8)
    sizes = {"x": d.n, "out": d.n, "u": d.m}
    bytes_of = {name: f.integer("mul", rows, size) for name, size in sizes.items()}
    with f.loop(words.integer("steps")) as t:
        words.set("dt", f"double {f.load(lengths, t)}")
        f.do("call void @step(ptr %words)")
        for name, size in bytes_of.items():
            words.move(name, size)
    f.do("ret void")
    return f.text()


def linearise_kernel(d: Dynamics, width: int, k: int) -> str:
    """`void @linearise(words)`: f_x (N, n, n), f_u (N, n, m) and, for k > 0, f_p (N, n, k)."""
    f = Writer("void @linearise(ptr %words)")
    words = Words(f, BATCH)
    x, u, table = words.pointer("x"), words.pointer("u"), start_table(f, words, d)
    xu, following = f.room((d.n + d.m) * width), f.room(d.n * width)
    values = f.room(len(d.places) * width)
    arrays = [(x, d.n, xu), (u, d.m, f.at(xu, d.n * width))]
    jacobian = f"call i64 @jacobian(ptr {xu}, ptr {table}, ptr {following}, ptr {values})"

    def scatter(row: str, lane: str) -> None:
        _scatter(f, words, d, k, row, f.at(values, lane), width)

    _each_sample(f, arrays, words, width, lambda: f.do(jacobian), scatter)
    f.do("ret void")
    return f.text()


def _scatter(
    f: Writer, words: Words, d: Dynamics, k: int, row: str, values: str, width: int
) -> None:
    """One sample's values into its matrices."""
    starts, matrices = [0, d.n, d.n + d.m], [("f_x", d.n), ("f_u", d.m), ("f_p", k)]
    to = [
        f.at(words.pointer(name), f.integer("mul", row, d.n * size)) if size else ""
        for name, size in matrices
    ]
    for e, (r, c) in enumerate(d.places):
        which = sum(c >= start for start in starts) - 1
        index = r * matrices[which][1] + c - starts[which]
        f.store(f.load(values, e * width), to[which], index)
