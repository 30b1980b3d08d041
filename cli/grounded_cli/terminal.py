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
from typing import Any

import click

from grounded.result import plain
from grounded_trials.wording import WIDTH, figure, wrapped

number = figure


def style(text: str, **how: Any) -> str:
    """Coloured text, unless NO_COLOR is set or the output is not a terminal."""
    plain = os.environ.get("NO_COLOR") or not (sys.stdout.isatty() and sys.stderr.isatty())
    return text if plain else click.style(text, **how)


def say(text: str) -> None:
    """Narration, on stderr."""
    click.echo(harmless(text), err=True)


def show(text: str = "") -> None:
    """Data, on stdout."""
    click.echo(harmless(text))


def harmless(text: str) -> str:
    """Text that can colour a terminal and nothing else: names come from strangers' files."""
    parts = re.split(r"(\x1b\[[0-9;]*m)", text)
    shown = [
        part if i % 2 else "".join(c if c.isprintable() or c in "\n\t" else "?" for c in part)
        for i, part in enumerate(parts)
    ]
    return "".join(shown)


def show_json(document: dict[str, Any]) -> None:
    """One JSON document on stdout; a number that JSON doesn't have becomes null."""
    click.echo(json.dumps(plain(document), indent=1, ensure_ascii=False, allow_nan=False))


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
    live = sys.stderr.isatty()

    def tell(stage: str) -> None:
        if live:
            click.echo(f"\r\033[K{stage and stage + ' ...'}", err=True, nl=False)

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
        out.append(style(text, bold=True) if k < tall else text)
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
