"""Terminal output: colour, wrapped text, tables, progress on stderr, JSON; the workspace of -C."""

from __future__ import annotations

import json
import math
import os
import re
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import accumulate
from typing import TYPE_CHECKING, Any, TextIO

import click

from grounded.errors import NextCommand
from grounded.findings.finding import Finding, Weight
from grounded.result import plain
from grounded_trials.wording import (
    ELSEWHERE,
    MARKS,
    columns,
    figure,
    folded,
    glued,
    placed,
    rendered,
    wrapped,
)

if TYPE_CHECKING:
    from grounded_trials import Workspace

number = figure
BARS = "▁▂▃▄▅▆▇█"
LABEL = 10  # width of the label column
SO_FAR = re.compile(r", [^,]* so far.*")  # the time in a stage's text (`grounded.progress`)
EVERY = 30.0  # seconds between progress lines when stderr is not a terminal


# Styles are marked with non-characters, so text from untrusted files cannot inject escape codes
_CODES = ("\033[1m", "\033[1;31m", "\033[0m", "\033[32m", "\033[33m")
_MARKS = dict(zip(MARKS, _CODES, strict=True))
BOLD, ALARM, _END, GOOD, DOUBT = _MARKS
MEANING = {
    **dict.fromkeys(("better", "first", "effect", "several", "none", "converged"), GOOD),
    **dict.fromkeys(("crashed", "failed", "DAMAGED", "damaged", "lost"), ALARM),
    **dict.fromkeys(
        ("in doubt", "maybe better", "waiting", "unknown", "UNSURE", "warning", "left out"), DOUBT
    ),
}  # words shown in colour on a terminal


def style(text: str, mark: str = BOLD) -> str:
    """Mark text as bold, or with another of the styles above, for output in colour."""
    return f"{mark}{text}{_END}"


def tinted(word: str) -> str:
    """Colour a word by its meaning (good, doubtful or bad); return other words unchanged."""
    return style(word, MEANING[word]) if word in MEANING else word


def say(text: str) -> None:
    """Write narration to stderr."""
    _write(text, sys.stderr)


def show(text: str = "") -> None:
    """Write data to stdout."""
    _write(text, _output())


_kept: list[TextIO] = []  # stdout, while code of others runs


def _output() -> TextIO | None:
    return _kept[-1] if _kept else sys.stdout


@contextmanager
def stdout_kept() -> Iterator[None]:
    """Keep stdout for `show` and `show_json`: whatever else is printed goes to stderr.

    That is the user's model and whatever it starts, in this process or another, now or when the
    program ends: so the descriptor of stdout stays with stderr if it is the process's own.
    """
    data = before = sys.stdout
    own = False
    with suppress(OSError, ValueError, AttributeError):  # a stream without a descriptor, in tests
        own = data.fileno() == 1 and sys.stderr.fileno() == 2
    if own:
        data.flush()
        data = os.fdopen(os.dup(1), "w", encoding=data.encoding, errors="replace")
        os.dup2(2, 1)
    _kept.append(data)
    sys.stdout = sys.stderr
    try:
        yield
    finally:
        _kept.pop()
        if not own:
            sys.stdout = before
        with suppress(OSError):  # the reader has gone: `_write` said so
            data.close() if own else None


def _write(text: str, stream: TextIO | None, end: str = "\n") -> None:
    """Write text to a stream, without control characters; do nothing if there is no stream."""
    if stream is not None:
        stream.write(harmless(text, coloured=is_live(stream) and not os.environ.get("NO_COLOR")))
        stream.write(end)
        stream.flush()


def is_live(stream: TextIO | None) -> bool:
    """Return whether a stream is a terminal."""
    return stream is not None and stream.isatty()


def harmless(text: str, *, coloured: bool = False) -> str:
    """Replace control characters by "?", since names may come from untrusted files."""
    marks = _MARKS if coloured else dict.fromkeys(_MARKS, "")
    return "".join(c if c.isprintable() or c in "\n\t" else marks.get(c, "?") for c in text)


