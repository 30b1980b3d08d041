"""The filter and the smoother as machine code, for a linearisation that is known.

The same recursions as in `recursion.py`, W trials side by side in the lanes of a vector, one
measured channel after the other (diagonal R), so that no matrix is inverted:

    b = P h,  s = h'b + r,  e = e0 - h'(x - xbar),  x += b e / s,  P -= b b' / s     each channel
    x = f + A (x - track),  P = A P A' + diag(q)                                     each step

and backwards, channels in reverse,

    z = e / s - g'r,  r += h z,  N += h (1/s + g'N g) h' - h (N g)' - (N g) h',          g = b / s
    r = A' r,         N = A' N A

Numbers lie as [group][time][entry][lane], the last trial repeated to fill its group. Rows of a
matrix are a loop, entries of a row are unrolled: the text grows with n^2.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from grounded.compile.emit.llvm_batch import Words
from grounded.compile.emit.llvm_text import Writer, declarations, splat
from grounded.compile.run import jit
from grounded.estimate.measurement import NoiseStd
from grounded.estimate.record import RecordBatch
from grounded.frozen import Array


def usable(T: int, n: int, ny: int) -> bool:
    """Whether the compiled recursions can run here, for these sizes."""
    return T > 0 and 0 < n <= LARGEST and 0 < ny <= LARGEST and not jit.trouble()


def pack(array: Array, width: int) -> Array:
    """(T, B, ...) to (G, T, size, W)."""
    T, B = array.shape[:2]
    flat = array.reshape(T, B, -1)
    missing = -B % width
    if missing:
        flat = np.concatenate([flat, np.repeat(flat[:, -1:], missing, axis=1)], axis=1)
    lanes = flat.reshape(T, -1, width, flat.shape[2]).transpose(1, 0, 3, 2)
    return np.ascontiguousarray(lanes)


def unpack(array: Array, B: int, *tail: int) -> Array:
    """(G, T, size, W) to (T, B, *tail)."""
    G, T, size, width = array.shape
    flat = array.transpose(1, 0, 3, 2).reshape(T, G * width, size)[:, :B]
    return np.ascontiguousarray(flat).reshape(T, B, *tail)


@dataclass(frozen=True, eq=False)
class LinearisedBatch:
    """A linearisation in lanes: f + A (x - track), h + H (x - xbar), and the batch's own arrays."""

    arrays: dict[str, Array]
    seen: NDArray[np.bool_]  # (G, T + 1, ny, W)
    dt: Array  # (G, T, 1, W), zero where not valid
    start_var: Array  # (G, n, W)
    start_channel: NDArray[np.int64]  # (G, n, W)
    weight: Array  # (G, 1, 1, W) 1 for a trial, 0 for a lane that only fills
    B: int

    @property
    def sizes(self) -> tuple[int, int, int, int, int]:
        """G, T, n, ny, W."""
        G, T, n, width = self.arrays["f"].shape
        return G, T, n, self.arrays["e0"].shape[2], width


@dataclass(frozen=True, eq=False)
class Pass:
    """What a forward pass leaves, in lanes."""

    linearised: LinearisedBatch
    out: dict[str, Array]
    r: Array  # (G, T + 1, ny, W) variance of the measurements, 1 where not seen
    loglik: float


def in_lanes(
    batch: RecordBatch,
    A: Array,
    f: Array,
    more: Array,
    track: Array,
    H: Array,
    e0: Array,
    xbar: Array,
) -> LinearisedBatch:
    """Packs a linearisation along a track.

    Args:
        batch: the records.
        A: (T, B, n, n), likewise f and track (T, B, n).
        f: what the model predicts from the track.
        more: variance added to the process noise (T, B, n).
        track: filtered states about which A holds.
        H: (T + 1, B, ny, n), rows of channels that were not seen are zero.
        e0: y - h(xbar), (T + 1, B, ny), zero where not seen.
        xbar: predicted states about which H holds, (T + 1, B, n).
    """
    width, B = jit.lanes(), len(batch.lengths)
    given = {"A": A, "f": f, "more": more, "track": track, "H": H, "e0": e0, "xbar": xbar}
    arrays = {name: pack(value, width) for name, value in given.items()}
    arrays["x0"] = pack(batch.start[None], width)[:, 0]
    dt = np.where(batch.valid, batch.dt, 0.0)[..., None]
    filled = np.arange(len(arrays["x0"]) * width) < B
    return LinearisedBatch(
        arrays=arrays,
        seen=pack(batch.seen.astype(float), width) > 0,
        dt=pack(dt, width),
        start_var=pack(batch.start_var[None], width)[:, 0],
        start_channel=pack(batch.start_channel[None].astype(float), width)[:, 0].astype(np.int64),
        weight=filled.astype(float).reshape(-1, 1, 1, width),
        B=B,
    )


