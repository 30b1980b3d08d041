"""Kernel: W runs of a problem side by side, one for each step length alpha; or one run by itself.

    u_t = clip( ubar_t + alpha k_t + K_t (z_t - zbar_t) )
    x_{t+1} = f(x_t, u_eff_t - shift_t) + bias_t

with the cost added up on the way. The lanes share the trajectory's data and differ in alpha; with
fewer runs than lanes, one is repeated and not stored. K, zbar and k may be null, z and u too: then
the cost is all that is wanted. A run by itself has room in its vectors: what is done for every
state or input alike is done for four at once, and so are sines and exponentials of the model.
"""

from __future__ import annotations

import math

from grounded.compile.emit.llvm_batch import Words, start_table
from grounded.compile.emit.llvm_step import Dynamics, StepWriter
from grounded.compile.emit.llvm_text import Writer, splat
from grounded.compile.emit.llvm_transpose import transposed
from grounded.compile.kernel_words import ROLLOUT, Layout

Piece = tuple[int, int]  # of a row of numbers: the first, and how many
BLOCK = 4  # numbers of a row that are taken at once


def wrap(f: Writer, d: str, width: int) -> str:
    """An angle's difference in [-pi, pi]."""
    turns = f.call("rint", [f.mul(d, splat(0.5 / math.pi, width), width)], width)
    return f.sub(d, f.mul(turns, splat(2 * math.pi, width), width), width)


def received(
    f: Writer, words: Words, layout: Layout, z: list[str], u: list[str], width: int
) -> list[str]:
    """What the actuators receive of u_t and the past inputs."""
    now, past, D = words.pointer("now"), words.pointer("past"), layout.nz - layout.n
    sent = []
    for j in range(layout.m):
        if layout.prompt[j]:
            sent.append(u[j])
            continue
        value = f.mul(f.load_all(now, j, width), u[j], width)
        for i in range(layout.depths[j]):
            slot = layout.slot(j, i)
            weight = f.load_all(past, j * D + slot - layout.n, width)
            value = f.fma(weight, z[slot], value, width)
        sent.append(value)
    return sent


def rollout_kernel(d: Dynamics, layout: Layout, name: str, lanes: int) -> str:
    """`void @name(words)`."""
    f = Writer(f"void @{name}(ptr %words)")
    writer = _Rollout(f, d, layout, lanes)
    with f.loop(writer.words.integer("H")) as t:
        writer.control(t)
        writer.save(t)
        writer.advance(t)
    writer.finish()
    f.do("ret void")
    return f.text()


def single_rollout(d: Dynamics, layout: Layout) -> str:
    """`void @rollout(words)`: one run; of a short model it takes as long as four at once."""
    if not d.short:
        return rollout_kernel(d, layout, "rollout", 1)
    f = Writer("void @rollout(ptr %words)")
    f.do("call void @rollouts(ptr %words)")
    f.do("ret void")
    return f.text()