def show_json(document: dict[str, Any]) -> None:
    """Write one JSON document to stdout, with null for NaN and infinities."""
    _write(json.dumps(plain(document), indent=1, allow_nan=False), _output())


def lines(text: str, first: str, rest: str) -> list[str]:
    """Wrap a text to the terminal's width, with `-C DIR` added to its commands where needed."""
    return wrapped(placed(text, given()), first, rest)


def field(label: str, text: str, indent: str = "", width: int = LABEL) -> str:
    """Format a label and its text, wrapped to the terminal with a hanging indent."""
    head = f"{indent}{label:<{width}} "
    first, *rest = lines(text, head, " " * len(head)) or [head.rstrip()]
    return "\n".join([first.replace(label, tinted(label), 1) if label else first, *rest])


def remark(kind: str, text: str) -> None:
    """Write narration with a prefix, `note: ...`, to stderr, wrapped to the terminal."""
    first, *rest = lines(text, f"{kind}: ", "  ")
    say("\n".join([first.replace(kind, tinted(kind), 1), *rest]))


def tell(
    findings: Sequence[Finding], about: str = "", most: int = 3, *, all_: bool = False
) -> None:
    """Write findings to stderr as remarks, the heaviest first; beyond `most`, how many are left.

    `about` is what all are about, such as the name of a log; `all_` tells them all, with their
    codes, as --details does.
    """
    most = len(findings) if all_ else most
    for one in findings[:most]:
        kind = "note" if one.weight is Weight.NOTE else "warning"
        said = f"{one.sentence} [{one.code}]" if all_ else one.sentence
        remark(kind, f"{about}: {said}" if about else said)
    if more := len(findings) - most if most < len(findings) else 0:
        remark("note", f"{more} more with --details")


def names_in(text: str | None) -> list[str]:
    """Split a list like `a,b` into its names, without duplicates."""
    return [name for name in dict.fromkeys(n.strip() for n in (text or "").split(",")) if name]


@contextmanager
def stages() -> Iterator[Callable[[str], None]]:
    """Yield a function that shows the current stage of a long command ("" clears it).

    On a terminal the line is updated in place; elsewhere (in a log file, for example) the current
    stage is written every `EVERY` seconds, from the second time on with the seconds so far.
    """
    live, now, ended = is_live(sys.stderr), "", threading.Event()

    def tell(stage: str) -> None:
        nonlocal now
        now = stage
        if live:
            sys.stderr.write("\r\033[K")
            _write(f"{stage and stage + ' ...'}", sys.stderr, end="")

    def remind() -> None:
        last, began = "", time.monotonic()
        while not ended.wait(EVERY):
            if now:
                from grounded.progress import duration  # seldom needed

                taken = f", {duration(time.monotonic() - began)} so far"
                text = f"{SO_FAR.sub('', now)}{taken}" if now == last else now
                _write(f"{text} ...", sys.stderr)
            last = now

    if not live:
        threading.Thread(target=remind, daemon=True).start()
    try:
        yield tell
    finally:
        ended.set()
        tell("")


@contextmanager
def progress(text: str) -> Iterator[None]:
    """Show a text while something takes a while; see `stages`."""
    with stages() as tell:
        tell(text)
        yield


@contextmanager
def bar(text: str) -> Iterator[Callable[[int, int], None]]:
    """Yield a function (done, total) that shows a progress bar on stderr; see `stages`."""
    width = 30
    with stages() as tell:

        def count(done: int, total: int) -> None:
            full = done * width // max(total, 1)
            tell(f"{text} [{'#' * full}{'.' * (width - full)}] {done}/{total}")

        yield count


def sentence(text: str) -> None:
    """Write a sentence to stdout, wrapped to the terminal."""
    show("\n".join(lines(text, "", "  ")))