def forward(lin: LinearisedBatch, noise: NoiseStd) -> Pass:
    """The filter along a linearisation."""
    from grounded.compile.run.compiled import call

    G, T, n, ny, width = lin.sizes
    R = noise.measurement**2
    r = np.where(lin.seen, R[:, None], 1.0)
    q = lin.dt * (noise.process**2 / noise.dt)[:, None] + lin.arrays["more"]
    channel = lin.start_channel
    P0 = lin.start_var + np.where(channel >= 0, R[np.maximum(channel, 0)], 0.0)
    shapes = {"x": n, "x_prior": n, "P_prior": n * n, "e": ny, "s": ny, "g": ny * n}
    out = {name: np.empty((G, T + 1, size, width)) for name, size in shapes.items()}
    given: dict[str, Any] = {"G": G, "T": T, "q": np.ascontiguousarray(q), "r": r, "P0": P0}
    call(recursion_library(n, ny)["forward"], FORWARD, given | lin.arrays | out)
    with np.errstate(all="ignore"):
        each = np.where(lin.seen, out["e"] ** 2 / out["s"] + np.log(2 * np.pi * out["s"]), 0.0)
        total = -0.5 * float(np.sum(each * lin.weight))
    return Pass(lin, out, r, total if np.isfinite(total) else -np.inf)


def posterior_std(done: Pass) -> Array:
    """Standard deviations of the filtered states (G, T + 1, n, W)."""
    _, _, n, ny, _ = done.linearised.sizes
    variance = done.out["P_prior"][:, :, :: n + 1].copy()
    for c in range(ny):
        gain = done.out["g"][:, :, c * n : (c + 1) * n]
        variance -= gain**2 * done.out["s"][:, :, c : c + 1]
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def backward(done: Pass) -> dict[str, Array]:
    """The smoother: `ry` (G, T+1, n, W), `Ny` (G, T+1, n n, W), `r_slope` (G, T+1, ny, W)."""
    from grounded.compile.run.compiled import call

    lin = done.linearised
    G, T, n, ny, width = lin.sizes
    shapes = {"ry": n, "Ny": n * n, "r_slope": ny}
    out = {name: np.empty((G, T + 1, size, width)) for name, size in shapes.items()}
    given: dict[str, Any] = {"G": G, "T": T, "A": lin.arrays["A"], "H": lin.arrays["H"]}
    given |= {name: done.out[name] for name in ("e", "s", "g")}
    call(recursion_library(n, ny)["backward"], BACKWARD, given | out)
    return out


def variance_slopes(done: Pass, noise: NoiseStd) -> Array:
    """Slope of the log-likelihood by the log variances of process and measurements, (n + ny,)."""
    back, lin = backward(done), done.linearised
    _, _, n, ny, _ = lin.sizes
    diagonal = back["Ny"][:, :, :: n + 1]
    half = 0.5 * (back["ry"] ** 2 - diagonal) * lin.weight
    by_q = np.sum(half[:, 1:] * lin.dt, axis=(0, 1, 3)) / noise.dt
    by_r = np.sum(np.where(lin.seen, back["r_slope"], 0.0) * lin.weight, axis=(0, 1, 3))
    for c in range(ny):
        by_r[c] += half[:, 0][lin.start_channel == c].sum()
    return np.concatenate([by_q * noise.process**2, by_r * noise.measurement**2])


LARGEST = 16  # states or channels; beyond, NumPy
SIZES = ("G", "T")
GIVEN = ("A", "f", "track", "q", "H", "e0", "xbar", "r", "x0", "P0")
FORWARD = (*SIZES, *GIVEN, "x", "x_prior", "P_prior", "e", "s", "g")
BACKWARD = (*SIZES, "A", "H", "e", "s", "g", "ry", "Ny", "r_slope")


@cache
def recursion_library(n: int, ny: int) -> Any:
    """The compiled `forward` and `backward` for n states and ny channels, W lanes."""
    text = Path(__file__).read_bytes()
    key = f"estimate {hashlib.sha256(text).hexdigest()} {jit.writers()} {n} {ny} {jit.lanes()}"

    def write() -> str:
        width = jit.lanes()
        return (
            declarations({width})
            + _Forward("forward", FORWARD, n, ny, width).text()
            + _Backward("backward", BACKWARD, n, ny, width).text()
        )

    return jit.library(key, write, ("forward", "backward"))


