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
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from grounded.checks import refused
from grounded.findings import found
from grounded_trials.formats.mcap_records import About
from grounded_trials.formats.tables import (
    AS_IT_SAYS,
    Described,
    Layout,
    Tables,
    column_name,
    columns_by_name,
    is_time,
    time_among,
)

SUFFIXES = (".csv", ".tsv", ".txt", ".dat")
PREAMBLE = 100  # largest number of lines above the column names
MARKS = "\t;,"  # that separate columns, the first that is there
LOOK = 65536  # bytes and characters that show the encoding and the separator
DATES = ("date", "datetime", "date_time", "datum", "datum_zeit", "fecha")
DAY = re.compile(r"^(\d{1,2})\.(\d{1,2})\.(\d{4})")  # as in Germany
CLOCK = re.compile(r"^(\d{1,2}):(\d{2}):(\d{2}(?:[.,]\d*)?)$")


@dataclass(frozen=True)
class _Head:
    """The line with the column names."""

    names: tuple[str, ...]  # "" for a column without a name
    cells: tuple[str, ...]  # as in the file, with units from a separate line
    mark: str  # separator of columns
    rows: int  # number of lines before the first row


def csv_tables(path: Path, layout: Layout = AS_IT_SAYS) -> Tables:
    """Return the numbers of a text table: a row of names, unless the layout has them, then rows.

    Its units stand in the names, `x [m]` or `x (m)`; an incomplete last row is told.
    """
    lines = _lines(path)
    head = _head_by(layout.columns, lines, path) if layout.columns else _head(lines, path)
    names, width = head.names, len(head.names)
    days = [name for name in names if name.lower() in DATES]
    time = "" if layout.rate else time_among(names) or next(iter(days), "")
    if not (time or layout.rate):
        raise refused("file.no_times", path, names=tuple(filter(None, names[:8])))
    date = next((i for i, name in enumerate(names) if name in days and name != time), None)
    cut = _cut(lines, head)

    # The numbers; times are texts if the first one is.
    numbers, texts = array("d"), list[tuple[int, str, str]]()
    rows = csv.reader(lines[head.rows : cut and cut[0] - 1], delimiter=head.mark)
    for line, row in enumerate(rows, start=head.rows + 1):
        if not any(cells := [cell.strip() for cell in row]):
            continue
        if any(cells[width:]) or len(cells) < width:
            raise refused("file.row", path, line=line, has=len(cells), names=width)
        numbers.extend(_number(cell, head.mark) for cell in cells[:width])
        text = cells[names.index(time)] if time else ""
        if texts or (len(numbers) == width and text and np.isnan(_number(text, head.mark))):
            texts.append((line, text, "" if date is None else cells[date]))
    if not numbers:
        raise refused("file.rows", path, rows="no", needs=1)
    values = np.array(numbers).reshape(-1, width)
    columns: dict[str, Any] = columns_by_name(zip(names, values.T, strict=True), path)
    columns |= {time: _stamps(texts, time, path)} if texts else {}

    # What it says of itself.
    said = (re.search(r"[\[(]\s*([^\d\s][^\])]*?)\s*[\])]", cell) for cell in head.cells)
    pairs = zip(names, said, strict=True)
    units = {f"/csv.{name}": m[1] for name, m in pairs if m and '"' not in m[1]}
    odd = [found("file.cut", str(path), line=str(cut[0]), text=cut[1][:80])] if cut else []
    tables = Described({"/csv": columns})
    tables.about = About(units, tuple(odd))
    return tables


def _cut(lines: Sequence[str], head: _Head) -> tuple[int, str] | None:
    """Return a last row whose writer was interrupted: its line number, and what is left of it.

    It has too few cells, or, without a line end, no number where the row before has one.
    """
    there = [i for i in range(len(lines) - 1, head.rows - 1, -1) if lines[i].strip()][:2]
    if not there:
        return None
    text = lines[there[0]].strip(" \t\0")
    last, *before = (_cells(lines[i].strip(" \t\0"), head.mark) for i in there)
    ends = [np.isnan(_number(cells[-1], head.mark)) for cells in (last, *before) if cells]
    half = bool(lines[-1]) and ends == [True, False]
    return (there[0] + 1, text) if half or len(last) < len(head.names) else None


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
        for mark in (m for m in MARKS if m in line):
            cells, row = _cells(line, mark), _cells(below, mark)
            if len(row) > 1 and _share(cells) == 0 and _share(row) > 0.5:
                if len(cells) == len(row) or len(_filled(cells)) == len(_filled(row)):
                    return _named(lines, i, mark)
                others.append((i, mark))
    if others:
        return _named(lines, *others[0])
    cells = _cells(lines[0], mark := _mark(lines[0]))
    if not any(map(column_name, cells)) or _share(cells) == 1:
        raise refused("file.no_times", path, line=lines[0][:40].strip())
    return _named(lines, 0, mark)


def _head_by(columns: Sequence[str], lines: Sequence[str], path: Path) -> _Head:
    """Return the head of a table whose first row of numbers has these columns."""
    for i, line in enumerate(lines[: PREAMBLE + 2]):
        cells = _filled(_cells(line, mark := _mark(line)))
        if cells and _share(cells) == 1:
            if len(cells) != len(columns):
                raise refused("file.row", path, has=len(cells), names=len(columns))
            return _Head(tuple(map(column_name, columns)), tuple(columns), mark, i)
    raise refused("file.rows", path, rows="no", needs=1)


def _mark(line: str) -> str:
    return next((mark for mark in MARKS if mark in line), ",")


def _named(lines: Sequence[str], at: int, mark: str) -> _Head:
    """Return the head at a line; if the line above names a time, this one holds the units."""
    cells = _filled(_cells(lines[at], mark))
    above = _filled(_cells(lines[at - 1], mark)) if at else []
    if len(above) == len(cells) and _any_time(above) and not _any_time(cells):
        units = [re.sub(r"^[\[(](.*)[\])]$", r"\1", unit.strip()) for unit in cells]
        pairs = zip(above, units, strict=True)
        cells = [f"{c} [{u}]" if u and not re.search(r"[\[(]", c) else c for c, u in pairs]
    return _Head(tuple(map(column_name, cells)), tuple(cells), mark, at + 1)


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
    held = [c for c in full if not np.isnan(_number(c, ";")) or _moment(c)]
    return len(held) / max(len(full), 1)


def _stamps(texts: Sequence[tuple[int, str, str]], name: str, path: Path) -> Any:
    """Convert texts to times [ns]: since 1970 with a date (UTC without a zone), else of the day."""
    moments, days = list[datetime](), timedelta()
    for line, text, date in texts:
        moment = _moment(f"{date.strip()} {text.strip()}".strip()) or _moment(text)
        if moment is None:
            raise refused("file.times", path, line=line, name=name, text=text.strip())
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


def _number(cell: str, mark: str) -> float:
    """Return a cell's number, NaN for another text; 0,5 is one if no comma separates columns."""
    try:
        return float(cell)
    except ValueError:
        if mark != "," and "," in cell and "." not in cell:
            return _number(cell.replace(",", ".", 1), mark)
        return float({"true": 1, "false": 0}.get(cell.lower(), "nan"))
