"""Words on a terminal: colour only where it is wanted, progress on stderr, JSON without NaN."""

from __future__ import annotations

import json
import math
import os
import re
import sys
import textwrap
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TextIO

from grounded.result import plain
from grounded_cli.options import placed
from grounded_trials.wording import MARKS, columns, figure, glued, wrapped

number = figure
BARS = "▁▂▃▄▅▆▇█"
LABEL = 10  # columns of what stands before a text
EVERY = 30.0  # seconds between words on a long command's stage where there is no terminal


# Our own marks in a text, which are no characters: what strangers' files say can't be anything else
_MARKS = dict(zip(MARKS, (f"\033[{code}m" for code in ("1", "1;31", "0", "32", "33")), strict=True))
BOLD, ALARM, _END, GOOD, DOUBT = _MARKS
MEANING = {
    **dict.fromkeys(("better", "first", "effect", "several", "none", "converged"), GOOD),
    **dict.fromkeys(("crashed", "failed", "DAMAGED", "damaged", "lost"), ALARM),
    **dict.fromkeys(("in doubt", "waiting", "unknown", "UNSURE", "warning", "left out"), DOUBT),
}  # words that are shown in a colour where there is one


def style(text: str, mark: str = BOLD) -> str:
    """Text in bold, or in another of the styles here, where it is shown in colour."""
    return f"{mark}{text}{_END}"


def tinted(word: str) -> str:
    """A word in the colour of what it means: good, doubtful or bad; others as they are."""
    return style(word, MEANING[word]) if word in MEANING else word


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


def lines(text: str, first: str, rest: str) -> list[str]:
    """A sentence as lines of the terminal's width, begun as said; its commands as typed here."""
    return wrapped(placed(text), first, rest)


def field(label: str, text: str, indent: str = "", width: int = LABEL) -> str:
    """A label and its text, wrapped to the terminal under itself; a number keeps its %."""
    head = f"{indent}{label:<{width}} "
    first, *rest = lines(text, head, " " * len(head)) or [head.rstrip()]
    return "\n".join([first.replace(label, tinted(label), 1) if label else first, *rest])


def remark(kind: str, text: str) -> None:
    """Narration with a word ahead, `note: ...`, wrapped to the terminal."""
    first, *rest = lines(text, f"{kind}: ", "  ")
    say("\n".join([first.replace(kind, tinted(kind), 1), *rest]))


def names_in(text: str | None) -> list[str]:
    """The names of a list like `a,b`, each once."""
    return [name for name in dict.fromkeys(n.strip() for n in (text or "").split(",")) if name]


@contextmanager
def stages() -> Iterator[Callable[[str], None]]:
    """A function that shows which stage a long command is in, "" for none.

    On a terminal at once, in place; elsewhere, in a log say, a line now and then.
    """
    live, told = is_live(sys.stderr), time.monotonic()

    def tell(stage: str) -> None:
        nonlocal told
        if live:
            sys.stderr.write("\r\033[K")
            _write(f"{stage and stage + ' ...'}", sys.stderr, end="")
        elif stage and time.monotonic() - told > EVERY:
            told = time.monotonic()
            _write(f"{stage} ...", sys.stderr)

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


def sentence(text: str) -> None:
    """A sentence on stdout, wrapped to the terminal."""
    show("\n".join(lines(text, "", "  ")))


def table(rows: Sequence[Sequence[str]], header: Sequence[str]) -> str:
    """Aligned columns: the first and those of words to the left, numbers to the right.

    Where it is wider than a terminal, names of columns are broken at their blanks, then cells at
    theirs; what is wider still goes on in a second table under the same first column.
    """
    body = [[cell.replace("\n", "?") for cell in row] for row in rows]
    for gap in (2, 1):
        widths = _fit([list(header), *body], gap)
        kept = _reach(widths, gap)
        if kept == len(widths):
            break
    if kept < len(widths):
        parts = [
            [[row[0], *row[k]] for row in (header, *body)]
            for k in (slice(1, kept), slice(kept, None))
        ]
        return "\n\n".join(table(part[1:], part[0]) for part in parts)
    left = [i == 0 or _words([row[i] for row in body]) for i in range(len(widths))]
    out = []
    for k, row in enumerate([list(header), *body]):
        cells = [_broken(cell, width) for cell, width in zip(row, widths, strict=True)]
        tall = max(map(len, cells), default=0)
        for j in range(tall):
            text = ""
            for i, lines in enumerate(cells):
                at = j - (tall - len(lines)) if k == 0 else j  # names stand on the line below them
                cell = lines[at] if 0 <= at < len(lines) else ""
                pad = " " * (widths[i] - len(cell))
                text += " " * gap * (i > 0) + (
                    tinted(cell) + pad if left[i] else pad + tinted(cell)
                )
            out.append(style(text.rstrip()) if k == 0 else text.rstrip())
    return "\n".join(out)


def _fit(lines: list[list[str]], gap: int) -> list[int]:
    """The widths of columns within a terminal, as far as words allow: first of names, then all."""
    across = list(zip(*lines, strict=True))
    widths = [max(map(len, column)) for column in across]
    for whole in (True, False):  # cells
        least = [
            max([_longest(name), *(len(c) if whole else _longest(c) for c in cells)])
            for name, *cells in across
        ]
        while _total(widths, gap) > columns() and widths != least:
            loose = [w * (w > n) for w, n in zip(widths, least, strict=True)]
            widths[loose.index(max(loose))] -= 1
    return widths


def _longest(cell: str) -> int:
    """The widest part of a cell that is not broken."""
    return max(map(len, glued(cell).split(" ")))


def _total(widths: Sequence[int], gap: int) -> int:
    return sum(widths) + gap * (len(widths) - 1)


def _reach(widths: Sequence[int], gap: int) -> int:
    """How many columns a terminal shows beside each other, two at least."""
    whole = range(len(widths), 2, -1)
    fitting = (k for k in whole if _total(widths[:k], gap) <= columns())
    return next(fitting, min(len(widths), 2))


def _words(cells: Sequence[str]) -> bool:
    """Whether a column holds words rather than numbers."""
    known = [cell for cell in cells if cell]
    return all(cell[0].isalpha() for cell in known) or 2 * sum(
        len(c.split()) > 3 for c in known
    ) > len(known)


def _broken(cell: str, width: int) -> list[str]:
    """A cell's lines."""
    if len(cell) <= width:
        return [cell]
    lines = textwrap.wrap(glued(cell), width, break_long_words=False, break_on_hyphens=False)
    return [line.replace("\xa0", " ") for line in lines]


def sparkline(values: Sequence[float]) -> str:
    """Utilities as little bars, worst to best; a failed run is a cross.

    By the logarithm of the distance from 0 where the worst would flatten all others; the scale is
    said beside it.
    """
    shown = list(values)[-columns() // 2 :]
    known = [v for v in shown if math.isfinite(v)]
    if not known:
        return "x" * len(shown)
    low, high = min(known), max(known)
    log = high < 0 and low < 2 * high
    places = [-math.log(-v) if log and math.isfinite(v) else v for v in shown]
    least, most = (-math.log(-v) if log else v for v in (low, high))
    span = (most - least) or 1.0
    bars = (BARS[round((v - least) / span * 7)] if math.isfinite(v) else "x" for v in places)
    scale = figure(low) + f" to {figure(high)}" * (low < high) + ", logarithmic" * log
    return f"{''.join(bars)}  {scale}" + ", x: failed" * (len(known) < len(shown))