class _Kernel:
    """Arrays of W lanes with row loops; sizes n, ny; the table of words."""

    def __init__(self, name: str, names: tuple[str, ...], n: int, ny: int, width: int) -> None:
        self.n, self.ny, self.W = n, ny, width
        self.w = Writer(f"void @{name}(ptr %words)")
        words = Words(self.w, names)
        self.base = {key: words.pointer(key) for key in names if key not in SIZES}
        self.G, self.T = words.integer("G"), words.integer("T")
        self.rows = self.w.integer("add", self.T, 1)

    def load(self, base: str, index: int) -> str:
        return self.w.load(base, index * self.W, self.W)

    def store(self, value: str, base: str, index: int) -> None:
        self.w.store(value, base, index * self.W, self.W)

    def at(self, base: str, index: str, size: int) -> str:
        """The address of entry `index` of blocks of `size` entries."""
        return self.w.at(base, self.w.integer("mul", index, size * self.W))

    def dot(self, a: list[str], b: list[str], start: str | None = None) -> str:
        total = self.w.mul(a[0], b[0], self.W)
        if start is not None:
            total = self.w.add(total, start, self.W)
        for x, y in zip(a[1:], b[1:], strict=True):
            total = self.w.fma(x, y, total, self.W)
        return total

    def all(self, base: str, size: int) -> list[str]:
        return [self.load(base, i) for i in range(size)]

    def copy(self, source: str, to: str, size: int) -> None:
        with self.w.loop(size) as i:
            self.store(self.load(self.at(source, i, 1), 0), self.at(to, i, 1), 0)

    def time_of(self, name: str, g: str, t: str, size: int, rows: str) -> str:
        """The address of a trial group's entries at time t."""
        index = self.w.integer("add", self.w.integer("mul", g, rows), t)
        return self.at(self.base[name], index, size)

    def sandwich(self, A: str, P: str, room: str, transposed: bool) -> None:
        """P <- A P A', or A' P A, row by row through `room`."""
        n, w = self.n, self.w
        with w.loop(n) as i:
            row = [self.load(self.at(A, self._entry(i, k, transposed), 1), 0) for k in range(n)]
            to = self.at(room, i, n)
            for j in range(n):
                column = [self.load(P, k * n + j) for k in range(n)]
                self.store(self.dot(row, column), to, j)
        with w.loop(n) as i:
            source, to = self.at(room, i, n), self.at(P, i, n)
            row = self.all(source, n)
            for j in range(n):
                other = [self.load(A, k * n + j if transposed else j * n + k) for k in range(n)]
                self.store(self.dot(row, other), to, j)

    def _entry(self, i: str, k: int, transposed: bool) -> str:
        if transposed:
            return self.w.integer("add", i, k * self.n)
        return self.w.integer("add", self.w.integer("mul", i, self.n), k)


class _Forward(_Kernel):
    def text(self) -> str:
        w, n, W = self.w, self.n, self.W
        x, P, M, b = w.room(n * W), w.room(n * n * W), w.room(n * n * W), w.room(n * W)
        with w.loop(self.G) as g:
            self._start(g, x, P)
            with w.loop(self.rows) as t:
                self.copy(x, self.time_of("x_prior", g, t, n, self.rows), n)
                self.copy(P, self.time_of("P_prior", g, t, n * n, self.rows), n * n)
                self._update(g, t, x, P, b)
                self.copy(x, self.time_of("x", g, t, n, self.rows), n)
                more = w.emit(f"icmp slt i64 {t}, {self.T}")
                with w.when(more):
                    self._predict(g, t, x, P, M)
        w.do("ret void")
        return w.text()

    def _start(self, g: str, x: str, P: str) -> None:
        n, w = self.n, self.w
        self.copy(self.at(self.base["x0"], g, n), x, n)
        with w.loop(n * n) as i:
            self.store(splat(0.0, self.W), self.at(P, i, 1), 0)
        source = self.at(self.base["P0"], g, n)
        for j in range(n):
            self.store(self.load(source, j), P, j * n + j)

    def _update(self, g: str, t: str, x: str, P: str, b: str) -> None:
        n, ny, w, W = self.n, self.ny, self.w, self.W
        H, xbar = (
            self.time_of("H", g, t, ny * n, self.rows),
            self.time_of("xbar", g, t, n, self.rows),
        )
        e0, r = (self.time_of(key, g, t, ny, self.rows) for key in ("e0", "r"))
        e_out, s_out = (self.time_of(key, g, t, ny, self.rows) for key in ("e", "s"))
        g_out = self.time_of("g", g, t, ny * n, self.rows)
        with w.loop(ny) as c:
            h = self.all(self.at(H, c, n), n)
            with w.loop(n) as i:
                value = self.dot(self.all(self.at(P, i, n), n), h)
                self.store(value, self.at(b, i, 1), 0)
            bs = self.all(b, n)
            s = self.dot(h, bs, self.load(self.at(r, c, 1), 0))
            moved = [w.sub(self.load(x, i), self.load(xbar, i), W) for i in range(n)]
            e = w.sub(self.load(self.at(e0, c, 1), 0), self.dot(h, moved), W)
            inverse = w.div(splat(1.0, W), s, W)
            gains = [w.mul(value, inverse, W) for value in bs]
            row = self.at(g_out, c, n)
            for j in range(n):
                self.store(w.fma(gains[j], e, self.load(x, j), W), x, j)
                self.store(gains[j], row, j)
            self.store(e, self.at(e_out, c, 1), 0)
            self.store(s, self.at(s_out, c, 1), 0)
            with w.loop(n) as i:
                gain = w.neg(self.load(self.at(row, i, 1), 0), W)
                line = self.at(P, i, n)
                for j in range(n):
                    self.store(w.fma(gain, bs[j], self.load(line, j), W), line, j)

    def _predict(self, g: str, t: str, x: str, P: str, M: str) -> None:
        n, w, W = self.n, self.w, self.W
        A = self.time_of("A", g, t, n * n, self.T)
        f, track, q = (self.time_of(key, g, t, n, self.T) for key in ("f", "track", "q"))
        moved = [w.sub(self.load(x, i), self.load(track, i), W) for i in range(n)]
        with w.loop(n) as i:
            value = self.dot(self.all(self.at(A, i, n), n), moved, self.load(self.at(f, i, 1), 0))
            self.store(value, self.at(x, i, 1), 0)
        self.sandwich(A, P, M, transposed=False)
        for j in range(n):
            self.store(w.add(self.load(P, j * n + j), self.load(q, j), W), P, j * n + j)


