"""The Kalman filter's three passes as compiled kernels: the twin of `filter.py`, but faster.

A run's covariance is a few dozen numbers: NumPy spends its time on calls. Here all runs go through
time together (memory is read in order), matrices with rows padded to whole vectors. Everything is
built from one loop, out[i, :] += sum_k left[i, k] right[k, :] (`Pen.product`).

    gains        A, Q, R -> K, whitener
    innovations  columns of d and r -> whitened innovations, filtered errors
    smoother     whitened innovations -> adjoints of the noises and their covariances
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from grounded.compile.emit.llvm_batch import Words
from grounded.compile.emit.llvm_text import Writer, declarations, number, splat
from grounded.compile.run import jit
from grounded.compile.run.compiled import call

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

    def copied(self, source: str, step: int, to: str, to_step: int, size: tuple[int, int]) -> None:
        """A matrix (rows, columns), its rows so many numbers apart here and there."""
        f = self.f
        with f.loop(size[0]) as i:
            a, b = f.at(source, f.integer("mul", i, step)), f.at(to, f.integer("mul", i, to_step))
            for c in range(size[1]):
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

    def end(self) -> str:
        """The finished kernel."""
        self.f.do("ret i64 0")
        return self.f.text()


LARGEST = 16  # states whose factorisation is written out


def available(n: int) -> bool:
    """Whether kernels can be compiled here for n states."""
    return n <= LARGEST and not _trouble()


@cache
def _trouble() -> str:
    return jit.trouble()


def columns_together(n: int) -> int:
    """Columns that are computed together."""
    return 4 if n <= 4 else jit.lanes()


def run_kernel(name: str, n: int, N: int, through: bool, values: Mapping[str, Any]) -> None:
    """Calls a kernel on arrays, made contiguous; `through`: noise enters through a matrix G."""
    wide = -(-N // columns_together(n)) * columns_together(n)
    each = {"gains": N * wide, "innovations": N * columns_together(n) * values.get("blocks", 1)}
    state = np.zeros(values["B"] * each.get(name, (N + 1) * wide))
    arrays = {k: np.ascontiguousarray(v, float) for k, v in values.items() if np.ndim(v)}
    values = {**values, **arrays, "state": state}
    call(_library(n, N, through, columns_together(n))[name], NAMES[name], values)


@cache
def _library(n: int, N: int, through: bool, width: int) -> jit.Library:
    def text() -> str:
        parts = (_gains, _innovations, _smoother)
        return declarations({width}) + "".join(part(n, N, through, width) for part in parts)

    key = f"diagnosis {_version()} {n} {N} {through} {width}"
    return jit.library(key, text, tuple(NAMES))


@cache
def _version() -> str:
    import hashlib
    from pathlib import Path

    return hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:16] + jit.writers()


def _gains(n: int, N: int, through: bool, width: int) -> str:
    pen = Pen("gains", n, N, width)
    f, wide, short = pen.f, pen.wide, pen.short
    T, AT = pen.room(N, wide), pen.room(N, wide)
    W, WT, GT, half = pen.room(n, short), pen.room(n, short), pen.room(n, short), pen.room(N, short)
    K, turned = pen.room(N, short), pen.room(n, wide)
    with f.loop(pen.B) as b:
        start = f.at(pen.inputs["start"], f.integer("mul", b, N))
        P = f.at(pen.inputs["state"], f.integer("mul", b, N * wide))
        for i in range(N):
            f.store(f.load(start, i), P, i * wide + i)
    with f.loop(pen.L) as t, f.loop(pen.B) as b:
        P = f.at(pen.inputs["state"], f.integer("mul", b, N * wide))
        later = f.integer("add", t, 1)
        A, q = pen.at("A", t, b, N * N), pen.at("Q", t, b, N)
        R, seen = pen.at("R", later, b, n), pen.at("seen", later, b, n)
        pen.turned(A, (N, N), N, AT, wide)
        pen.product((T, N, wide), (A, N, 1), (P, wide), N)
        pen.product((P, N, wide), (T, wide, 1), (AT, wide), N)
        if through:
            _entered(pen, pen.at("G", t, b, n * n), q, GT, P)
        for i in range(n if through else 0, N):
            place = i * wide + i
            f.store(f.add(f.load(P, place), f.load(q, i)), P, place)
        _factorised(pen, P, R, seen, W, WT)
        pen.copied(W, short, pen.at("W", t, b, n * n), n, (n, n))
        pen.product((half, N, short), (P, wide, 1), (WT, short), n)
        pen.product((K, N, short), (half, short, 1), (W, short), n)
        pen.copied(K, short, pen.at("K", t, b, N * n), n, (N, n))
        pen.turned(half, (N, n), short, turned, wide, minus=True)
        pen.product((P, N, wide), (half, short, 1), (turned, wide), n, onto=P)
    return pen.end()


def _entered(pen: Pen, G: str, q: str, GT: str, P: str) -> None:
    """P[:n, :n] += G diag(q) G'."""
    f, n, w = pen.f, pen.n, pen.width
    for k in range(n):
        scale = f.load(q, k)
        for i in range(n):
            f.store(f.mul(f.load(G, i * n + k), scale), GT, k * pen.short + i)
    with f.loop(n) as j:
        row, base = f.at(P, f.integer("mul", j, pen.wide)), f.at(G, f.integer("mul", j, n))
        for c in range(0, pen.short, w):
            total = f.load(row, c, w)
            for k in range(n):
                a = f.load_all(base, k, w)
                total = f.fma(a, f.load(GT, k * pen.short + c, w), total, w)
            f.store(total, row, c, w)


