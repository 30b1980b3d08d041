"""A pen for LLVM IR: functions, loops and vectors as text.

Text, because building IR through Python objects takes longer than compiling it. Values are strings
("%12", "0x3FF0000000000000"); a value's type is kept beside it where it matters: "double" or a
vector of W doubles, W lanes being W samples of time or W step lengths that are computed together.
Optimisation is done here, by what is emitted (shared values, fused multiply-adds, no zeros), so
that LLVM has only to choose instructions and registers.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import reduce

F = "double"
FLAGS = "contract"  # a * b + c may be fused


def number(value: float) -> str:
    """A double, bit for bit."""
    return f"0x{struct.unpack('<Q', struct.pack('<d', value))[0]:016X}"


def vector(width: int) -> str:
    """The type of W lanes; one lane is a plain double."""
    return F if width == 1 else f"<{width} x double>"


def splat(value: float, width: int) -> str:
    """A constant in every lane."""
    if width == 1:
        return number(value)
    return "<" + ", ".join(f"double {number(value)}" for _ in range(width)) + ">"


class Writer:
    """One function being written."""

    def __init__(self, signature: str) -> None:
        self.lines = [f"define {signature} {{", "entry:"]
        self._count = 0
        self._allocas = len(self.lines)

    def name(self) -> str:
        """A fresh value name."""
        self._count += 1
        return f"%v{self._count}"

    def emit(self, text: str) -> str:
        """Writes `name = text`, returns the name."""
        result = self.name()
        self.lines.append(f"  {result} = {text}")
        return result

    def do(self, text: str) -> None:
        """Writes an instruction without a result."""
        self.lines.append(f"  {text}")

    def text(self) -> str:
        """The finished function."""
        return "\n".join([*self.lines, "}", ""])

    # Memory.

    def room(self, count: int, kind: str = F, align: int = 64) -> str:
        """An array on the stack, allocated on entry."""
        result = self.name()
        line = f"  {result} = alloca {kind}, i64 {count}, align {align}"
        self.lines.insert(self._allocas, line)
        self._allocas += 1
        return result

    def at(self, base: str, index: int | str, kind: str = F) -> str:
        """The address of an element."""
        if index == 0:
            return base
        return self.emit(f"getelementptr {kind}, ptr {base}, i64 {index}")

    def index(self, table: str, i: int | str) -> str:
        """An entry of a table of i64."""
        return self.emit(f"load i64, ptr {self.at(table, i, 'i64')}, align 8")

    def load(self, base: str, index: int | str = 0, width: int = 1) -> str:
        """W doubles from base[index]."""
        return self.emit(f"load {vector(width)}, ptr {self.at(base, index)}, align 8")

    def store(self, value: str, base: str, index: int | str = 0, width: int = 1) -> None:
        """W doubles to base[index]."""
        self.do(f"store {vector(width)} {value}, ptr {self.at(base, index)}, align 8")

    def load_all(self, base: str, index: int | str, width: int) -> str:
        """One double in every lane."""
        return self.spread(self.load(base, index), width)

    def spread(self, value: str, width: int) -> str:
        """A double in every lane."""
        if width == 1:
            return value
        kind = vector(width)
        one = self.emit(f"insertelement {kind} poison, double {value}, i64 0")
        return self.emit(
            f"shufflevector {kind} {one}, {kind} poison, <{width} x i32> zeroinitializer"
        )

    def vector_of(self, values: list[str]) -> str:
        """Numbers as the lanes of a vector."""
        row = "poison"
        for i, value in enumerate(values):
            row = self.emit(f"insertelement {vector(len(values))} {row}, double {value}, i64 {i}")
        return row

    def lane(self, value: str, i: int | str, width: int) -> str:
        """One lane of a vector."""
        return (
            value if width == 1 else self.emit(f"extractelement {vector(width)} {value}, i64 {i}")
        )

    # Arithmetic on W lanes.

    def op(self, name: str, a: str, b: str, width: int = 1) -> str:
        """An fadd, fsub, fmul or fdiv."""
        return self.emit(f"{name} {FLAGS} {vector(width)} {a}, {b}")

    def add(self, a: str, b: str, width: int = 1) -> str:
        """Sum."""
        return self.op("fadd", a, b, width)

    def sub(self, a: str, b: str, width: int = 1) -> str:
        """Difference."""
        return self.op("fsub", a, b, width)

    def mul(self, a: str, b: str, width: int = 1) -> str:
        """Product."""
        return self.op("fmul", a, b, width)

    def div(self, a: str, b: str, width: int = 1) -> str:
        """Quotient."""
        return self.op("fdiv", a, b, width)

    def neg(self, a: str, width: int = 1) -> str:
        """Minus."""
        return self.emit(f"fneg {vector(width)} {a}")

    def fma(self, a: str, b: str, c: str, width: int = 1) -> str:
        """The sum a b + c, fused where the machine can."""
        return self.add(self.mul(a, b, width), c, width)

    def call(self, intrinsic: str, args: list[str], width: int = 1) -> str:
        """An LLVM intrinsic on lanes; it must be declared in PRELUDE."""
        kind = vector(width)
        suffix = "f64" if width == 1 else f"v{width}f64"
        inside = ", ".join(f"{kind} {a}" for a in args)
        return self.emit(f"call {kind} @llvm.{intrinsic}.{suffix}({inside})")

    def compare(self, how: str, a: str, b: str, width: int = 1) -> str:
        """An fcmp."""
        return self.emit(f"fcmp {how} {vector(width)} {a}, {b}")

    def select(self, condition: str, a: str, b: str, width: int = 1) -> str:
        """Lane by lane a or b."""
        bits = "i1" if width == 1 else f"<{width} x i1>"
        kind = vector(width)
        return self.emit(f"select {bits} {condition}, {kind} {a}, {kind} {b}")

    def integer(self, op: str, a: int | str, b: int | str) -> str:
        """An i64 operation: add, sub, mul, sdiv ..."""
        return self.emit(f"{op} i64 {a}, {b}")

    def compare_integers(self, how: str, a: int | str, b: int | str) -> str:
        """An icmp of i64."""
        return self.emit(f"icmp {how} i64 {a}, {b}")

    def pick(self, condition: str, a: int | str, b: int | str, kind: str = "i64") -> str:
        """One of two integers or addresses (`kind` ptr)."""
        return self.emit(f"select i1 {condition}, {kind} {a}, {kind} {b}")

    def as_double(self, i: str) -> str:
        """An i64 as a double."""
        return self.emit(f"sitofp i64 {i} to double")

    # Conditions, one bit each.

    def both(self, *conditions: str) -> str:
        """Whether all hold."""
        return reduce(lambda a, b: self.emit(f"and i1 {a}, {b}"), conditions)

    def any(self, *conditions: str) -> str:
        """Whether one holds."""
        return reduce(lambda a, b: self.emit(f"or i1 {a}, {b}"), conditions)

    def negated(self, condition: str) -> str:
        """Whether it does not hold."""
        return self.emit(f"xor i1 {condition}, true")

    def given(self, address: str) -> str:
        """Whether an address is not null."""
        return self.emit(f"icmp ne ptr {address}, null")

    # Control.

    @contextmanager
    def loop(self, count: int | str, down: bool = False) -> Iterator[str]:
        """Runs i = 0 .. count - 1 (or down), at least once; break_if may leave it."""
        self._count += 1
        tag, i = self._count, f"%i{self._count}"
        first = self.integer("sub", count, 1) if down else "0"
        self.do(f"br label %before{tag}")
        self.lines.append(f"before{tag}:")
        self.do(f"br label %loop{tag}")
        self.lines.append(f"loop{tag}:")
        self.do(f"{i} = phi i64 [ {first}, %before{tag} ], [ {i}.next, %latch{tag} ]")
        outer, self.exit = getattr(self, "exit", ""), f"exit{tag}"
        yield i
        self.exit = outer
        self.do(f"br label %latch{tag}")
        self.lines.append(f"latch{tag}:")
        self.do(f"{i}.next = {'sub' if down else 'add'} i64 {i}, 1")
        end = "-1" if down else str(count)
        self.do(f"%more{tag} = icmp ne i64 {i}.next, {end}")
        self.do(f"br i1 %more{tag}, label %loop{tag}, label %exit{tag}")
        self.lines.append(f"exit{tag}:")

    def break_if(self, condition: str) -> None:
        """Leaves the innermost loop."""
        self._count += 1
        self.do(f"br i1 {condition}, label %{self.exit}, label %stay{self._count}")
        self.lines.append(f"stay{self._count}:")

    @contextmanager
    def when(self, condition: str) -> Iterator[None]:
        """Runs the block if the i1 is true."""
        self._count += 1
        tag = self._count
        self.do(f"br i1 {condition}, label %then{tag}, label %after{tag}")
        self.lines.append(f"then{tag}:")
        yield
        self.do(f"br label %after{tag}")
        self.lines.append(f"after{tag}:")

    def either(
        self,
        condition: str,
        yes: Callable[[], list[str]],
        no: Callable[[], list[str]],
        width: int = 1,
    ) -> list[str]:
        """Values of W lanes: those that `yes` writes where the i1 is true, else those of `no`."""
        self._count += 1
        tag = self._count
        self.do(f"br i1 {condition}, label %yes{tag}, label %no{tag}")
        ends = list[tuple[list[str], str]]()
        for name, write in (("yes", yes), ("no", no)):
            self.lines.append(f"{name}{tag}:")
            ends.append((write(), self._block()))
            self.do(f"br label %both{tag}")
        self.lines.append(f"both{tag}:")
        (a, first), (b, second) = ends
        kind = vector(width)
        return [
            self.emit(f"phi {kind} [ {x}, %{first} ], [ {y}, %{second} ]")
            for x, y in zip(a, b, strict=True)
        ]

    def all(self, condition: str, width: int) -> str:
        """Whether a condition holds in every lane."""
        if width == 1:
            return condition
        bits = self.emit(f"bitcast <{width} x i1> {condition} to i{width}")
        return self.emit(f"icmp eq i{width} {bits}, -1")

    def _block(self) -> str:
        """The label of the block that is being written."""
        labels = (line for line in reversed(self.lines) if not line.startswith(" "))
        return next(line for line in labels if line.endswith(":"))[:-1]

    def return_if(self, condition: str, result: str) -> None:
        """Returns early."""
        with self.when(condition):
            self.do(f"ret {result}")
            self._count += 1
            self.lines.append(f"dead{self._count}:")


# Transpositions in registers: rows of an array become the lanes of vectors.


def transposed(f: Writer, a: list[str]) -> list[str]:
    """Columns of W rows of W; W is 4 or 8."""
    if len(a) == 4:
        lo = [shuffled(f, a[i], a[i + 1], 4, (0, 4, 2, 6)) for i in (0, 2)]
        hi = [shuffled(f, a[i], a[i + 1], 4, (1, 5, 3, 7)) for i in (0, 2)]
        halves = (0, 1, 4, 5), (2, 3, 6, 7)
        return [shuffled(f, a, b, 4, lanes) for lanes in halves for a, b in (lo, hi)]
    # Pairs of rows, then pairs of pairs: what moves is pairs of neighbours.
    even = [shuffled(f, a[i], a[i + 1], 8, (0, 8, 2, 10, 4, 12, 6, 14)) for i in (0, 2, 4, 6)]
    odd = [shuffled(f, a[i], a[i + 1], 8, (1, 9, 3, 11, 5, 13, 7, 15)) for i in (0, 2, 4, 6)]
    first, second = (0, 1, 4, 5, 8, 9, 12, 13), (2, 3, 6, 7, 10, 11, 14, 15)
    columns = [""] * 8
    for parity, rows in enumerate((even, odd)):
        for half, lanes in enumerate((first, second)):
            upper, lower = (shuffled(f, rows[i], rows[i + 1], 8, lanes) for i in (0, 2))
            columns[2 * half + parity] = shuffled(f, upper, lower, 8, first)
            columns[2 * half + parity + 4] = shuffled(f, upper, lower, 8, second)
    return columns


def shuffled(f: Writer, a: str, b: str, width: int, lanes: Sequence[int]) -> str:
    """Lanes of a, from `width` on of b, both vectors of that width."""
    kind, inside = vector(width), ", ".join(f"i32 {i}" for i in lanes)
    return f.emit(f"shufflevector {kind} {a}, {kind} {b}, <{len(lanes)} x i32> <{inside}>")


def integers(name: str, values: list[int]) -> str:
    """A constant table of i64."""
    inside = ", ".join(f"i64 {value}" for value in values)
    return f"@{name} = internal constant [{len(values)} x i64] [{inside}]\n"


def doubles(name: str, values: list[float]) -> str:
    """A constant table of doubles."""
    inside = ", ".join(f"double {number(value)}" for value in values)
    return f"@{name} = internal constant [{len(values)} x double] [{inside}]\n"


def declarations(widths: set[int]) -> str:
    """The intrinsics and C functions that kernels may call."""
    lines = []
    for width in sorted(widths | {1}):
        kind = vector(width)
        suffix = "f64" if width == 1 else f"v{width}f64"
        for name in ("sqrt", "fabs", "floor", "rint", "trunc"):
            lines.append(f"declare {kind} @llvm.{name}.{suffix}({kind})")
        lines.append(f"declare {kind} @llvm.fma.{suffix}({kind}, {kind}, {kind})")
    for name in ("cbrt", "expm1", "log", "log1p", "asin", "acos", "atan", "sinh", "cosh", "tanh"):
        lines.append(f"declare double @{name}(double)")
    lines += [f"declare double @{name}(double, double)" for name in ("pow", "atan2")]
    return "\n".join(lines) + "\n"