class _Backward(_Kernel):
    def text(self) -> str:
        w, n, W = self.w, self.n, self.W
        r, N, M, v = w.room(n * W), w.room(n * n * W), w.room(n * n * W), w.room(n * W)
        with w.loop(self.G) as g:
            for base, size in ((r, n), (N, n * n)):
                with w.loop(size) as i:
                    self.store(splat(0.0, W), self.at(base, i, 1), 0)
            with w.loop(self.rows, down=True) as t:
                more = w.emit(f"icmp slt i64 {t}, {self.T}")
                with w.when(more):
                    self._back(g, t, r, N, M, v)
                self._channels(g, t, r, N, v)
                self.copy(r, self.time_of("ry", g, t, n, self.rows), n)
                self.copy(N, self.time_of("Ny", g, t, n * n, self.rows), n * n)
        w.do("ret void")
        return w.text()

    def _back(self, g: str, t: str, r: str, N: str, M: str, v: str) -> None:
        n, w = self.n, self.w
        A = self.time_of("A", g, t, n * n, self.T)
        values = self.all(r, n)
        with w.loop(n) as i:
            column = [self.load(self.at(A, self._entry(i, k, True), 1), 0) for k in range(n)]
            self.store(self.dot(column, values), self.at(v, i, 1), 0)
        self.copy(v, r, n)
        self.sandwich(A, N, M, transposed=True)

    def _channels(self, g: str, t: str, r: str, N: str, v: str) -> None:
        n, ny, w, W = self.n, self.ny, self.w, self.W
        H, gains = (self.time_of(key, g, t, ny * n, self.rows) for key in ("H", "g"))
        e, s = (self.time_of(key, g, t, ny, self.rows) for key in ("e", "s"))
        slope = self.time_of("r_slope", g, t, ny, self.rows)
        one = splat(1.0, W)
        with w.loop(ny, down=True) as c:
            h, k = self.all(self.at(H, c, n), n), self.all(self.at(gains, c, n), n)
            inverse = w.div(one, self.load(self.at(s, c, 1), 0), W)
            ahead = self.dot(k, self.all(r, n))
            z = w.sub(w.mul(self.load(self.at(e, c, 1), 0), inverse, W), ahead, W)
            with w.loop(n) as i:
                self.store(self.dot(self.all(self.at(N, i, n), n), k), self.at(v, i, 1), 0)
            Ng = self.all(v, n)
            D = self.dot(k, Ng, inverse)
            half = w.mul(splat(0.5, W), w.sub(w.mul(z, z, W), D, W), W)
            self.store(half, self.at(slope, c, 1), 0)
            for j in range(n):
                self.store(w.fma(h[j], z, self.load(r, j), W), r, j)
            source = self.at(H, c, n)
            with w.loop(n) as i:
                hi, ni = self.load(self.at(source, i, 1), 0), self.load(self.at(v, i, 1), 0)
                left = w.sub(w.mul(hi, D, W), ni, W)  # D h_i - (N g)_i
                line, down = self.at(N, i, n), w.neg(hi, W)
                for j in range(n):
                    value = w.fma(left, h[j], self.load(line, j), W)
                    self.store(w.fma(down, Ng[j], value, W), line, j)
