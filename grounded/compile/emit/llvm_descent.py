"""Kernel: the whole loop of `ddp.solve`, the compiled twin of `ddp.descended`.

It calls the rollout and the sweep with their own tables of words, in which it exchanges the
trajectories: z0, u0 and z1, u1 are the current one and the next, by turns. Shorter step lengths are
tried four at a time for their cost alone; the one that is accepted is then run again and stored.
Sums that decide are rounded as NumPy rounds them: the twins take the same decisions.
"""

from __future__ import annotations

from grounded.compile.emit.llvm_batch import Words
from grounded.compile.emit.llvm_text import Writer, number
from grounded.compile.kernel_words import (
    COST,
    COUNT,
    DESCENT,
    FAILED_AT,
    LANES,
    ROLLOUT,
    SWEEP,
    TURN,
)
from grounded.compile.problem import (
    CEILING,
    FLOOR,
    GROWTH,
    LARGE_MU,
    NO_CHANGE,
    SEARCH_FLOOR,
    STATUSES,
    Status,
)

ZERO, ONE, INFINITY = number(0.0), number(1.0), number(float("inf"))
ENDLESS = 2**62


def descent_kernel(m: int, nz: int) -> str:
    """`i64 @descent(words)`: the number of the status."""
    f = Writer("i64 @descent(ptr %words)")
    writer = _Descent(f, m, nz)
    writer.first()
    with f.loop(ENDLESS):
        writer.sweep()
        writer.stop()
        writer.search()
        writer.line()
    f.do("ret i64 -1")
    return f.text()


