"""Functions of m inputs: a factor of the free ones, and the box-limited quadratic programme.

Projected Newton (Tassa et al. 2014): on the free set, the inputs that no bound holds back, a Newton
step is exact, so a handful of iterations end with the exact solution. Everything is written out for
m inputs, in small arrays: H [m][m] = L D L', 1/D in `inv`, and `free`, 1 for a free input, else 0.
"""

from __future__ import annotations

from grounded.compile.emit.llvm_text import Writer, number
from grounded.compile.problem import ARMIJO, MAX_ITERATIONS, ROUNDING, STOP

ZERO, ONE = number(0.0), number(1.0)


def box_functions(m: int) -> str:
    """@factor, @substitute, @value and @box."""
    return _factor(m) + _substitute(m) + _value(m) + _box(m)


def _factor(m: int) -> str:
    """`i1 @factor(H, free, L, inv)`: whether H is positive definite, clamped inputs left out.

    H = L D L' without square roots: L has ones on its diagonal, inv holds 1/D.
    """
    f = Writer("internal i1 @factor(ptr %H, ptr %free, ptr %L, ptr %inv)")
    free = [f.load("%free", i) for i in range(m)]
    H = [
        [f.mul(f.mul(f.load("%H", i * m + j), free[i]), free[j]) for j in range(m)]
        for i in range(m)
    ]
    for i in range(m):
        H[i][i] = f.add(H[i][i], f.sub(ONE, free[i]))
    L, inverse, good = factored(f, H)
    for (i, j), value in L.items():
        f.store(value, "%L", i * m + j)
    for i, value in enumerate(inverse):
        f.store(value, "%inv", i)
    f.do(f"ret i1 {good}")
    return f.text()


def _substitute(m: int) -> str:
    """`void @substitute(L, inv, b)`: b becomes the solution of L D L' x = b."""
    f = Writer("internal void @substitute(ptr %L, ptr %inv, ptr %b)")
    b = [f.load("%b", i) for i in range(m)]
    for i, value in enumerate(solved(f, b, *loaded(f, m, "%L", "%inv"), 1)):
        f.store(value, "%b", i)
    f.do("ret void")
    return f.text()


Lower = dict[tuple[int, int], str]  # L[i, j] below the diagonal, column by column


def factored(f: Writer, H: list[list[str]]) -> tuple[Lower, list[str], str]:
    """L, 1/D and whether H is positive definite, in registers and without a branch."""
    m, L, LD, inverse, good = len(H), Lower(), Lower(), list[str](), "true"
    for j in range(m):
        for i in range(j, m):
            value = H[i][j]
            for s in range(j):
                value = f.sub(value, f.mul(LD[i, s], L[j, s]))
            if i > j:
                LD[i, j], L[i, j] = value, f.mul(value, inverse[j])
                continue
            positive = f.compare("ogt", value, ZERO)
            finite = f.compare("olt", value, number(float("inf")))
            good = f.both(good, positive, finite)
            inverse.append(f.div(ONE, value))
    return L, inverse, good


def loaded(f: Writer, m: int, L: str, inverse: str) -> tuple[Lower, list[str]]:
    """The factor that @factor left in memory."""
    lower = {(i, j): f.load(L, i * m + j) for j in range(m) for i in range(j + 1, m)}
    return lower, [f.load(inverse, i) for i in range(m)]


def solved(f: Writer, rows: list[str], L: Lower, inverse: list[str], width: int) -> list[str]:
    """Rows of the solution X of L D L' X = rows, each W wide."""
    m, x = len(rows), list(rows)
    wide = {at: f.spread(value, width) for at, value in L.items()}
    for i in range(m):
        for j in range(i):
            x[i] = f.sub(x[i], f.mul(wide[i, j], x[j], width), width)
    x = [f.mul(x[i], f.spread(inverse[i], width), width) for i in range(m)]
    for i in reversed(range(m)):
        for j in range(i + 1, m):
            x[i] = f.sub(x[i], f.mul(wide[j, i], x[j], width), width)
    return x


def _value(m: int) -> str:
    """`double @value(H, g, k, out)`: 1/2 k'Hk + g'k, and the gradient g + H k to out."""
    f = Writer("internal double @value(ptr %H, ptr %g, ptr %k, ptr %out)")
    k, total = [f.load("%k", i) for i in range(m)], ZERO
    for i in range(m):
        g = f.load("%g", i)
        row = f.mul(f.load("%H", i * m), k[0])
        for j in range(1, m):
            row = f.fma(f.load("%H", i * m + j), k[j], row)
        f.store(f.add(g, row), "%out", i)
        total = f.fma(k[i], f.fma(row, number(0.5), g), total)
    f.do(f"ret double {total}")
    return f.text()


