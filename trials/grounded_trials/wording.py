"""Formats numbers, units and commands for people."""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Collection, Sequence
from itertools import pairwise
from textwrap import TextWrapper

from grounded.errors import NextCommand
from grounded.result import extent as extent
from grounded.result import figure as figure
from grounded.result import or_zero as or_zero
from grounded.result import per_second as per_second
from grounded.result import percent as percent
from grounded.result import shown as shown
from grounded.result import spread as spread
from grounded.result import with_unit as with_unit

ITERATION = (
    "iter.: improvements that a candidate builds on; it decreases where the search returns to "
    "an earlier one"
)
ALONE = " (not determined alone, only with the others)"  # of an adopted value
PIECES = 4  # largest number of ranges that a list of trials names
NARROW, WIDE = 60, 80  # columns: smallest and largest line width
MARKS = "\ufdd0\ufdd1\ufdd2\ufdd3\ufdd4"  # colour marks in a text, of zero width
# commands that use no workspace: they are printed without -C
ELSEWHERE = frozenset(
    {"init", "recover", "demo", "experiment", "challenge", "completion", "explain"}
)
_NAMED = re.compile(r"`(?:grounded ([a-z][^`]*)|((?:discard|restore) [^`]*))`")
_WORD = re.compile(r"""(?:'[^']*'|"[^"]*"|\S)+""")  # a word of a command; quotes stay together
_GLUE = re.compile(
    r"(?<=[<>]) (?=[\d.-])| (?=[<>] )| (?=-> )| (?=%)"
    r"| (?=(?:\+-|±) )|(?<= (?:\+-)) |(?<= ±) |^ |(?<=^[ *]) "
    r"|(?<=\d) (?=(?:[mµc]?(?:m|s|rad)|deg|kg|N|Nm|V|A|Hz|nats)\b)| (?=[+-]\d[\d.]* %)"
    r"| (?== -?\d)|(?<= =) (?=-?\d)|(?<=noise:) |(?<=\bN) (?=m\b)|(?<=\bN m) (?=s\b)"
    r"|(?<=\d) (?=times\b)"
)  # blanks at which a line must not be broken


def columns() -> int:
    """Return the line width: that of the terminal (or COLUMNS), 60 to 80; 80 in a file."""
    return min(max(shutil.get_terminal_size((WIDE, 24)).columns, NARROW), WIDE)


def count(number: int, word: str) -> str:
    """Return `1 trial`, `2 trials`."""
    return f"{number} {word if number == 1 else word + 's'}"


def ranges(names: Sequence[str]) -> str:
    """Return `t0001, t0007 to t0016`: names in order, three or more in a row as a range.

    Two names alone are `t0001 and t0002` if they follow each other. More than `PIECES` ranges
    become the first and last name and the number of names missing between them.
    """
    digits = [name[1:] for name in names]
    if not all(map(str.isdecimal, digits)):
        return ", ".join(names)
    numbers = [int(number) for number in digits]
    cuts = [k for k, (a, b) in enumerate(pairwise(numbers), 1) if b != a + 1]
    pieces = [names[a:b] for a, b in pairwise([0, *cuts, len(names)])]
    if len(pieces) > PIECES:
        return f"{names[0]} to {names[-1]} without {numbers[-1] - numbers[0] + 1 - len(names)}"
    if len(pieces) == 1 and len(names) == 2:
        return " and ".join(names)
    told = (p if len(p) < 3 else [f"{p[0]} to {p[-1]}"] for p in pieces)
    return ", ".join(name for piece in told for name in piece)


def moved(old: float, new: float, unit: str, least: int = 3) -> str:
    """Return `1.00 -> 1.30 kg`, with enough digits to distinguish the two values."""
    was, now = in_digits_apart(old, new, least)
    if was == now:
        return f"{with_unit(now, unit)}, as before"
    return with_unit(f"{was} -> {now}", unit)


def in_digits_apart(one: float, other: float, least: int = 3) -> tuple[str, str]:
    """Format two numbers with enough digits to distinguish them, at least `least`."""
    one, other = extent(one, other)
    for digits in range(least, 9):
        if float(f"{one:.{digits}g}") != float(f"{other:.{digits}g}"):
            return figure(one, digits), figure(other, digits)
    return figure(one), figure(other)


def legend(text: str, iterations: Sequence[int]) -> str:
    """Return a table's legend; explains `iter.` if the iterations decrease anywhere."""
    falls = any(b < a for a, b in pairwise(iterations))
    return "; ".join(part for part in (text, ITERATION * falls) if part)


def labelled(name: str, unit: str) -> str:
    """Return `v [m/s]`, or the name alone if there is no unit."""
    return f"{name} [{unit}]" if shown(unit) else name


def wrapped(text: str, first: str, rest: str) -> list[str]:
    """Wrap a text to the terminal's width; `first` and `rest` are the lines' indents."""
    wrapper = TextWrapper(columns(), initial_indent=first, subsequent_indent=rest)
    wrapper.break_on_hyphens = wrapper.break_long_words = False
    return [line.replace("\xa0", " ") for line in wrapper.wrap(glued(text))]


def glued(text: str) -> str:
    """Join numbers with their %, unit, bound and spread by blanks at which no line is broken."""
    return _GLUE.sub("\xa0", text)


def rendered(then: NextCommand, folder: str | None = None) -> str:
    """Return a command for the shell, `grounded run c0003`, with `-C DIR` if a folder is given."""
    words = ["grounded", *(["-C", folder] if folder is not None else []), then.verb]
    return shlex.join([*words, *then.arguments])


def placed(text: str, folder: str | None) -> str:
    """Add -C DIR to the commands in a text if a folder is given.

    These are `grounded VERB ...`, and those that name a trial (`discard t0007`) without `grounded`.
    """

    def as_typed(found: re.Match[str]) -> str:
        try:
            verb, *arguments = shlex.split(found[1] or found[2])
        except ValueError:  # an unbalanced quote, in text from an untrusted file
            return found[0]
        there = None if verb in ELSEWHERE else folder
        return f"`{rendered(NextCommand(verb, tuple(arguments)), there)}`"

    return _NAMED.sub(as_typed, text) if folder is not None else text


def folded(command: str) -> str:
    """Return a command as the next one, continued with a backslash if wider than the terminal."""
    lines = ["next: "]
    for word in _WORD.findall(command):
        if len(lines[-1]) + len(word) + 3 > columns() and lines[-1].strip():
            lines[-1] = lines[-1].rstrip() + " \\"
            lines.append("    ")
        lines[-1] += word + " "
    return "\n".join(line.rstrip() for line in lines)


def what_became(gone: Collection[str], aside: Collection[str]) -> str:
    """Return what became of trials that are used no more: "set aside", or lost without a word."""
    lost = [name for name in gone if name not in aside]
    return f"set aside, or missing in trials/ ({', '.join(lost)})" if lost else "set aside"
