"""Matrices of vectors of W lanes, as a kernel writes them: [entry][lane].

Rows of a matrix are a loop, the entries of a row are unrolled as long as the text stays short.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from grounded.compile.emit.llvm_batch import Words
from grounded.compile.emit.llvm_text import Writer, splat

UNROLLED = 12  # entries of a row
INTEGERS = ("L", "B", "blocks")


class Pass:
    """A pass of the filter being written, for n channels and N states.

    Args:
        names: of the words that it is called with.
        n: channels.
        N: states.
        width: W.
        through: whether disturbances enter through G.
    """

    name: str

    def __init__(self, names: Sequence[str], n: int, N: int, width: int, through: bool) -> None:
        self.f = Writer(f"i64 @{self.name}(ptr %words)")
        words = Words(self.f, names)
        self.base = {w: words.pointer(w) for w in names if w not in INTEGERS}
        self.count = {w: words.integer(w) for w in names if w in INTEGERS}
        self.L, self.B = self.count["L"], self.count["B"]
        self.n, self.N, self.W, self.through = n, N, width, through
        self.runs: list[str] = []

    def text(self) -> str:
        """The finished kernel."""
        self.write()
        self.f.do("ret i64 0")
        return self.f.text()

    def write(self) -> None:
        """Its body."""
        raise NotImplementedError

    def room(self, size: int) -> str:
        """Vectors of W lanes on the stack."""
        return self.f.room(size * self.W)

    def load(self, base: str, index: int = 0) -> str:
        """Vector `index` of a matrix."""
        return self.f.load(base, index * self.W, self.W)

    def store(self, value: str, base: str, index: int = 0) -> None:
        """The way back."""
        self.f.store(value, base, index * self.W, self.W)

    def all(self, base: str, size: int, step: int = 1) -> list[str]:
        """Every `step`-th vector, `size` of them."""
        return [self.load(base, i * step) for i in range(size)]

    def at(self, base: str, index: int | str, size: int = 1) -> str:
        """The address of entry `index` of blocks of `size` vectors."""
        if isinstance(index, int):
            return self.f.at(base, index * size * self.W)
        return self.f.at(base, self.f.integer("mul", index, size * self.W))

    def each(self, size: int) -> Iterator[int | str]:
        """Entries of a row: unrolled if they are few, else a loop."""
        if size <= UNROLLED:
            yield from range(size)
            return
        with self.f.loop(size) as i:
            yield i

    def dot(self, a: list[str], b: list[str], start: str | None = None) -> str:
        """The sum of products, added to `start`."""
        total = self.f.mul(a[0], b[0], self.W) if start is None else start
        for x, y in list(zip(a, b, strict=True))[start is None :]:
            total = self.f.fma(x, y, total, self.W)
        return total

    def clear(self, base: str, size: int) -> None:
        """Sets vectors to zero."""
        with self.f.loop(size) as i:
            self.store(splat(0.0, self.W), self.at(base, i))

    def groups(self) -> Iterator[None]:
        """W runs at a time; the last one is repeated to fill the lanes."""
        f, last = self.f, self.f.integer("sub", self.B, 1)
        count = f.integer("sdiv", f.integer("add", self.B, self.W - 1), self.W)
        with f.loop(count) as group:
            first, self.runs = f.integer("mul", group, self.W), []
            for lane in range(self.W):
                i = f.integer("add", first, lane)
                self.runs.append(f.pick(f.compare_integers("sgt", i, last), last, i))
            yield

    def _places(self, name: str, t: str, size: int) -> list[str]:
        row = self.f.integer("mul", t, self.B)
        places = (self.f.integer("add", row, run) for run in self.runs)
        return [self.f.at(self.base[name], self.f.integer("mul", p, size)) for p in places]

    def gather(self, name: str, t: str, size: int, to: str) -> None:
        """Row t of an array (time, run, size) of the group's runs into lanes."""
        places, f = self._places(name, t, size), self.f
        with f.loop(size) as i:
            value = "poison"
            for lane, place in enumerate(places):
                one = f.load(f.at(place, i))
                value = f.emit(
                    f"insertelement <{self.W} x double> {value}, double {one}, i64 {lane}"
                )
            self.store(value, self.at(to, i))

    def scatter(self, source: str, name: str, t: str, size: int, *, step: int = 1) -> None:
        """The way back; every `step`-th vector of the source."""
        places, f = self._places(name, t, size), self.f
        with f.loop(size) as i:
            value = self.load(self.at(source, i, step))
            for lane, place in enumerate(places):
                f.store(f.lane(value, lane, self.W), f.at(place, i))

    def wanted(self, name: str) -> str:
        """Whether an output that may be missing is there."""
        return self.f.given(self.base[name])

    def sandwich(self, A: str, P: str, spare: str, *, transposed: bool) -> None:
        """P <- A P A', or A' P A, the mean of what stands above and below the diagonal."""
        f, N = self.f, self.N
        row, step = (1, N) if transposed else (N, 1)
        with f.loop(N) as line:
            values, to = self.all(self.at(A, line, row), N, step), self.at(spare, line, N)
            for j in self.each(N):
                self.store(self.dot(values, self.all(self.at(P, j), N, N)), self.at(to, j))
        with f.loop(N) as line:
            values, to = self.all(self.at(spare, line, N), N), self.at(P, line, N)
            for j in self.each(N):
                other = self.all(self.at(A, j, row), N, step)
                self.store(self.dot(values, other), self.at(to, j))
        for i in range(1, N):  # what is not symmetric would grow, step by step
            for j in range(i):
                below, above = i * N + j, j * N + i
                mean = f.add(self.load(P, below), self.load(P, above), self.W)
                mean = f.mul(mean, splat(0.5, self.W), self.W)
                self.store(mean, P, below)
                self.store(mean, P, above)
