"""Kernel: runs of a problem side by side, LANES at most, one for each step length alpha.

    u_t = clip( ubar_t + alpha k_t + K_t (z_t - zbar_t) )
    x_{t+1} = f(x_t, u_eff_t - shift_t) + bias_t

with the cost added up on the way. The lanes share the trajectory's data and differ in alpha; with
fewer runs than lanes, one is repeated and not stored. K, zbar and k may be null, z and u too: then
the cost is all that is wanted.
"""

from __future__ import annotations

import math

from grounded.compile.emit.llvm_batch import Words, start_table
from grounded.compile.emit.llvm_step import Dynamics, StepWriter
from grounded.compile.emit.llvm_text import Writer, splat
from grounded.compile.kernel_words import LANES, ROLLOUT, Layout


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


def rollout_kernel(d: Dynamics, layout: Layout) -> str:
    """`void @rollout(words)`."""
    f = Writer("void @rollout(ptr %words)")
    writer = _Rollout(f, d, layout, LANES)
    with f.loop(writer.words.integer("H")) as t:
        writer.control(t)
        writer.save(t)
        writer.advance(t)
    writer.finish()
    f.do("ret void")
    return f.text()


class _Rollout:
    """The parts of the kernel; lanes' data live in small arrays on the stack, [entries][lanes]."""

    def __init__(self, f: Writer, d: Dynamics, layout: Layout, lanes: int) -> None:
        self.f, self.layout, self.words, self.lanes = f, layout, Words(f, ROLLOUT), lanes
        self.step = StepWriter(f, d, lanes, start_table(f, self.words, d))
        self.z, self.u = f.room(layout.nz * lanes), f.room(layout.m * lanes)
        self.step.x = self.z  # the state comes first in z
        self.alpha = f.load(self.words.pointer("alphas"), 0, lanes)
        self.total = f.room(lanes)
        start = self.words.pointer("start")
        for i in range(layout.nz):
            self._keep(self._given(start, i), self.z, i)
        f.store(splat(0.0, lanes), self.total, 0, lanes)

    def _own(self, base: str, i: int) -> str:
        """An entry of the lanes' data."""
        return self.f.load(base, i * self.lanes, self.lanes)

    def _given(self, row: str, i: int) -> str:
        """An entry of what all lanes are given."""
        return self.f.load_all(row, i, self.lanes)

    def _keep(self, value: str, base: str, i: int) -> None:
        self.f.store(value, base, i * self.lanes, self.lanes)

    def _sum(self, factors: list[tuple[str, str]]) -> str:
        """The sum of products."""
        total = self.f.mul(*factors[0], self.lanes)
        for a, b in factors[1:]:
            total = self.f.fma(a, b, total, self.lanes)
        return total

    def _add_cost(self, terms: list[tuple[str, str]]) -> None:
        """Adds the sum of weight * error^2."""
        f, lanes = self.f, self.lanes
        cost = self._sum([(f.mul(weight, e, lanes), e) for weight, e in terms])
        self._keep(f.add(self._own(self.total, 0), cost, lanes), self.total, 0)

    def _difference(self, row: str, i: int) -> str:
        """What z has more than another one, an angle wrapped."""
        e = self.f.sub(self._own(self.z, i), self._given(row, i), self.lanes)
        angle = i < self.layout.n and self.layout.angles[i]
        return wrap(self.f, e, self.lanes) if angle else e

    def _tracking(self, t: str) -> None:
        n = self.layout.n
        target, weight = self.words.row("target", t, n), self.words.row("weight", t, n)
        self._add_cost([(self._given(weight, i), self._difference(target, i)) for i in range(n)])

    def control(self, t: str) -> None:
        """The inputs of step t and the cost of being there."""
        f, m = self.f, self.layout.m
        self._tracking(t)
        ubar = self.words.row("ubar", t, m)
        for j in range(m):
            self._keep(self._given(ubar, j), self.u, j)
        with f.when(f.given(self.words.pointer("k"))):
            k = self.words.row("k", t, m)
            for j in range(m):
                u = f.fma(self.alpha, self._given(k, j), self._own(self.u, j), self.lanes)
                self._keep(u, self.u, j)
        with f.when(f.given(self.words.pointer("K"))):
            self._feedback(t)
        self._clip(t)

    def _feedback(self, t: str) -> None:
        f, m, nz = self.f, self.layout.m, self.layout.nz
        zbar, K = self.words.row("zbar", t, nz), self.words.row("K", t, m * nz)
        dz = [self._difference(zbar, i) for i in range(nz)]
        for j in range(m):
            more = self._sum([(self._given(K, j * nz + i), e) for i, e in enumerate(dz)])
            self._keep(f.add(self._own(self.u, j), more, self.lanes), self.u, j)

    def _clip(self, t: str) -> None:
        f, layout, lanes, terms = self.f, self.layout, self.lanes, []
        target = self.words.row("input_target", t, layout.m)
        for j in range(layout.m):
            low, high, R, S = (
                self._given(self.words.pointer(name), j) for name in ("low", "high", "R", "S")
            )
            u = self._own(self.u, j)
            u = f.select(f.compare("olt", u, low, lanes), low, u, lanes)
            u = f.select(f.compare("ogt", u, high, lanes), high, u, lanes)
            self._keep(u, self.u, j)
            terms.append((R, f.sub(u, self._given(target, j), lanes)))
            terms.append((S, f.sub(u, self._own(self.z, layout.slot(j)), lanes)))
        self._add_cost(terms)

    def save(self, t: str, last: bool = False) -> None:
        """Stores z_t and u_t of the runs that were asked for."""
        f, layout, H = self.f, self.layout, self.words.integer("H")
        z, u = self.words.pointer("z"), self.words.pointer("u")
        with f.when(f.given(z)), f.loop(self.words.integer("runs")) as run:
            row = f.integer("add", f.integer("mul", run, f.integer("add", H, 1)), t)
            self._copy(f.at(self.z, run), f.at(z, f.integer("mul", row, layout.nz)), layout.nz)
            if not last:
                row = f.integer("add", f.integer("mul", run, H), t)
                self._copy(f.at(self.u, run), f.at(u, f.integer("mul", row, layout.m)), layout.m)

    def _copy(self, lane: str, to: str, size: int) -> None:
        """The entries of one lane."""
        for i in range(size):
            self.f.store(self.f.load(lane, i * self.lanes), to, i)

    def advance(self, t: str) -> None:
        """From z_t to z_{t+1}."""
        f, layout, step, lanes = self.f, self.layout, self.step, self.lanes
        z = [self._own(self.z, i) for i in range(layout.nz)]
        u = [self._own(self.u, j) for j in range(layout.m)]
        shift = self.words.row("shift", t, layout.m)
        for j, value in enumerate(received(f, self.words, layout, z, u, lanes)):
            self._keep(f.sub(value, self._given(shift, j), lanes), step.u, j)
        for j, depth in enumerate(layout.depths):
            for i in range(depth):
                later = z[layout.slot(j, i - 1)] if i else u[j]
                self._keep(later, self.z, layout.slot(j, i))
        bias = self.words.row("bias", t, layout.n)
        for i, value in enumerate(step.step()):
            self._keep(f.add(value, self._given(bias, i), lanes), self.z, i)

    def finish(self) -> None:
        """The end state and its cost."""
        f, H = self.f, self.words.integer("H")
        self._tracking(H)
        self.save(H, last=True)
        with f.loop(self.words.integer("runs")) as run:
            f.store(f.load(self.total, run), self.words.pointer("cost"), run)
