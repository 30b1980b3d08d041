"""Read text tables, `.csv`.

The line with the column names is the first one with rows of numbers below it. Lines above it, as a
PLC or a logger writes them, are skipped; a line of units below it belongs to the names. Columns are
separated by tabs, semicolons, commas or blanks; if not by commas, 0,5 is a number. Separators at
the end of a line don't count, in the names as in the rows. Times are numbers, or texts with a date,
a time of day, or both, in one column or two. A `Layout` stands for names or times that are missing.
"""

from __future__ import annotations

import codecs
import csv
import re
import warnings
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from grounded.errors import GroundedError
from grounded.findings import Finding, Weight, found
from grounded_trials.formats.messages import Floats
from grounded_trials.formats.tables import (
    AS_IT_SAYS,
    Layout,
    Tables,
    column_name,
    columns_by_name,
    is_time,
    time_among,
)
from grounded_trials.within import within

SUFFIXES = (".csv", ".tsv", ".txt", ".dat")
PREAMBLE = 100  # largest number of lines above the column names
LOOK = 65536  # bytes and characters that show the encoding and the separator
BEFORE = 20  # rows before the last one that show how many digits its last cell should have
NAMELESS = ("file.no_times",)  # which [log] says then
DATES = ("date", "datetime", "date_time", "datum", "datum_zeit", "fecha")
DAY = re.compile(r"^(\d{1,2})\.(\d{1,2})\.(\d{4})")  # as in Germany
SECONDS = re.compile(r"(^|[\W_])s(ec|ecs|econds)?[\])]?$")  # at the end of a column's name
CLOCK = re.compile(r"^(\d{1,2}):(\d{2}):(\d{2}(?:[.,]\d*)?)$")


@dataclass(frozen=True)
class _Head:
    """The line with the column names."""

    names: tuple[str, ...]  # "" for a column without a name
    cells: tuple[str, ...]  # as in the file, with units from a separate line
    mark: str  # separator of columns
    line: int  # line number of the names, from 1
    rows: int  # number of lines before the first row


@dataclass(frozen=True)
class AboutTable:
    """What the head of a text table says, and what is odd about its rows."""

    units: Mapping[str, str]  # in column names, `x [m]` or `x (m)`, by message path
    in_time_units: bool  # its times are in seconds (`time_s`, `time [s]`), or times of day
    findings: tuple[Finding, ...]  # an incomplete last row, a last column without numbers


def csv_tables(path: Path, layout: Layout = AS_IT_SAYS) -> Tables:
    """Return the numbers of a text table: a row of names, unless the layout has them, then rows.

    Raises:
        GroundedError: if names or times are missing, or a row has a wrong number of cells.
    """
    table = _Table(path, layout.columns)
    head = table.head
    times = "" if layout.rate else _times_among(table)
    table.check_widths()
    rows = table.rows if table.cut is None else table.rows[: table.cut[0] - head.rows - 1]
    stamps = None
    try:
        with warnings.catch_warnings():  # a table without rows is reported below
            warnings.simplefilter("ignore")
            width = range(len(head.names))
            values = np.loadtxt(rows, delimiter=head.mark, ndmin=2, usecols=width)
    except ValueError:
        values, stamps = _with_texts(rows, head, times, path)
    if not values.size:
        raise GroundedError(found("file.rows", str(path), rows="no", needs=1))
    columns: dict[str, Any] = columns_by_name(zip(head.names, values.T, strict=True), path)
    return {"/csv": columns if stamps is None else columns | {times: stamps}}


def about_table(path: Path) -> AboutTable:
    """Return what a text table that names its columns says of itself; nothing for another file."""
    try:
        if path.suffix.lower() in SUFFIXES:
            return within(path, path.stat().st_size, _about, path)
    except GroundedError as error:
        if error.finding is None or error.finding.code not in NAMELESS:
            raise
    return AboutTable({}, False, ())


