"""Words on a terminal: colour only where it is wanted, progress on stderr, JSON without NaN."""

from __future__ import annotations

import json
import math
import os
import re
import sys
import textwrap
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TextIO

from grounded.result import plain
from grounded_trials.wording import WIDTH, figure, wrapped

number = figure


# Our own marks in a text, which are no characters: what strangers' files say can't be anything else
_MARKS = {"\ufdd0": "\033[1m", "\ufdd1": "\033[1;31m", "\ufdd2": "\033[0m"}
BOLD, ALARM, _END = _MARKS


def style(text: str, mark: str = BOLD) -> str:
    """Text in bold, or in another of the styles here, where it is shown in colour."""
    return f"{mark}{text}{_END}"


def say(text: str) -> None:
    """Narration, on stderr."""
    _write(text, sys.stderr)


def show(text: str = "") -> None:
    """Data, on stdout."""
    _write(text, sys.stdout)


def _write(text: str, stream: TextIO | None, end: str = "\n") -> None:
    """The one place that writes to a terminal; a stream that the caller closed gets nothing."""
    if stream is not None:
        stream.write(harmless(text, coloured=is_live(stream) and not os.environ.get("NO_COLOR")))
        stream.write(end)
        stream.flush()


def is_live(stream: TextIO | None) -> bool:
    """Whether a stream is a terminal."""
    return stream is not None and stream.isatty()


def harmless(text: str, *, coloured: bool = False) -> str:
    """Text without control characters, since names come from strangers' files; "?" for each."""
    marks = _MARKS if coloured else dict.fromkeys(_MARKS, "")
    return "".join(c if c.isprintable() or c in "\n\t" else marks.get(c, "?") for c in text)


def show_json(document: dict[str, Any]) -> None:
    """One JSON document on stdout; a number that JSON doesn't have becomes null."""
    text = json.dumps(plain(document), indent=1, ensure_ascii=False, allow_nan=False)
    _write(re.sub(r"[^\n -~]", _escaped, text), sys.stdout)


def _escaped(found: re.Match[str]) -> str:
    """A character as it is, or as JSON escapes it where a terminal might obey it."""
    return found[0] if found[0].isprintable() else json.dumps(found[0])[1:-1]


def field(label: str, text: str, indent: str = "") -> str:
    """A label and its text, wrapped to 80 columns under itself; a number keeps its %."""
    head = f"{indent}{label:<10} "
    return "\n".join(wrapped(text, head, " " * len(head)) or [head.rstrip()])


def remark(kind: str, text: str) -> None:
    """Narration with a word ahead, `note: ...`, wrapped to 80 columns."""
    say("\n".join(wrapped(text, f"{kind}: ", "  ")))


def names_in(text: str | None) -> list[str]:
    """The names of a list like `a,b`, each once."""
    return [name for name in dict.fromkeys(n.strip() for n in (text or "").split(",")) if name]


@contextmanager
def stages() -> Iterator[Callable[[str], None]]:
    """A function that shows which stage a long command is in, "" for none; only on a terminal."""
    live = is_live(sys.stderr)

    def tell(stage: str) -> None:
        if live:
            sys.stderr.write("\r\033[K")
            _write(f"{stage and stage + ' ...'}", sys.stderr, end="")

    try:
        yield tell
    finally:
        tell("")


@contextmanager
def progress(text: str) -> Iterator[None]:
    """Says what is going on while something takes more than a moment; only on a terminal."""
    with stages() as tell:
        tell(text)
        yield


@contextmanager
def bar(text: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar on stderr for things that can be counted; only on a terminal."""
    width = 30
    with stages() as tell:

        def count(done: int, total: int) -> None:
            full = done * width // max(total, 1)
            tell(f"{text} [{'#' * full}{'.' * (width - full)}] {done}/{total}")

        yield count


def table(rows: Sequence[Sequence[str]], header: Sequence[str]) -> str:
    """Aligned columns: the first to the left, numbers to the right, two blanks between.

    Where it is wider than a terminal, names of columns are broken at their blanks.
    """
    rows = [[cell.replace("\n", "?") for cell in row] for row in rows]
    heads = [[name] for name in header]
    if sum(_widths(rows, heads)) + 2 * (len(header) - 1) > WIDTH:
        widths = [
            max(max((len(row[i]) for row in rows), default=0), *map(len, name.split() or [""]))
            for i, name in enumerate(header)
        ]
        heads = [textwrap.wrap(n, w) or [""] for n, w in zip(header, widths, strict=True)]
    widths, tall = _widths(rows, heads), max(map(len, heads))
    top = [[""] * (tall - len(lines)) + lines for lines in heads]
    lines = [list(line) for line in zip(*top, strict=True)] + [list(row) for row in rows]
    out = []
    for k, line in enumerate(lines):
        cells = [
            cell.ljust(width) if i == 0 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ]
        text = "  ".join(cells).rstrip()
        out.append(style(text) if k < tall else text)
    return "\n".join(out)


def _widths(rows: Sequence[Sequence[str]], heads: Sequence[Sequence[str]]) -> list[int]:
    return [
        max([len(row[i]) for row in rows] + [len(line) for line in lines])
        for i, lines in enumerate(heads)
    ]


def sparkline(values: Sequence[float]) -> str:
    """Values as little bars, lowest to highest; a failed run is a cross."""
    known = [v for v in values if math.isfinite(v)]
    if not known:
        return "x" * len(values)
    low, high = min(known), max(known)
    bars = "▁▂▃▄▅▆▇█"
    span = (high - low) or 1.0
    return "".join(bars[round((v - low) / span * 7)] if math.isfinite(v) else "x" for v in values)
