"""Kernel: W runs of a problem side by side, one for each step length alpha.

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
    writer = _Rollout(f, d, layout)
    with f.loop(writer.words.integer("H")) as t:
        writer.control(t)
        writer.save(t)
        writer.advance(t)
    writer.finish()
    f.do("ret void")
    return f.text()


class _Rollout:
    """The parts of the kernel; lanes' data live in small arrays on the stack."""

    def __init__(self, f: Writer, d: Dynamics, layout: Layout) -> None:
        self.f, self.layout, self.words = f, layout, Words(f, ROLLOUT)
        self.step = StepWriter(f, d, LANES, start_table(f, self.words, d))
        self.z, self.u = f.room(layout.nz * LANES), f.room(layout.m * LANES)
        self.step.x = self.z  # the state comes first in z
        self.cost, self.alpha = f.room(LANES), f.load(self.words.pointer("alphas"), 0, LANES)
        start = self.words.pointer("start")
        for i in range(layout.nz):
            f.store(f.load_all(start, i, LANES), self.z, i * LANES, LANES)
        f.store(splat(0.0, LANES), self.cost, 0, LANES)

    def _all(self, at: str, size: int) -> list[str]:
        return [self.f.load(at, i * LANES, LANES) for i in range(size)]

    def _add_cost(self, terms: list[tuple[str, str]]) -> None:
        """Adds weight * error^2."""
        f, total = self.f, self.f.load(self.cost, 0, LANES)
        for weight, error in terms:
            total = f.fma(f.mul(weight, error, LANES), error, total, LANES)
        f.store(total, self.cost, 0, LANES)

    def _tracking(self, t: str) -> None:
        f, n = self.f, self.layout.n
        target, weight = self.words.row("target", t, n), self.words.row("weight", t, n)
        terms = []
        for i in range(n):
            e = f.sub(f.load(self.z, i * LANES, LANES), f.load_all(target, i, LANES), LANES)
            e = wrap(f, e, LANES) if self.layout.angles[i] else e
            terms.append((f.load_all(weight, i, LANES), e))
        self._add_cost(terms)

    def control(self, t: str) -> None:
        """The inputs of step t and the cost of being there."""
        f, layout = self.f, self.layout
        self._tracking(t)
        ubar = self.words.row("ubar", t, layout.m)
        for j in range(layout.m):
            f.store(f.load_all(ubar, j, LANES), self.u, j * LANES, LANES)
        with f.when(f.emit(f"icmp ne ptr {self.words.pointer('k')}, null")):
            k = self.words.row("k", t, layout.m)
            for j in range(layout.m):
                u = f.load(self.u, j * LANES, LANES)
                u = f.fma(self.alpha, f.load_all(k, j, LANES), u, LANES)
                f.store(u, self.u, j * LANES, LANES)
        with f.when(f.emit(f"icmp ne ptr {self.words.pointer('K')}, null")):
            self._feedback(t)
        self._clip(t)

    def _feedback(self, t: str) -> None:
        f, layout = self.f, self.layout
        zbar, K = self.words.row("zbar", t, layout.nz), self.words.row("K", t, layout.m * layout.nz)
        dz = []
        for i in range(layout.nz):
            e = f.sub(f.load(self.z, i * LANES, LANES), f.load_all(zbar, i, LANES), LANES)
            dz.append(wrap(f, e, LANES) if i < layout.n and layout.angles[i] else e)
        for j in range(layout.m):
            sums = [f.load(self.u, j * LANES, LANES), *[splat(0.0, LANES)] * 3]  # short chains
            for i, e in enumerate(dz):
                gain = f.load_all(K, j * layout.nz + i, LANES)
                sums[i % 4] = f.fma(gain, e, sums[i % 4], LANES)
            pair = [f.add(sums[i], sums[i + 2], LANES) for i in (0, 1)]
            f.store(f.add(pair[0], pair[1], LANES), self.u, j * LANES, LANES)

    def _clip(self, t: str) -> None:
        f, layout, terms = self.f, self.layout, []
        target = self.words.row("input_target", t, layout.m)
        for j in range(layout.m):
            u = f.load(self.u, j * LANES, LANES)
            low, high, R, S = (
                f.load_all(self.words.pointer(name), j, LANES) for name in ("low", "high", "R", "S")
            )
            u = f.select(f.compare("olt", u, low, LANES), low, u, LANES)
            u = f.select(f.compare("ogt", u, high, LANES), high, u, LANES)
            f.store(u, self.u, j * LANES, LANES)
            before = f.load(self.z, layout.slot(j) * LANES, LANES)
            terms.append((R, f.sub(u, f.load_all(target, j, LANES), LANES)))
            terms.append((S, f.sub(u, before, LANES)))
        self._add_cost(terms)

    def save(self, t: str, last: bool = False) -> None:
        """Stores z_t and u_t of the runs that were asked for."""
        f, layout, H = self.f, self.layout, self.words.integer("H")
        z, u = self.words.pointer("z"), self.words.pointer("u")
        wanted = f.emit(f"icmp ne ptr {z}, null")
        with f.when(wanted), f.loop(self.words.integer("runs")) as run:
            row = f.integer("add", f.integer("mul", run, f.integer("add", H, 1)), t)
            to = f.at(z, f.integer("mul", row, layout.nz))
            lane = f.at(self.z, run)
            for i in range(layout.nz):
                f.store(f.load(lane, i * LANES), to, i)
            if not last:
                row = f.integer("add", f.integer("mul", run, H), t)
                to, lane = f.at(u, f.integer("mul", row, layout.m)), f.at(self.u, run)
                for j in range(layout.m):
                    f.store(f.load(lane, j * LANES), to, j)

    def advance(self, t: str) -> None:
        """From z_t to z_{t+1}."""
        f, layout, step = self.f, self.layout, self.step
        z, u = self._all(self.z, layout.nz), self._all(self.u, layout.m)
        shift = self.words.row("shift", t, layout.m)
        for j, value in enumerate(received(f, self.words, layout, z, u, LANES)):
            f.store(f.sub(value, f.load_all(shift, j, LANES), LANES), step.u, j * LANES, LANES)
        for j, depth in enumerate(layout.depths):
            for i in range(depth):
                later = z[layout.slot(j, i - 1)] if i else u[j]
                f.store(later, self.z, layout.slot(j, i) * LANES, LANES)
        bias = self.words.row("bias", t, layout.n)
        for i, value in enumerate(step.step()):
            x = f.add(value, f.load_all(bias, i, LANES), LANES)
            f.store(x, self.z, i * LANES, LANES)

    def finish(self) -> None:
        """The end state and its cost."""
        f, H = self.f, self.words.integer("H")
        self._tracking(H)
        self.save(H, last=True)
        with f.loop(self.words.integer("runs")) as run:
            f.store(f.load(self.cost, run), self.words.pointer("cost"), run)