def _about(path: Path) -> AboutTable:
    table = _Table(path)
    head, odd, name = table.head, list[Finding](), str(path)
    said = {
        name: re.search(r"[\[(]\s*([^\d\s][^\])]*?)\s*[\])]", cell)
        for name, cell in zip(head.names, head.cells, strict=True)
    }
    units = {f"/csv.{name}": m[1] for name, m in said.items() if m and '"' not in m[1]}
    if table.empty_last():
        facts: dict[str, Any] = {"name": head.cells[-1], "line": head.line}
        odd.append(found("file.empty_column", name, **facts, weight=Weight.WARN))
    if table.cut is not None:
        odd.append(found("file.cut", name, line=str(table.cut[0]), text=table.cut[1][:80]))
    row = next((_cells(row, head.mark) for row in table.rows if row.strip()), [])
    at = head.names.index(time) if (time := _time_in(head)) else len(head.names)
    named = any(SECONDS.search(cell.lower()) for cell in head.cells[at : at + 1])
    return AboutTable(units, named or ":" in "".join(row[at : at + 1]), tuple(odd))


class _Table:
    """A text table: its head, and the lines of its rows."""

    def __init__(self, path: Path, columns: Sequence[str] = ()) -> None:
        self.path = path
        lines = _lines(path)
        self.ended = not lines[-1]  # with a line end
        self.head = _head_by(columns, lines, path) if columns else _head(lines, path)
        self.rows = lines[self.head.rows :]

    def numbered(self) -> Iterator[tuple[int, str]]:
        """Yield the rows that are not blank with their line numbers, from 1."""
        lines = enumerate(self.rows, start=self.head.rows + 1)
        return ((number, line) for number, line in lines if line.strip())

    def check_widths(self) -> None:
        """Check that no row has more cells than names; empty ones at its end don't count.

        Raises:
            GroundedError: if one has, or if a column without a name has the numbers that the last
                one lacks, so that it is unclear which cell belongs to which name.
        """
        head = self.head
        for number, line in self.numbered():
            if line.count(head.mark) >= len(head.names):
                cells = _cells(line, head.mark)
                if any(cells[len(head.names) :]):
                    raise _misfit(self.path, number, cells, head)
        if "" in head.names and self.empty_last():
            facts: dict[str, Any] = {"line": head.line, "name": head.cells[-1]}
            facts["column"] = head.names.index("") + 1
            raise GroundedError(found("file.empty_column", str(self.path), **facts))

    def empty_last(self) -> bool:
        """Return whether the last column is empty in every row, which ends with a separator."""
        mark, width = self.head.mark, len(self.head.names)
        rows = (line.strip(" ") for _, line in self.numbered())
        return all(row.endswith(mark) and row.count(mark) < width for row in rows)

    @cached_property
    def cut(self) -> tuple[int, str] | None:
        """A last row whose writer was interrupted: its line number, and what is left of it.

        It has too few cells, or, without a line end, half a number.
        """
        mark, last = self.head.mark, deque(self.numbered(), maxlen=BEFORE + 1)
        if not last:
            return None
        (number, line), before = last[-1], [_cells(line, mark) for _, line in last][:-1]
        text = line.strip(" \t\0")
        cells = _cells(text if "\0" in line else line, mark)
        whole = self.ended or not all(len(row) == len(cells) for row in before)
        short = len(cells) < len(self.head.names)
        half = not (whole or _ends(cells[-1], [row[-1] for row in before]))
        return (number, text) if short or half else None


def _misfit(path: Path, line: int, cells: Sequence[str], head: _Head) -> GroundedError:
    """Return the error for a row with a wrong number of cells, saying what may be its cause."""
    names, has = len(head.names), len(cells)
    twice = head.mark == "," and names < has <= 2 * names
    comma = twice and all("." not in cell and _share([cell]) == 1 for cell in cells)
    facts: dict[str, Any] = {"line": line, "has": has, "names": names, "comma": int(comma)}
    return GroundedError(found("file.row", str(path), **facts))


def _ends(cell: str, before: Sequence[str]) -> bool:
    """Check whether the last cell of a file is as complete as those above it."""
    if any(np.isnan(_number(one)) for one in before):
        return True  # texts or empty cells
    digits = {len(one.partition(".")[2]) for one in before}
    fixed = len(digits) == 1 and len(before) >= BEFORE
    return not np.isnan(_number(cell)) and not (fixed and len(cell.partition(".")[2]) < min(digits))