def _factorised(pen: Pen, P: str, R: str, seen: str, W: str, WT: str) -> None:
    """W = L^-1 of S = L L', what was not seen left out; WT = W' with those rows zero."""
    f, n = pen.f, pen.n
    one = number(1.0)
    mask = [f.load(seen, i) for i in range(n)]
    low: dict[tuple[int, int], str] = {}
    inverse: list[str] = []
    for i in range(n):
        for j in range(i + 1):
            s = f.mul(f.mul(mask[i], mask[j]), f.load(P, i * pen.wide + j))
            if i == j:
                s = f.add(s, f.fma(mask[i], f.load(R, i), f.sub(one, mask[i])))
            for k in range(j):
                s = f.sub(s, f.mul(low[i, k], low[j, k]))
            low[i, j] = f.call("sqrt", [s]) if i == j else f.mul(s, inverse[j])
        inverse.append(f.div(one, low[i, i]))
    found: dict[tuple[int, int], str] = {}
    for j in range(n):
        found[j, j] = inverse[j]
        for i in range(j + 1, n):
            s = f.mul(low[i, j], found[j, j])
            for k in range(j + 1, i):
                s = f.fma(low[i, k], found[k, j], s)
            found[i, j] = f.neg(f.mul(s, inverse[i]))
    for (i, j), value in found.items():
        f.store(value, W, i * pen.short + j)
        f.store(f.mul(value, mask[j]), WT, j * pen.short + i)


def _innovations(n: int, N: int, through: bool, width: int) -> str:
    pen = Pen("innovations", n, N, width)
    f, w = pen.f, width
    C = pen.words.integer("C")
    M2, nu = pen.room(N, w), pen.room(n, w)
    rows = [f.integer("mul", C, i) for i in range(n)]

    def column(name: str, t: str, b: str, c: str) -> str:
        place = f.integer("add", f.integer("mul", t, pen.B), b)
        return f.at(
            pen.inputs[name], f.integer("add", f.integer("mul", f.integer("mul", place, n), C), c)
        )

    blocks = pen.words.integer("blocks")
    follow = f.emit(f"icmp ne ptr {pen.inputs['track']}, null")

    def state(b: str, block: str) -> str:
        place = f.integer("add", f.integer("mul", b, blocks), block)
        return f.at(pen.inputs["state"], f.integer("mul", place, N * w))

    with f.loop(pen.B) as b, f.loop(blocks) as block:
        c, M = f.integer("mul", block, w), state(b, block)
        first, seen = column("r", "0", b, c), pen.at("seen", "0", b, n)
        for i in range(N):
            value = splat(0.0, w)
            if i < n:
                value = f.mul(f.load(first, rows[i], w), f.load_all(seen, i, w), w)
            f.store(value, M, i * w, w)
        with f.when(follow):
            to = column("track", "0", b, c)
            for i in range(n):
                f.store(f.load(M, i * w, w), to, rows[i], w)
    with f.loop(pen.L) as t, f.loop(pen.B) as b, f.loop(blocks) as block:
        c, M = f.integer("mul", block, w), state(b, block)
        later = f.integer("add", t, 1)
        A, K = pen.at("A", t, b, N * N), pen.at("K", t, b, N * n)
        seen, W = pen.at("seen", later, b, n), pen.at("W", t, b, n * n)
        d, r, out = column("d", t, b, c), column("r", later, b, c), column("out", t, b, c)
        pen.product((M2, N, w), (A, N, 1), (M, w), N)
        for i in range(n):
            ahead = f.add(f.load(M2, i * w, w), f.load(d, rows[i], w), w)
            f.store(ahead, M2, i * w, w)
            missed = f.sub(f.load(r, rows[i], w), ahead, w)
            f.store(f.mul(missed, f.load_all(seen, i, w), w), nu, i * w, w)
        pen.product((M, N, w), (K, n, 1), (nu, w), n, onto=M2)
        for i in range(n):
            total = splat(0.0, w)
            for k in range(i + 1):
                total = f.fma(f.load_all(W, i * n + k, w), f.load(nu, k * w, w), total, w)
            f.store(total, out, rows[i], w)
        with f.when(follow):
            to = column("track", later, b, c)
            for i in range(n):
                f.store(f.load(M, i * w, w), to, rows[i], w)
    return pen.end()


