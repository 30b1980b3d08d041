"""The Kalman filter's three passes as machine code: the twin of `kalman`, but faster.

A run's covariance is a few dozen numbers: NumPy spends its time on calls. In `gains` and `smoother`
W runs lie side by side in the lanes of a vector (the last one repeated to fill them), in
`innovations` W columns do. Matrices of vectors of W lanes are [entry][lane]; rows are a loop, the
entries of a row are unrolled as long as the text stays short.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from grounded.compile.emit.llvm_batch import Words
from grounded.compile.emit.llvm_text import Writer, declarations, splat
from grounded.compile.run import jit
from grounded.compile.run.arguments import call

LARGEST = 16  # channels; beyond, NumPy
WIDEST = 48  # states
UNROLLED = 12  # entries of a row
INTEGERS = ("L", "B", "blocks")
_LOCK = threading.Lock()
NAMES = {
    "gains": ("A", "Q", "R", "seen", "start", "G", "L", "B", "k", "weight", "P"),
    "innovations": ("A", "k", "weight", "d", "r", "x", "L", "B", "blocks", "out", "track"),
    "smoother": ("A", "G", "k", "weight", "white", "L", "B", "u", "D", "r", "N"),
}


def available(n: int, N: int) -> bool:
    """Whether the passes can be compiled here for n channels and N states."""
    return 0 < n <= LARGEST and N <= WIDEST


def columns_together(n: int) -> int:
    """Columns that are computed together; one where nothing is compiled."""
    if not available(n, n):
        return 1
    return 4 if n <= 4 else jit.lanes()


def run(
    name: str, sizes: tuple[int, int], values: Mapping[str, Any], out: Mapping[str, Any]
) -> None:
    """Calls a pass.

    Args:
        name: of the pass.
        sizes: n, N.
        values: arrays by name, made contiguous; None where there is none.
        out: arrays that are written, contiguous, or None.
    """
    words: dict[str, Any] = {
        key: 0 if value is None else np.ascontiguousarray(value, float)
        for key, value in values.items()
    }
    words |= {key: 0 if value is None else value for key, value in out.items()}
    words["L"], words["B"] = values["A"].shape[:2]
    if name == "innovations":
        words["blocks"] = values["d"].shape[-1] // columns_together(sizes[0])
    if words["L"] and words["B"] and words.get("blocks", 1):
        through = values.get("G") is not None
        call(_library(*sizes, through)[name], NAMES[name], words)


def _library(n: int, N: int, through: bool) -> jit.Library:
    """Made once, whatever thread asks first: of two, one would be freed while its code runs."""
    with _LOCK:
        return _made(n, N, through)


@cache
def _made(n: int, N: int, through: bool) -> jit.Library:
    lanes, columns = jit.lanes(), columns_together(n)

    def text() -> str:
        passes = {_Gains: lanes, _Innovations: columns, _Smoother: lanes}
        parts = (one(NAMES[one.name], n, N, width, through).text() for one, width in passes.items())
        return declarations({lanes, columns}) + "".join(parts)

    key = f"filter {_version()} {n} {N} {through} {lanes} {columns}"
    return jit.library(key, text, tuple(NAMES))


@cache
def _version() -> str:
    return hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:16] + jit.writers()


class _Pass:
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


class _Gains(_Pass):
    name = "gains"

    def write(self) -> None:
        f, n, N = self.f, self.n, self.N
        rooms = {"A": N * N, "G": n * n, "Q": N, "R": n, "seen": n}
        room = {name: self.room(size) for name, size in rooms.items()}
        P, spare, k, weight = (self.room(size) for size in (N * N, N * N, n * N, n))
        for _ in self.groups():
            self.clear(P, N * N)
            self.gather("start", "0", N, spare)
            for i in range(N):
                self.store(self.load(spare, i), P, i * N + i)
            with f.loop(self.L) as t:
                for name, size in rooms.items():
                    if name != "G" or self.through:
                        self.gather(name, t, size, room[name])
                self.sandwich(room["A"], P, spare, transposed=False)
                if self.through:
                    self._entered(room["G"], room["Q"], P, spare)
                for i in range(n if self.through else 0, N):
                    value = f.add(self.load(P, i * N + i), self.load(room["Q"], i), self.W)
                    self.store(value, P, i * N + i)
                with f.when(self.wanted("P")):
                    self.scatter(P, "P", t, N * N)
                with f.loop(n) as c:
                    self._channel(c, P, room, k, weight)
                self.scatter(k, "k", t, n * N)
                self.scatter(weight, "weight", t, n)

    def _entered(self, G: str, q: str, P: str, spare: str) -> None:
        """P[:n, :n] += G diag(q) G'."""
        f, n, N = self.f, self.n, self.N
        with f.loop(n) as line:
            values, to = self.all(self.at(G, line, n), n), self.at(P, line, N)
            scaled = [f.mul(v, self.load(q, j), self.W) for j, v in enumerate(values)]
            for j in self.each(n):
                other, place = self.all(self.at(G, j, n), n), self.at(to, j)
                self.store(self.dot(scaled, other, self.load(place)), place)

    def _channel(self, c: str, P: str, room: Mapping[str, str], k: str, weight: str) -> None:
        f, N, W = self.f, self.N, self.W
        row = self.at(k, c, N)
        b = self.all(self.at(P, c, N), N)  # symmetric: the row is the column
        s = f.add(self.load(self.at(self.at(P, c, N), c)), self.load(self.at(room["R"], c)), W)
        seen = self.load(self.at(room["seen"], c))
        inverse = f.div(splat(1.0, W), f.call("sqrt", [s], W), W)
        inverse = f.select(f.compare("ogt", seen, splat(0.0, W), W), inverse, splat(0.0, W), W)
        self.store(inverse, self.at(weight, c))
        for i in range(N):
            self.store(f.mul(b[i], inverse, W), row, i)
        with f.loop(N) as line:
            down, to = f.neg(self.load(self.at(row, line)), W), self.at(P, line, N)
            for j in self.each(N):
                place, other = self.at(to, j), self.load(self.at(row, j))
                self.store(f.fma(down, other, self.load(place), W), place)