def clipped(f: Writer, value: str, low: str, high: str) -> str:
    """A number in [low, high]."""
    value = f.select(f.compare("olt", value, low), low, value)
    return f.select(f.compare("ogt", value, high), high, value)


class _Box:
    """`void @box(H, g, low, high, k, free, L, inv)`: k within its limits, and what is free."""

    def __init__(self, m: int) -> None:
        self.m = m
        self.f = f = Writer(
            "internal void @box(ptr %H, ptr %g, ptr %low, ptr %high, "
            "ptr %k, ptr %free, ptr %L, ptr %inv)"
        )
        self.gradient, self.step, self.trial = (f.room(m) for _ in range(3))
        self.scratch, self.beta = f.room(m), f.room(1)

    def start(self) -> str:
        """Puts k to the clipped unlimited minimiser (already in k); returns the stopping size."""
        f, largest = self.f, ZERO
        for i in range(self.m):
            k = clipped(f, f.load("%k", i), f.load("%low", i), f.load("%high", i))
            f.store(k, "%k", i)
            size = f.call("fabs", [f.load("%g", i)])
            largest = f.select(f.compare("ogt", size, largest), size, largest)
        return f.mul(f.add(largest, number(1e-300)), number(STOP))

    def free_set(self, floor: str) -> None:
        """Marks the free inputs; leaves the loop when their gradient is small."""
        f, busy = self.f, list[str]()
        for i in range(self.m):
            k, g = f.load("%k", i), f.load(self.gradient, i)
            low, high = f.load("%low", i), f.load("%high", i)
            at_low = f.both(f.compare("ole", k, low), f.compare("ogt", g, ZERO))
            at_high = f.both(f.compare("oge", k, high), f.compare("olt", g, ZERO))
            held = f.any(at_low, at_high, f.compare("oge", low, high))
            f.store(f.select(held, ZERO, ONE), "%free", i)
            f.store(f.select(held, ZERO, g), self.step, i)
            busy.append(f.compare("ogt", f.call("fabs", [f.load(self.step, i)]), floor))
        f.break_if(f.negated(f.any(*busy)))

    def search(self, value: str) -> None:
        """Moves k along the projected path; leaves the outer loop when it stays."""
        f, m = self.f, self.m
        f.store(ONE, self.beta)
        for i in range(m):
            f.store(f.load("%k", i), self.trial, i)
        moved, slack = f.room(1), f.mul(f.call("fabs", [value]), number(ROUNDING))
        f.store(ZERO, moved)
        with f.loop(40):
            beta, promised = f.load(self.beta), ZERO
            for i in range(m):
                k, low, high = f.load("%k", i), f.load("%low", i), f.load("%high", i)
                trial = clipped(f, f.sub(k, f.mul(beta, f.load(self.step, i))), low, high)
                f.store(trial, self.trial, i)
                promised = f.fma(f.load(self.gradient, i), f.sub(trial, k), promised)
            now = f.emit(
                f"call double @value(ptr %H, ptr %g, ptr {self.trial}, ptr {self.scratch})"
            )
            allowed = f.fma(promised, number(ARMIJO), slack)
            enough = f.compare("ole", f.sub(now, value), allowed)
            f.store(f.select(enough, ONE, ZERO), moved)
            f.store(f.mul(beta, number(0.5)), self.beta)
            f.break_if(enough)
        self._accept(f.compare("ogt", f.load(moved), ZERO))

    def _accept(self, found: str) -> None:
        f, changed = self.f, list[str]()
        for i in range(self.m):
            old = f.load("%k", i)
            new = f.select(found, f.load(self.trial, i), old)
            changed.append(f.compare("one", new, old))
            f.store(new, "%k", i)
        f.break_if(f.negated(f.any(*changed)))


def _box(m: int) -> str:
    box = _Box(m)
    f = box.f
    floor = box.start()
    with f.loop(MAX_ITERATIONS):
        value = f.emit(f"call double @value(ptr %H, ptr %g, ptr %k, ptr {box.gradient})")
        box.free_set(floor)
        f.emit("call i1 @factor(ptr %H, ptr %free, ptr %L, ptr %inv)")
        f.do(f"call void @substitute(ptr %L, ptr %inv, ptr {box.step})")
        box.search(value)
    f.do("ret void")
    return f.text()