class _Descent:
    """The parts of the kernel; its few numbers live on the stack."""

    def __init__(self, f: Writer, m: int, nz: int) -> None:
        self.f, self.m, self.nz, self.words = f, m, nz, Words(f, DESCENT)
        self.mu, self.taken, self.fresh = f.room(1), f.room(1), f.room(1)
        self.swapped, self.ok = f.room(1, "i64"), f.room(1, "i64")
        self.result = self.words.pointer("result")

    # Rounded one by one: no fused multiply-add.

    def _mul(self, a: str, b: str) -> str:
        return self.f.emit(f"fmul double {a}, {b}")

    def _add(self, a: str, b: str) -> str:
        return self.f.emit(f"fadd double {a}, {b}")

    def _larger(self, a: str, b: str) -> str:
        return self.f.select(self.f.compare("ogt", a, b), a, b)

    def _set(self, table: str, names: tuple[str, ...], name: str, value: str) -> None:
        """Puts an integer or a pointer (as `kind value`) into another kernel's table."""
        at = self.f.at(self.words.pointer(table), names.index(name), "i64")
        self.f.do(f"store {value}, ptr {at}, align 8")

    def _end(self, status: Status) -> str:
        return f"i64 {STATUSES.index(status)}"

    def _rollout(self, runs: int, stored: bool) -> None:
        """Runs with `alphas`; the trajectory of the first to the next z, u if it is stored."""
        f = self.f
        self._set("rollout", ROLLOUT, "runs", f"i64 {runs}")
        for name, pair in (("z", ("z0", "z1")), ("u", ("u0", "u1"))):
            where = self._other(pair) if stored else "null"
            self._set("rollout", ROLLOUT, name, f"ptr {where}")
        f.do(f"call void @rollout(ptr {self.words.pointer('rollout')})")

    def _other(self, pair: tuple[str, str]) -> str:
        """The one of two arrays that is not the current one."""
        f = self.f
        first, second = (self.words.pointer(name) for name in pair)
        return f.pick(f.compare_integers("eq", f.index(self.swapped, 0), 0), second, first, "ptr")

    def first(self) -> None:
        """The first rollout, by the words it came with, to z0, u0."""
        f = self.f
        f.store(ZERO, self.mu)
        f.do(f"store i64 0, ptr {self.swapped}, align 8")
        f.do(f"call void @rollout(ptr {self.words.pointer('rollout')})")
        cost = f.load(self.words.pointer("costs"))
        for place, value in ((COST, cost), (COUNT, ZERO), (FAILED_AT, number(-1.0)), (TURN, ZERO)):
            f.store(value, self.result, place)
        finite = f.compare("olt", f.call("fabs", [cost]), INFINITY)
        f.return_if(f.negated(finite), self._end("not finite"))
        for name in ("k", "K"):
            self._set("rollout", ROLLOUT, name, f"ptr {self.words.pointer(name)}")
        self._current()

    def _current(self) -> None:
        """Tells both kernels which trajectory they are about."""
        for pair, rollout, sweep in (
            (("z1", "z0"), "zbar", "z_run"),
            (("u1", "u0"), "ubar", "u_run"),
        ):
            value = self._other(pair)
            self._set("rollout", ROLLOUT, rollout, f"ptr {value}")
            self._set("sweep", SWEEP, sweep, f"ptr {value}")

    def sweep(self) -> None:
        """Sweeps with a growing mu until every Q_uu is positive definite and K finite."""
        f = self.f
        with f.loop(ENDLESS):
            mu, damping = f.load(self.mu), self.words.pointer("damping")
            for j in range(self.m):
                f.store(self._mul(mu, f.load(self.words.pointer("scale"), j)), damping, j)
            failed = f.emit(f"call i64 @sweep(ptr {self.words.pointer('sweep')})")
            through = f.compare_integers("slt", failed, 0)
            f.break_if(f.both(through, self._finite_gains()))
            f.store(f.as_double(f.pick(through, 0, failed)), self.result, FAILED_AT)
            f.return_if(f.compare("oge", mu, number(CEILING)), self._end("not finite"))
            f.store(self._larger(self._mul(mu, number(GROWTH)), number(FLOOR)), self.mu)

    def _finite_gains(self) -> str:
        """Whether the first step's K is finite: what goes wrong on the way ends there."""
        f, K, total = self.f, self.words.pointer("K"), self.f.room(1)
        f.store(ZERO, total)
        with f.loop(self.m * self.nz) as i:
            value = f.load(K, i)
            f.store(f.add(f.load(total), f.sub(value, value)), total)
        return f.compare("oeq", f.load(total), ZERO)

    def _promises(self) -> tuple[str, str]:
        expected = self.words.pointer("expected")
        return self.f.load(expected, 0), self.f.load(expected, 1)

    def stop(self) -> None:
        """Returns when nothing more is promised, or the iterations are used up."""
        f, (d1, d2) = self.f, self._promises()
        cost = f.call("fabs", [f.load(self.result, COST)])
        least = self._add(self._mul(self.words.double("tolerance"), cost), number(NO_CHANGE))
        small = f.compare("ole", f.neg(self._add(d1, d2)), least)
        free = f.compare("olt", f.load(self.mu), number(LARGE_MU))  # or mu makes it small
        f.return_if(f.both(small, free), self._end("converged"))
        f.return_if(small, self._end("no improvement"))
        most = f.as_double(self.words.integer("max_iterations"))
        used = f.compare("oge", f.load(self.result, COUNT), most)
        f.return_if(used, self._end("max iterations"))

    def search(self) -> None:
        """The first alpha that keeps its promise into `taken` (0: none), its run stored."""
        f = self.f
        f.store(ZERO, self.taken)
        alphas = self.words.pointer("alphas")
        for lane in range(LANES):
            f.store(ONE, alphas, lane)
        self._rollout(1, stored=True)
        self._take(0)
        with f.when(f.compare("oeq", f.load(self.taken), ZERO)):
            self._shorter(alphas)

    def _shorter(self, alphas: str) -> None:
        f, halvings = self.f, self.words.integer("halvings")
        f.store(ONE, self.fresh)
        blocks = f.integer("sdiv", f.integer("add", halvings, LANES - 1), LANES)
        with f.when(f.compare_integers("sgt", blocks, 0)), f.loop(blocks) as block:
            for lane in range(LANES):
                place = f.integer("add", f.integer("mul", block, LANES), lane)
                within = f.compare_integers("slt", place, halvings)
                shorter = self._mul(f.load(self.fresh), number(0.5))
                f.store(shorter, self.fresh)
                f.store(f.select(within, shorter, ZERO), alphas, lane)
            self._rollout(LANES, stored=False)
            for lane in reversed(range(LANES)):
                self._take(lane)
            f.break_if(f.compare("one", f.load(self.taken), ZERO))
        with f.when(f.compare("one", f.load(self.taken), ZERO)):
            for lane in range(LANES):
                f.store(f.load(self.taken), alphas, lane)
            self._rollout(1, stored=True)

    def _take(self, lane: int) -> None:
        """Makes the lane's alpha the one that is taken if it keeps its promise."""
        f, (d1, d2) = self.f, self._promises()
        alpha = f.load(self.words.pointer("alphas"), lane)
        promised = self._add(self._mul(alpha, d1), self._mul(self._mul(alpha, alpha), d2))
        cost = f.load(self.words.pointer("costs"), lane)
        change = f.emit(f"fsub double {cost}, {f.load(self.result, COST)}")
        enough = f.compare("ole", change, self._mul(self.words.double("accept"), promised))
        enough = f.both(enough, f.compare("ogt", alpha, ZERO))
        f.store(f.select(enough, alpha, f.load(self.taken)), self.taken)

    def line(self) -> None:
        """A line of the trace; the accepted run becomes the current one, or mu grows."""
        f, taken, mu = self.f, self.f.load(self.taken), self.f.load(self.mu)
        found = f.compare("one", taken, ZERO)
        count = f.load(self.result, COUNT)
        cost = f.select(found, f.load(self.words.pointer("costs")), f.load(self.result, COST))
        row = f.integer("mul", f.emit(f"fptosi double {count} to i64"), 4)
        to = f.at(self.words.pointer("lines"), row)
        for place, value in enumerate((cost, self._add(*self._promises()), taken, mu)):
            f.store(value, to, place)
        f.store(cost, self.result, COST)
        f.store(self._add(count, ONE), self.result, COUNT)
        lower = f.emit(f"fdiv double {mu}, {number(GROWTH)}")
        lower = f.select(f.compare("oge", lower, number(FLOOR)), lower, ZERO)
        higher = self._larger(self._mul(mu, number(GROWTH)), number(SEARCH_FLOOR))
        f.store(f.select(found, lower, higher), self.mu)
        turn = f.index(self.swapped, 0)
        turn = f.pick(found, f.integer("xor", turn, 1), turn)
        f.do(f"store i64 {turn}, ptr {self.swapped}, align 8")
        f.store(f.as_double(turn), self.result, TURN)
        self._current()
        beyond = f.compare("ogt", f.load(self.mu), number(CEILING))
        stuck = f.both(beyond, f.negated(found))
        f.return_if(stuck, self._end("no improvement"))