class _Innovations(_Pass):
    """All runs go through time together, so that memory is read in order."""

    name = "innovations"

    def write(self) -> None:
        f, n, N, w = self.f, self.n, self.N, self.W
        blocks, spare = self.count["blocks"], self.room(N)
        follow = self.wanted("track")
        with f.loop(self.L) as t, f.loop(self.B) as b:
            run = f.integer("add", f.integer("mul", t, self.B), b)
            A, k = self._of("A", run, N * N), self._of("k", run, n * N)
            weight = self._of("weight", run, n)
            with f.loop(blocks) as block:
                x = self._rows("x", b, block, N)
                with f.loop(N) as line:
                    entries, value = f.at(A, f.integer("mul", line, N)), splat(0.0, w)
                    for j, place in enumerate(x):
                        value = f.fma(f.load_all(entries, j, w), f.load(place, 0, w), value, w)
                    self.store(value, self.at(spare, line))
                values = self.all(spare, N)
                for i, place in enumerate(self._rows("d", run, block, n)):
                    values[i] = f.add(values[i], f.load(place, 0, w), w)
                out = self._rows("out", run, block, n)
                for c, place in enumerate(self._rows("r", run, block, n)):
                    missed = f.sub(f.load(place, 0, w), values[c], w)
                    eps = f.mul(missed, f.load_all(weight, c, w), w)
                    f.store(eps, out[c], 0, w)
                    gain = (f.load_all(k, c * N + i, w) for i in range(N))
                    values = [f.fma(g, eps, v, w) for g, v in zip(gain, values, strict=True)]
                for value, place in zip(values, x, strict=True):
                    f.store(value, place, 0, w)
                with f.when(follow):
                    for i, place in enumerate(self._rows("track", run, block, n)):
                        f.store(values[i], place, 0, w)

    def _of(self, name: str, run: str, size: int) -> str:
        return self.f.at(self.base[name], self.f.integer("mul", run, size))

    def _rows(self, name: str, run: str, block: str, rows: int) -> list[str]:
        """Where the rows of an array (.., rows, columns) have a block of columns."""
        f, columns = self.f, self.f.integer("mul", self.count["blocks"], self.W)
        first = f.integer("mul", f.integer("mul", run, rows), columns)
        place = f.at(self.base[name], f.integer("add", first, f.integer("mul", block, self.W)))
        return [f.at(place, f.integer("mul", columns, i)) for i in range(rows)]


