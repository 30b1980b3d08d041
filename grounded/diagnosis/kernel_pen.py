"""What the filter's kernels are written with: arguments, rooms, the loops they share."""

from __future__ import annotations

from grounded.compile.emit.llvm_batch import Words
from grounded.compile.emit.llvm_text import Writer, splat

GAINS = ("A", "Q", "R", "seen", "start", "G", "L", "B", "K", "W", "state")
INNOVATIONS = ("A", "K", "W", "d", "r", "seen", "L", "B", "blocks", "C", "out", "track", "state")
SMOOTHER = ("A", "K", "W", "white", "seen", "G", "L", "B", "u", "D", "r", "N", "state")
INTEGERS = ("L", "B", "C", "blocks")
NAMES = {"gains": GAINS, "innovations": INNOVATIONS, "smoother": SMOOTHER}


class Pen:
    """A kernel being written: sizes, rooms, and the loops all three share."""

    def __init__(self, name: str, n: int, N: int, width: int) -> None:
        self.f = Writer(f"i64 @{name}(ptr %words)")
        self.words = Words(self.f, NAMES[name])
        self.n, self.N, self.width = n, N, width
        self.wide, self.short = self.padded(N), self.padded(n)
        self.inputs = {w: self.words.pointer(w) for w in NAMES[name] if w not in INTEGERS}
        self.L, self.B = self.words.integer("L"), self.words.integer("B")

    def padded(self, size: int) -> int:
        """Whole vectors."""
        return -(-size // self.width) * self.width

    def room(self, rows: int, columns: int) -> str:
        """Rows of whole vectors, zero."""
        size = rows * columns
        found = self.f.room(size)
        with self.f.loop(size // self.width) as i:
            at = self.f.integer("mul", i, self.width)
            self.f.store(splat(0.0, self.width), found, at, self.width)
        return found

    def at(self, name: str, t: str, b: str, size: int) -> str:
        """Where an array (time, run, size) has its part."""
        f = self.f
        place = f.integer("add", f.integer("mul", t, self.B), b)
        return f.at(self.inputs[name], f.integer("mul", place, size))

    def product(
        self,
        out: tuple[str, int, int],
        left: tuple[str, int, int],
        right: tuple[str, int],
        inner: int,
        *,
        onto: str = "",
    ) -> None:
        """Writes out (address, rows, columns) = [onto +] left (address, row, column step) right.

        `right` is (address, row step); `onto` has the shape of out or is empty.
        """
        f, w = self.f, self.width
        address, rows, columns = out
        with f.loop(rows) as i:
            to = f.at(address, f.integer("mul", i, columns))
            base = f.at(left[0], f.integer("mul", i, left[1]))
            start = f.at(onto, f.integer("mul", i, columns)) if onto else ""
            for c in range(0, columns, w):
                total = f.load(start, c, w) if onto else splat(0.0, w)
                for k in range(inner):
                    a = f.load_all(base, k * left[2], w)
                    total = f.fma(a, f.load(right[0], k * right[1] + c, w), total, w)
                f.store(total, to, c, w)

    def copied(self, source: str, rows: int, columns: int, to: str, step: int) -> None:
        """A plain matrix into padded rows."""
        f = self.f
        with f.loop(rows) as i:
            a, b = f.at(source, f.integer("mul", i, columns)), f.at(to, f.integer("mul", i, step))
            for c in range(columns):
                f.store(f.load(a, c), b, c)

    def turned(
        self, source: str, size: tuple[int, int], step: int, to: str, wide: int, minus: bool = False
    ) -> None:
        """A matrix (rows, columns) with rows `step` apart, transposed into rows of `wide`."""
        f = self.f
        with f.loop(size[0]) as i:
            a, b = f.at(source, f.integer("mul", i, step)), f.at(to, i)
            for c in range(size[1]):
                value = f.load(a, c)
                f.store(f.neg(value) if minus else value, b, c * wide)

    def unpadded(self, source: str, rows: int, columns: int, step: int, to: str) -> None:
        """Padded rows into a plain matrix."""
        f = self.f
        with f.loop(rows) as i:
            a, b = f.at(source, f.integer("mul", i, step)), f.at(to, f.integer("mul", i, columns))
            for c in range(columns):
                f.store(f.load(a, c), b, c)

    def end(self) -> str:
        """The finished kernel."""
        self.f.do("ret i64 0")
        return self.f.text()