class _Rollout:
    """The parts of the kernel; lanes' data live in small arrays on the stack, [entries][lanes].

    What is done for each entry alike is done for some at once where there is only one lane.
    """

    def __init__(self, f: Writer, d: Dynamics, layout: Layout, lanes: int) -> None:
        self.f, self.layout, self.words, self.lanes = f, layout, Words(f, ROLLOUT), lanes
        self.step = StepWriter(f, d, lanes, start_table(f, self.words, d))
        self.wide = BLOCK if lanes == 1 else 1
        self.z, self.u = f.room(layout.nz * lanes), f.room(layout.m * lanes)
        self.step.x = self.z  # the state comes first in z
        self.alpha = f.load(self.words.pointer("alphas"), 0, lanes)
        self.costs = {width: f.room(width) for width in {lanes, self.wide * lanes}}
        start = self.words.pointer("start")
        for i in range(layout.nz):
            f.store(f.load_all(start, i, lanes), self.z, i * lanes, lanes)
        for width, room in self.costs.items():
            f.store(splat(0.0, width), room, 0, width)

    def _cut(self, size: int) -> list[Piece]:
        """Entries 0 .. size - 1 in blocks, and what is left one by one."""
        whole = size - size % self.wide
        blocks = [(at, self.wide) for at in range(0, whole, self.wide)]
        return [*blocks, *((at, 1) for at in range(whole, size))]

    def _inputs(self) -> list[Piece]:
        """The inputs in blocks whose last values lie side by side, too."""
        depths = self.layout.depths
        return (
            self._cut(len(depths)) if set(depths) == {1} else [(j, 1) for j in range(len(depths))]
        )

    def _own(self, base: str, piece: Piece) -> str:
        """Entries of the lanes' data."""
        at, count = piece
        return self.f.load(base, at * self.lanes, count * self.lanes)

    def _given(self, row: str, piece: Piece) -> str:
        """Entries of what all lanes are given."""
        at, count = piece
        return self.f.load(row, at, count) if count > 1 else self.f.load_all(row, at, self.lanes)

    def _keep(self, value: str, base: str, piece: Piece) -> None:
        self.f.store(value, base, piece[0] * self.lanes, piece[1] * self.lanes)

    def _add_cost(self, terms: list[tuple[str, str, int]]) -> None:
        """Adds weight * error^2, of so many numbers at once."""
        f = self.f
        for width, room in self.costs.items():
            total = f.load(room, 0, width)
            for weight, error, count in terms:
                if count == width:
                    total = f.fma(f.mul(weight, error, width), error, total, width)
            f.store(total, room, 0, width)

    def _difference(self, row: str, piece: Piece) -> str:
        """What z has more than another one, angles wrapped."""
        f, (at, count) = self.f, piece
        width = count * self.lanes
        e = f.sub(self._own(self.z, piece), self._given(row, piece), width)
        angles = [i < self.layout.n and self.layout.angles[i] for i in range(at, at + count)]
        if not any(angles):
            return e
        wrapped = wrap(f, e, width)
        if all(angles):
            return wrapped
        bits = ", ".join(f"i1 {int(angle)}" for angle in angles)
        return f.select(f"<{bits}>", wrapped, e, width)

    def _tracking(self, t: str) -> None:
        n = self.layout.n
        target, weight = self.words.row("target", t, n), self.words.row("weight", t, n)
        self._add_cost(
            [
                (self._given(weight, piece), self._difference(target, piece), piece[1] * self.lanes)
                for piece in self._cut(n)
            ]
        )

    def control(self, t: str) -> None:
        """The inputs of step t and the cost of being there."""
        f, layout = self.f, self.layout
        self._tracking(t)
        ubar = self.words.row("ubar", t, layout.m)
        for piece in self._inputs():
            self._keep(self._given(ubar, piece), self.u, piece)
        with f.when(f.emit(f"icmp ne ptr {self.words.pointer('k')}, null")):
            k = self.words.row("k", t, layout.m)
            for piece in self._inputs():
                width = piece[1] * self.lanes
                alpha = f.spread(self.alpha, width) if self.lanes == 1 else self.alpha
                u = f.fma(alpha, self._given(k, piece), self._own(self.u, piece), width)
                self._keep(u, self.u, piece)
        with f.when(f.emit(f"icmp ne ptr {self.words.pointer('K')}, null")):
            self._feedback(t)
        self._clip(t)

    def _feedback(self, t: str) -> None:
        f, layout = self.f, self.layout
        zbar, K = self.words.row("zbar", t, layout.nz), self.words.row("K", t, layout.m * layout.nz)
        dz = [(piece, self._difference(zbar, piece)) for piece in self._cut(layout.nz)]
        for piece in self._inputs():
            at, count = piece
            rows = [self._row(f.at(K, j * layout.nz), dz) for j in range(at, at + count)]
            width = count * self.lanes
            u = f.add(self._own(self.u, piece), self._sums(rows), width)
            self._keep(u, self.u, piece)

    def _row(self, row: str, dz: list[tuple[Piece, str]]) -> dict[int, str]:
        """A row of K times dz: sums of so many numbers at once."""
        f, found = self.f, dict[int, str]()
        for width in self.costs:
            terms = [(piece, e) for piece, e in dz if piece[1] * self.lanes == width]
            sums = [""] * 4  # short chains
            for i, (piece, e) in enumerate(terms):
                gain, old = self._given(row, piece), sums[i % 4]
                sums[i % 4] = f.fma(gain, e, old, width) if old else f.mul(gain, e, width)
            if terms:
                found[width] = self._total([value for value in sums if value], width)
        return found

    def _sums(self, rows: list[dict[int, str]]) -> str:
        """The sums of rows, as lanes of a vector if they are several."""
        f, one, count = self.f, self.lanes, len(rows)
        wide, parts = self.wide * one, list[str]()
        if wide > one and wide in rows[0]:
            whole = [row[wide] for row in rows]
            alone = [f.lane(whole[0], i, wide) for i in range(wide)] if count == 1 else []
            parts += alone or transposed(f, whole)
        if one in rows[0]:
            rest = [row[one] for row in rows]
            parts.append(f.vector_of(rest) if count > 1 else rest[0])
        return self._total(parts, count * one)

    def _total(self, parts: list[str], width: int) -> str:
        """Sum by pairs."""
        while len(parts) > 1:
            pairs = zip(parts[::2], parts[1::2], strict=False)
            parts = [self.f.add(a, b, width) for a, b in pairs] + parts[len(parts) // 2 * 2 :]
        return parts[0]

    def _clip(self, t: str) -> None:
        f, layout, terms = self.f, self.layout, []
        target = self.words.row("input_target", t, layout.m)
        for piece in self._inputs():
            at, count = piece
            width, slot = count * self.lanes, (layout.slot(at), count)
            u = self._own(self.u, piece)
            low, high, R, S = (
                self._given(self.words.pointer(name), piece) for name in ("low", "high", "R", "S")
            )
            u = f.select(f.compare("olt", u, low, width), low, u, width)
            u = f.select(f.compare("ogt", u, high, width), high, u, width)
            self._keep(u, self.u, piece)
            terms.append((R, f.sub(u, self._given(target, piece), width), width))
            terms.append((S, f.sub(u, self._own(self.z, slot), width), width))
        self._add_cost(terms)

    def save(self, t: str, last: bool = False) -> None:
        """Stores z_t and u_t of the runs that were asked for."""
        f, layout, H = self.f, self.layout, self.words.integer("H")
        z, u = self.words.pointer("z"), self.words.pointer("u")
        wanted = f.emit(f"icmp ne ptr {z}, null")
        with f.when(wanted), f.loop(self.words.integer("runs")) as run:
            row = f.integer("add", f.integer("mul", run, f.integer("add", H, 1)), t)
            self._copy(f.at(self.z, run), f.at(z, f.integer("mul", row, layout.nz)), layout.nz)
            if not last:
                row = f.integer("add", f.integer("mul", run, H), t)
                self._copy(f.at(self.u, run), f.at(u, f.integer("mul", row, layout.m)), layout.m)

    def _copy(self, lane: str, to: str, size: int) -> None:
        """The entries of one lane."""
        for at, count in self._cut(size):
            self.f.store(self.f.load(lane, at * self.lanes, count), to, at, count)

    def advance(self, t: str) -> None:
        """From z_t to z_{t+1}."""
        f, layout, step, lanes = self.f, self.layout, self.step, self.lanes
        z = [self._own(self.z, (i, 1)) for i in range(layout.nz)]
        u = [self._own(self.u, (j, 1)) for j in range(layout.m)]
        shift = self.words.row("shift", t, layout.m)
        for j, value in enumerate(received(f, self.words, layout, z, u, lanes)):
            f.store(f.sub(value, f.load_all(shift, j, lanes), lanes), step.u, j * lanes, lanes)
        for j, depth in enumerate(layout.depths):
            for i in range(depth):
                later = z[layout.slot(j, i - 1)] if i else u[j]
                f.store(later, self.z, layout.slot(j, i) * lanes, lanes)
        bias, values = self.words.row("bias", t, layout.n), step.step()
        for at, count in self._cut(layout.n):
            value = f.vector_of(values[at : at + count]) if count > 1 else values[at]
            x = f.add(value, self._given(bias, (at, count)), count * lanes)
            self._keep(x, self.z, (at, count))

    def finish(self) -> None:
        """The end state and its cost."""
        f, H, lanes = self.f, self.words.integer("H"), self.lanes
        self._tracking(H)
        self.save(H, last=True)
        total, wide = self.costs[lanes], self.wide * lanes
        if wide > lanes:
            parts = [f.load(self.costs[wide], i) for i in range(wide)]
            f.store(self._total([f.load(total), *parts], 1), total)
        with f.loop(self.words.integer("runs")) as run:
            f.store(f.load(total, run), self.words.pointer("cost"), run)