def table(rows: Sequence[Sequence[str]], header: Sequence[str]) -> str:
    """Format aligned columns: the first column and text left-aligned, numbers right-aligned.

    A table wider than the terminal wraps its headers at blanks, then its cells. Columns that still
    do not fit go into a second table with the same first column.
    """
    lines = [[cell.replace("\n", "?") for cell in row] for row in (header, *rows)]
    for gap in (2, 1):
        widths = _fit(lines, gap)
        ends = [end - gap for end in accumulate(width + gap for width in widths)]
        kept = max(2, sum(end <= columns() for end in ends))
        if kept >= len(widths):
            break
    if kept < len(widths):
        parts = [[[row[0], *row[k]] for row in lines] for k in (slice(1, kept), slice(kept, None))]
        return "\n\n".join(table(part[1:], part[0]) for part in parts)
    left = [i == 0 or _words([row[i] for row in lines[1:]]) for i in range(len(widths))]
    out = []
    for k, row in enumerate(lines):
        cells = [_broken(cell, width) for cell, width in zip(row, widths, strict=True)]
        tall = max(map(len, cells), default=0)
        for j in range(tall):
            texts = []
            for cell, width, to_left in zip(cells, widths, left, strict=True):
                at = j - (tall - len(cell)) if k == 0 else j  # headers are aligned at the bottom
                part = cell[at] if 0 <= at < len(cell) else ""
                pad = " " * (width - len(part))
                texts.append(tinted(part) + pad if to_left else pad + tinted(part))
            text = (" " * gap).join(texts).rstrip()
            out.append(style(text) if k == 0 else text)
    return "\n".join(out)


def _fit(lines: list[list[str]], gap: int) -> list[int]:
    """Return column widths that fit the terminal if possible; headers are broken before cells."""
    across = list(zip(*lines, strict=True))
    widths = [max(map(len, column)) for column in across]
    for whole in (True, False):  # whether cells stay on one line
        least = [
            max([_longest(name), *(len(c) if whole else _longest(c) for c in cells)])
            for name, *cells in across
        ]
        while sum(widths) + gap * (len(widths) - 1) > columns() and widths != least:
            loose = [w * (w > n) for w, n in zip(widths, least, strict=True)]
            widths[loose.index(max(loose))] -= 1
    return widths


def _longest(cell: str) -> int:
    """Return the length of the longest unbreakable part of a cell."""
    return max(map(len, glued(cell).split(" ")))


def _words(cells: Sequence[str]) -> bool:
    """Return whether a column holds words rather than numbers."""
    known = [cell for cell in cells if cell]
    return all(cell[0].isalpha() for cell in known) or 2 * sum(
        len(c.split()) > 3 for c in known
    ) > len(known)


def _broken(cell: str, width: int) -> list[str]:
    """Wrap a cell into lines."""
    if len(cell) <= width:
        return [cell]
    lines = textwrap.wrap(glued(cell), width, break_long_words=False, break_on_hyphens=False)
    return [line.replace("\xa0", " ") for line in lines]


def sparkline(values: Sequence[float]) -> str:
    """Draw utilities as small bars, with their scale behind them; a failed run is an x.

    If the worst utility would flatten all others, bars use the logarithm of the distance from 0.
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


# the option -C: a command's workspace, and the next command to type for it

_KEY = "grounded_cli.folder"


def located(ctx: click.Context, option: click.Parameter | None, folder: str | None) -> None:
    """Note the folder of -C, or of a workspace that a command made, for its further commands."""
    if folder is not None:
        ctx.meta[_KEY] = folder


def given() -> str | None:
    """Return the folder of -C of the running command, or None if it was not given."""
    ctx = click.get_current_context(silent=True)
    return None if ctx is None else ctx.meta.get(_KEY)


def open_workspace() -> Workspace:
    """Open the workspace that -C names, at the command or before it.

    Raises:
        GroundedError: if its grounded.toml is missing or invalid.
    """
    from grounded_trials import Workspace  # only commands that have a workspace need it

    return Workspace(given() or ".")


def typed(then: NextCommand, folder: str | None = None) -> str:
    """Format a command so that it works from here; `folder`: for its -C, None for that given."""
    if folder is None and then.verb not in ELSEWHERE:
        folder = given()
    return rendered(then, folder)


def next_line(then: NextCommand, folder: str | None = None) -> str:
    """Return the last line of an output, `next: ...`, with the command to type next."""
    return folded(typed(then, folder))