def _lines(path: Path) -> list[str]:
    """Return the lines of a text file in UTF-16 with a byte order mark, UTF-8, else Windows-1252.

    Where columns are separated by blanks, tabs take their place; what marks a comment is left out.
    """
    data = path.read_bytes()
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        text = data.decode("utf-16", "replace")
    else:
        try:
            codecs.getincrementaldecoder("utf-8")().decode(data[:LOOK])
            text = data.decode("utf-8-sig", "replace")
        except UnicodeDecodeError:
            text = data.decode("cp1252", "replace")
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    head = text[:LOOK]
    if not re.search(r"[\t;,]", head) and re.search(r"[^\s#%] +[^\s]", head):
        return ["\t".join(line.lstrip("#% ").split()) for line in lines]
    return lines


def _head(lines: Sequence[str], path: Path) -> _Head:
    """Find the line with the column names: the first one above a row of numbers, else line 1.

    A line with as many names as that row has cells comes before any other.
    """
    others: list[tuple[int, str]] = []
    for i, line in enumerate(lines[:PREAMBLE]):
        below = next((row for row in lines[i + 1 : PREAMBLE + 2] if row.strip()), "")
        for mark in (m for m in "\t;," if m in line):
            cells, row = _cells(line, mark), _cells(below, mark)
            if len(row) > 1 and _share(cells) == 0 and _share(row) > 0.5:
                if len(cells) == len(row) or len(_filled(cells)) == len(_filled(row)):
                    return _named(lines, i, mark)
                others.append((i, mark))
    if others:
        return _named(lines, *others[0])
    mark = next((m for m in "\t;," if m in lines[0]), ",")
    cells = _cells(lines[0], mark)
    if not any(map(column_name, cells)) or _share(cells) == 1:
        raise GroundedError(found("file.no_times", str(path), line=lines[0][:40].strip()))
    return _named(lines, 0, mark)


def _head_by(columns: Sequence[str], lines: Sequence[str], path: Path) -> _Head:
    """Return the head of a table whose first row of numbers has these columns.

    Raises:
        GroundedError: if it has another number of them.
    """
    lines = lines[: PREAMBLE + 2]
    marks = [next((m for m in "\t;," if m in line), ",") for line in lines]
    rows = [_filled(_cells(line, mark)) for line, mark in zip(lines, marks, strict=True)]
    i = next((i for i, cells in enumerate(rows) if cells and _share(cells) == 1), None)
    if i is None:
        raise GroundedError(found("file.rows", str(path), rows="no", needs=1))
    cells, mark = rows[i], marks[i]
    if len(cells) != len(columns):
        raise GroundedError(found("file.row", str(path), has=len(cells), names=len(columns)))
    return _Head(tuple(map(column_name, columns)), tuple(columns), mark, i, i)


def _named(lines: Sequence[str], at: int, mark: str) -> _Head:
    """Return the head at a line; if the line above names a time, this one holds the units."""
    cells, units, rows = _filled(_cells(lines[at], mark)), [], at + 1
    above = _filled(_cells(lines[at - 1], mark)) if at else []
    if len(above) == len(cells) and _any_time(above) and not _any_time(cells):
        cells, units, at = above, cells, at - 1
        units = [re.sub(r"^[\[(](.*)[\])]$", r"\1", unit.strip()) for unit in units]
        pairs = zip(cells, units, strict=True)
        cells = [f"{c} [{u}]" if u and not re.search(r"[\[(]", c) else c for c, u in pairs]
    return _Head(tuple(map(column_name, cells)), tuple(cells), mark, at + 1, rows)


def _cells(line: str, mark: str) -> list[str]:
    return [cell.strip() for cell in next(csv.reader([line], delimiter=mark), [])]


def _filled(cells: list[str]) -> list[str]:
    """Return cells without empty ones at the end: the line ended with separators."""
    while cells and not cells[-1]:
        cells = cells[:-1]
    return cells


def _any_time(cells: Sequence[str]) -> bool:
    return any(is_time(column_name(cell)) for cell in cells)


