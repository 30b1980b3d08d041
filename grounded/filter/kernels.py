"""The Kalman filter's three passes as machine code: the twin of `kalman`, but faster.

A run's covariance is a few dozen numbers: NumPy spends its time on calls. In `gains` and `smoother`
W runs lie side by side in the lanes of a vector (the last one repeated to fill them), in
`innovations` W columns do; `lanes` writes their matrices.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from grounded.compile.emit.llvm_text import declarations, splat
from grounded.compile.run import jit
from grounded.compile.run.arguments import call
from grounded.filter.lanes import Pass

LARGEST = 16  # channels; beyond, NumPy
WIDEST = 48  # states
_LOCK = threading.Lock()
NAMES = {
    "gains": ("A", "Q", "R", "seen", "start", "G", "L", "B", "k", "weight", "P"),
    "innovations": ("A", "k", "weight", "d", "r", "x", "L", "B", "blocks", "out", "track"),
    "smoother": ("A", "G", "k", "weight", "white", "L", "B", "u", "D", "r", "N"),
}


def available(n: int, N: int) -> bool:
    """Whether the passes can be compiled here for n channels and N states."""
    return 0 < n <= LARGEST and N <= WIDEST and not _trouble()


@cache
def _trouble() -> str:
    return jit.trouble()


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
    files = (Path(__file__).with_name(name) for name in ("kernels.py", "lanes.py"))
    text = b"".join(file.read_bytes() for file in files)
    return hashlib.sha256(text).hexdigest()[:16] + jit.writers()


class _Gains(Pass):
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


class _Innovations(Pass):
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


class _Smoother(Pass):
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