def _smoother(n: int, N: int, through: bool, width: int) -> str:
    pen = Pen("smoother", n, N, width)
    f, wide, short = pen.f, pen.wide, pen.short
    NK, D = pen.room(N, short), pen.room(n, short)
    A, K, W, G = pen.room(N, wide), pen.room(N, short), pen.room(n, short), pen.room(n, short)
    X, ut, spare = pen.room(N, wide), pen.room(1, short), pen.room(1, wide)
    with f.loop(pen.L, down=True) as t, f.loop(pen.B) as b:
        q = f.at(pen.inputs["state"], f.integer("mul", b, (N + 1) * wide))
        Nq = f.at(q, wide)
        raw = pen.at("K", t, b, N * n)
        rawW, white = pen.at("W", t, b, n * n), pen.at("white", t, b, n)
        seen = pen.at("seen", f.integer("add", t, 1), b, n)
        pen.copied(pen.at("A", t, b, N * N), N, A, wide, (N, N))
        pen.copied(raw, n, K, short, (N, n))
        pen.copied(rawW, n, W, short, (n, n))
        pen.product((NK, N, short), (Nq, wide, 1), (K, short), N)
        pen.product((D, n, short), (W, 1, short), (W, short), n)
        pen.product((D, n, short), (K, 1, short), (NK, short), N, onto=D)
        # u = W' white - K' q, as rows
        pen.product((ut, 1, short), (white, n, 1), (W, short), n)
        for i in range(N):
            f.store(f.neg(f.load(q, i)), spare, i)
        pen.product((ut, 1, short), (spare, wide, 1), (K, short), N, onto=ut)
        u_out, D_out = pen.at("u", t, b, n), pen.at("D", t, b, n)
        mask = [f.load(seen, i) for i in range(n)]
        for i in range(n):
            value = f.mul(f.load(ut, i), mask[i])
            f.store(value, u_out, i)
            f.store(f.mul(f.load(D, i * short + i), mask[i]), D_out, i)
            f.store(f.add(f.load(q, i), value), q, i)
        _measured(pen, Nq, NK, D, mask)
        _answer(pen, through, t, b, (q, Nq, G, X, ut))
        pen.product((X, N, wide), (Nq, wide, 1), (A, wide), N)
        pen.product((Nq, N, wide), (A, 1, wide), (X, wide), N)
        for i in range(N):  # what is not symmetric would grow, step by step
            for j in range(i):
                one, other = i * wide + j, j * wide + i
                mean = f.mul(f.add(f.load(Nq, one), f.load(Nq, other)), number(0.5))
                f.store(mean, Nq, one)
                f.store(mean, Nq, other)
        pen.product((spare, 1, wide), (q, wide, 1), (A, wide), N)
        for i in range(N):
            f.store(f.load(spare, i), q, i)
    return pen.end()


def _measured(pen: Pen, Nq: str, NK: str, D: str, mask: list[str]) -> None:
    """Nq <- Nq - NK H - H' NK' + H' D H in place, of what was seen."""
    f, n, wide, short = pen.f, pen.n, pen.wide, pen.short
    for j in range(n):
        for i in range(pen.N):
            k = f.mul(f.load(NK, i * short + j), mask[j])
            f.store(k, NK, i * short + j)
    for i in range(pen.N):
        for j in range(n):
            k = f.load(NK, i * short + j)
            place = i * wide + j
            f.store(f.sub(f.load(Nq, place), k), Nq, place)
            place = j * wide + i
            f.store(f.sub(f.load(Nq, place), k), Nq, place)
    for i in range(n):
        for j in range(n):
            both = f.mul(f.mul(mask[i], mask[j]), f.load(D, i * short + j))
            place = i * wide + j
            f.store(f.add(f.load(Nq, place), both), Nq, place)


def _answer(pen: Pen, through: bool, t: str, b: str, rooms: tuple[str, str, str, str, str]) -> None:
    """Stores r and the diagonal of N; through G, G' r and diag(G' N G)."""
    f, n, N, wide, short, w = pen.f, pen.n, pen.N, pen.wide, pen.short, pen.width
    q, Nq, G, X, spare = rooms
    r_out, N_out = pen.at("r", t, b, N), pen.at("N", t, b, N)
    for i in range(n if through else 0, N):
        f.store(f.load(q, i), r_out, i)
        f.store(f.load(Nq, i * wide + i), N_out, i)
    if not through:
        return
    raw = pen.at("G", t, b, n * n)
    pen.copied(raw, n, G, short, (n, n))
    pen.product((spare, 1, short), (q, wide, 1), (G, short), n)
    for i in range(n):
        f.store(f.load(spare, i), r_out, i)
    pen.product((X, n, short), (Nq, wide, 1), (G, short), n)
    for c in range(0, short, w):
        total = splat(0.0, w)
        for i in range(n):
            total = f.fma(f.load(G, i * short + c, w), f.load(X, i * short + c, w), total, w)
        f.store(total, spare, c, w)
    for i in range(n):
        f.store(f.load(spare, i), N_out, i)