def _share(cells: Sequence[str]) -> float:
    """Return the share of non-empty cells that hold a number or a time."""
    full = [cell for cell in cells if cell]
    held = [c for c in full if not np.isnan(_number(c.replace(",", ".", 1))) or _moment(c)]
    return len(held) / max(len(full), 1)


def _time_in(head: _Head) -> str:
    """Return the name of the column of times, "" for none."""
    return time_among(head.names) or next((n for n in head.names if n.lower() in DATES), "")


def _times_among(table: _Table) -> str:
    """Return the name of the column of times.

    Raises:
        GroundedError: if there is none, suggesting a column whose values increase.
    """
    head = table.head
    if named := _time_in(head):
        return named
    rows = [_cells(row, head.mark) for row in table.rows[:PREAMBLE] if row.strip()]
    rising = [n for i, n in enumerate(head.names) if n and _rises([r[i : i + 1] for r in rows])]
    names = tuple(filter(None, head.names[:8]))
    rises = rising[0] if rising else ""
    raise GroundedError(found("file.no_times", str(table.path), names=names, rises=rises))


def _rises(cells: Sequence[Sequence[str]]) -> bool:
    values = [_number(cell[0].replace(",", ".", 1)) for cell in cells if cell]
    return len(values) > 2 and bool(np.all(np.diff(values) > 0))


def _with_texts(lines: Iterable[str], head: _Head, times: str, path: Path) -> tuple[Floats, Any]:
    """Read rows with texts or empty cells as NaN, and times [ns] if these are texts, else None."""
    rows: list[list[float]] = []
    width, at = len(head.names), head.names.index(times) if times else -1
    date = next((i for i, n in enumerate(head.names) if n.lower() in DATES and i != at), None)
    texts: list[tuple[int, str, str]] = []
    for number, row in enumerate(csv.reader(lines, delimiter=head.mark), start=head.rows + 1):
        if not any(cell.strip() for cell in row):
            continue
        if not any(row[width:]):
            row = row[:width]
        if len(row) != width:
            raise _misfit(path, number, row, head)
        texts.append((number, row[at] if times else "", "" if date is None else row[date]))
        if head.mark != ",":  # decimal comma
            row = [cell.replace(",", ".", 1) if "." not in cell else cell for cell in row]
        rows.append([_number(cell) for cell in row])
    values = np.array(rows, dtype=float).reshape(-1, width)
    if not times or np.isfinite(values[:, at]).any() or not rows:
        return values, None  # times are numbers; missing ones are reported later
    return values, _stamps(texts, times, path)


def _stamps(texts: Sequence[tuple[int, str, str]], name: str, path: Path) -> Any:
    """Convert texts to times [ns]: since 1970 with a date (UTC without a zone), else of the day."""
    moments, days = list[datetime](), timedelta()
    for line, text, date in texts:
        moment = _moment(f"{date.strip()} {text.strip()}".strip()) or _moment(text)
        if moment is None:
            raise GroundedError(
                found("file.times", str(path), line=line, name=name, text=text.strip())
            )
        if moments and moment + days < moments[-1] - timedelta(hours=12) and moment.year == 1970:
            days += timedelta(days=1)  # past midnight, without a date
        moments.append(moment + days)
    micro = timedelta(microseconds=1)
    start = datetime(1970, 1, 1, tzinfo=UTC)
    return np.array([(moment - start) // micro for moment in moments], dtype=np.int64) * 1000


def _moment(text: str) -> datetime | None:
    """Parse a date with a time of day, or a time of day (of 1970-01-01); None for other texts."""
    if ":" not in text:
        return None
    if clock := CLOCK.match(text):
        text = f"1970-01-01 {int(clock[1]):02d}:{clock[2]}:{clock[3]}"
    elif day := DAY.match(text):
        text = f"{day[3]}-{int(day[2]):02d}-{int(day[1]):02d}{text[day.end() :]}"
    try:
        moment = datetime.fromisoformat(text.replace(",", "."))
    except ValueError:
        return None
    return moment.replace(tzinfo=moment.tzinfo or UTC)


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return float({"true": 1, "false": 0}.get(cell.strip().lower(), "nan"))
