"""Numbers, units and verdicts in words for people."""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Sequence
from itertools import pairwise
from textwrap import TextWrapper
from typing import TYPE_CHECKING

from grounded.result import figure as figure
from grounded.result import percent as percent
from grounded.result import shown as shown
from grounded.result import with_unit as with_unit

if TYPE_CHECKING:
    from grounded.errors import NextCommand

ITERATION = (
    "iter.: improvements that a candidate builds on; it falls where the search goes back to "
    "an earlier one"
)
PIECES = 4  # of a list of trials that are named
NARROW, WIDE = 60, 80  # columns: what every line can do with, and what a reader likes at most
MARKS = "\ufdd0\ufdd1\ufdd2\ufdd3\ufdd4"  # of colours in a text: they take no column
_WORD = re.compile(r"""(?:'[^']*'|"[^"]*"|\S)+""")  # of a command; what is quoted stays whole
_GLUE = re.compile(
    r"(?<=[<>]) (?=[\d.-])| (?=[<>] )| (?=-> )| (?=%)"
    r"| (?=(?:\+-|±) )|(?<= (?:\+-)) |(?<= ±) |^ |(?<=^[ *]) "
    r"|(?<=\d) (?=(?:[mµc]?(?:m|s|rad)|deg|kg|N|Nm|V|A|Hz|nats)\b)| (?=[+-]\d[\d.]* %)"
    r"|(?<=noise:) |(?<=\bN) (?=m\b)|(?<=\bN m) (?=s\b)"
)  # blanks where no line is broken


def columns() -> int:
    """How wide a line is: the terminal's width (or COLUMNS) from 60 to 80; 80 in a file."""
    return min(max(shutil.get_terminal_size((WIDE, 24)).columns, NARROW), WIDE)


def count(number: int, word: str, many: str = "") -> str:
    """`1 trial`, `2 trials`; `many` where the plural is another one."""
    return f"{number} {word if number == 1 else many or word + 's'}"


def ranges(names: Sequence[str]) -> str:
    """`t0001, t0007 to t0016`: names in order, those that follow each other as a range.

    Of many pieces the ends, and how many are not among them.
    """
    digits = [name[1:] for name in names]
    if not all(map(str.isdecimal, digits)):
        return ", ".join(names)
    numbers = [int(number) for number in digits]
    cuts = [k for k, (a, b) in enumerate(pairwise(numbers), 1) if b != a + 1]
    pieces = [names[a:b] for a, b in pairwise([0, *cuts, len(names)])]
    if len(pieces) > PIECES:
        return f"{names[0]} to {names[-1]} without {numbers[-1] - numbers[0] + 1 - len(names)}"
    return ", ".join(" to ".join(dict.fromkeys([piece[0], piece[-1]])) for piece in pieces)


def changed(name: str, old: float, new: float, unit: str) -> str:
    """`m 1.00 -> 1.30 kg`, in as many digits as tell the two apart."""
    return with_unit(f"{name} {' -> '.join(in_digits_apart(old, new))}", unit)


def in_digits_apart(one: float, other: float) -> tuple[str, str]:
    """Two numbers in as many digits, three or more, as tell them apart."""
    for digits in range(3, 9):
        if float(f"{one:.{digits}g}") != float(f"{other:.{digits}g}"):
            return figure(one, digits), figure(other, digits)
    return figure(one), figure(other)


def legend(text: str, iterations: Sequence[int]) -> str:
    """What a table's columns mean; why iterations fall, where they do."""
    falls = any(b < a for a, b in pairwise(iterations))
    return "; ".join(part for part in (text, ITERATION * falls) if part)


def labelled(name: str, unit: str) -> str:
    """`v [m/s]`; the name alone where there is no unit."""
    return f"{name} [{unit}]" if shown(unit) else name


def per_second(unit: str) -> str:
    """The unit of a rate of change: rad/s of rad, m/s^2 of m/s."""
    if found := re.fullmatch(r"(.*)/s(?:\^(\d))?", unit):
        return f"{found[1]}/s^{int(found[2] or 1) + 1}"
    return f"{unit} per s" if set(unit) & set("/ ") else f"{unit}/s"


def wrapped(text: str, first: str, rest: str) -> list[str]:
    """Lines of a terminal's width, the first and the others begun as said."""
    wrapper = TextWrapper(columns(), initial_indent=first, subsequent_indent=rest)
    wrapper.break_on_hyphens = wrapper.break_long_words = False
    return [line.replace("\xa0", " ") for line in wrapper.wrap(glued(text))]


def glued(text: str) -> str:
    """Text whose numbers keep their %, unit, bound and spread when lines are broken."""
    return _GLUE.sub("\xa0", text)


def rendered(then: NextCommand, folder: str | None = None) -> str:
    """A command as a shell takes it: `grounded run c0003`, with `-C DIR` where a folder is given.

    Args:
        then: the command as data.
        folder: the workspace as the user named it, None where it is the current folder.
    """
    words = ["grounded", *(["-C", folder] if folder is not None else []), then.verb]
    return shlex.join([*words, *then.arguments])


def folded(command: str, lead: str = "next: ") -> str:
    """A command after its lead, broken as a shell allows where it is wider than a terminal."""
    lines = [lead]
    for word in _WORD.findall(command):
        if len(lines[-1]) + len(word) + 3 > columns() and lines[-1].strip():
            lines[-1] = lines[-1].rstrip() + " \\"
            lines.append("    ")
        lines[-1] += word + " "
    return "\n".join(line.rstrip() for line in lines)