class _Smoother(_Pass):
    name = "smoother"

    def write(self) -> None:
        f, n, N = self.f, self.n, self.N
        rooms = {"A": N * N, "G": n * n, "k": n * N, "weight": n, "white": n}
        room = {name: self.room(size) for name, size in rooms.items()}
        q, P, spare = self.room(N), self.room(N * N), self.room(N * N)
        u, D, answer = self.room(n), self.room(n), self.room(N)
        for _ in self.groups():
            self.clear(q, N)
            self.clear(P, N * N)
            with f.loop(self.L, down=True) as t:
                for name, size in rooms.items():
                    if name != "G" or self.through:
                        self.gather(name, t, size, room[name])
                with f.loop(n, down=True) as c:
                    self._channel(c, q, P, room, (u, D, spare))
                self.scatter(u, "u", t, n)
                self.scatter(D, "D", t, n)
                if self.through:
                    self._leaves(room["G"], q, P, (answer, spare))
                    self.scatter(answer, "r", t, N)
                    self.scatter(spare, "N", t, N)
                else:
                    self.scatter(q, "r", t, N)
                    self.scatter(P, "N", t, N, step=N + 1)
                self.sandwich(room["A"], P, spare, transposed=True)
                values = self.all(q, N)
                with f.loop(N) as line:
                    column = self.all(self.at(room["A"], line), N, N)
                    self.store(self.dot(column, values), self.at(spare, line))
                for i in range(N):
                    self.store(self.load(spare, i), q, i)

    def _channel(
        self, c: str, q: str, P: str, room: Mapping[str, str], rooms: tuple[str, str, str]
    ) -> None:
        """Q += h'u, N += h'D h - h'(N K)' - N K h of one channel, K = k weight."""
        f, N, W = self.f, self.N, self.W
        u_out, D_out, NK = rooms
        weight = self.load(self.at(room["weight"], c))
        k = self.all(self.at(room["k"], c, N), N)
        eps = f.sub(self.load(self.at(room["white"], c)), self.dot(k, self.all(q, N)), W)
        u = f.mul(eps, weight, W)
        with f.loop(N) as line:
            value = f.mul(self.dot(self.all(self.at(P, line, N), N), k), weight, W)
            self.store(value, self.at(NK, line))
        values = self.all(NK, N)
        D = f.mul(self.dot(k, values, weight), weight, W)
        self.store(u, self.at(u_out, c))
        self.store(D, self.at(D_out, c))
        place = self.at(q, c)
        self.store(f.add(self.load(place), u, W), place)
        row, column = self.at(P, c, N), self.at(P, c)
        for i, value in enumerate(values):
            for place in (self.at(row, i), self.at(column, i * N)):
                self.store(f.sub(self.load(place), value, W), place)
        place = self.at(row, c)
        self.store(f.add(self.load(place), D, W), place)

    def _leaves(self, G: str, q: str, P: str, rooms: tuple[str, str]) -> None:
        """G'q and the diagonal of G' N G, where the first n disturbances enter through G."""
        f, n, N, W = self.f, self.n, self.N, self.W
        r_out, N_out = rooms
        values = self.all(q, n)
        for c in range(n):
            column = self.all(self.at(G, c), n, n)
            self.store(self.dot(column, values), r_out, c)
            total = splat(0.0, W)
            for i, g in enumerate(column):
                total = f.fma(g, self.dot(self.all(self.at(P, i * N), n), column), total, W)
            self.store(total, N_out, c)
        for i in range(n, N):
            self.store(self.load(q, i), r_out, i)
            self.store(self.load(P, i * N + i), N_out, i)
