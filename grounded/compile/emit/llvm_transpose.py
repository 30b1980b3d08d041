"""Writes transpositions in registers: rows of an array become the lanes of vectors."""

from __future__ import annotations

from collections.abc import Sequence

from grounded.compile.emit.llvm_text import Writer, vector


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


def columns_of(f: Writer, rows: list[str], size: int) -> list[str]:
    """Columns of W arrays of `size` doubles, rows their addresses, as vectors of W; W is 4 or 8."""
    width, found = len(rows), list[str]()
    for at in range(0, size - size % width, width):
        found += transposed(f, [f.load(row, at, width) for row in rows])
    if width == 8 and size - len(found) >= 4:
        at = len(found)
        halves = [transposed(f, [f.load(row, at, 4) for row in rows[i : i + 4]]) for i in (0, 4)]
        found += [shuffled(f, a, b, 4, range(8)) for a, b in zip(*halves, strict=True)]
    for at in range(len(found), size):
        found.append(f.vector_of([f.load(row, at) for row in rows]))
    return found


def shuffled(f: Writer, a: str, b: str, width: int, lanes: Sequence[int]) -> str:
    """Lanes of a, from `width` on of b, both vectors of that width."""
    kind, inside = vector(width), ", ".join(f"i32 {i}" for i in lanes)
    return f.emit(f"shufflevector {kind} {a}, {kind} {b}, <{len(lanes)} x i32> <{inside}>")
