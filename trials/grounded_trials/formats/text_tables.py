"""Tables of numbers as text, `.csv`, as the records of a log.

The line that names the columns is the first one with rows of numbers below it: what a PLC or a
logger writes above it is passed over, and a line of units between the two belongs to the names.
Columns are parted by tabs, semicolons or commas; where it isn't commas, 0,5 is a number. Times are
numbers, or texts of a date, a time of day, or both, in one column or two.
"""

from __future__ import annotations

import codecs
import csv
import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from grounded.errors import GroundedError
from grounded_trials.formats.mcap_records import Record
from grounded_trials.formats.messages import Floats
from grounded_trials.formats.tables import column_name, is_time, table_records, time_among

PREAMBLE = 100  # lines that may stand above the names of the columns
LOOK = 65536  # characters of a line
DATES = ("date", "datetime", "date_time", "datum", "datum_zeit", "fecha")
DAY = re.compile(r"^(\d{1,2})\.(\d{1,2})\.(\d{4})")  # as in Germany
CLOCK = re.compile(r"^(\d{1,2}):(\d{2}):(\d{2}(?:[.,]\d*)?)$")


@dataclass(frozen=True)
class _Head:
    """The line that names the columns."""

    names: tuple[str, ...]  # "" for a column without a name
    cells: tuple[str, ...]  # as the file has them, with the units of a line of their own
    mark: str  # between columns
    line: int  # of the names, from 1
    rows: int  # lines before the first row


def csv_records(path: Path) -> Iterator[Record]:
    """The records of a text table: a row of names, then rows of numbers.

    Raises:
        GroundedError: without names or times, or where a row doesn't fit.
    """
    with _opened(path) as stream:
        first = [stream.readline(LOOK) for _ in range(PREAMBLE + 2)]
        head = _head(first, path)
        width, times = len(head.names), _times_among(head, first, path)
        _pass_over(stream, head)
        try:
            with warnings.catch_warnings():  # a table without rows is found below
                warnings.simplefilter("ignore")
                values = np.loadtxt(stream, delimiter=head.mark, ndmin=2, usecols=range(width))
            stamps = None
        except ValueError:
            _pass_over(stream, head)
            values, stamps = _with_texts(stream, head, times, path)
    if not values.size:
        raise GroundedError(f"{path} has no rows below line {head.line}, which names the columns")
    columns: dict[str, Any] = {name: values[:, i] for i, name in enumerate(head.names) if name}
    if stamps is not None:
        columns[times] = stamps
    yield from table_records({"/csv": columns}, "csv", path)


def column_units(path: Path) -> dict[str, str]:
    """The units that a text table's head states, `x [m]` or `x (m)`, by message path."""
    if path.suffix.lower() not in (".csv", ".tsv", ".txt"):
        return {}
    with _opened(path) as stream:
        head = _head([stream.readline(LOOK) for _ in range(PREAMBLE + 2)], path)
    said = {
        name: re.search(r"[\[(]\s*([^\d\s][^\])]*?)\s*[\])]", cell)
        for name, cell in zip(head.names, head.cells, strict=True)
    }
    return {f"/csv.{name}": unit[1] for name, unit in said.items() if unit and '"' not in unit[1]}


def cut_off(path: Path) -> str:
    """That the last row of a text table was cut off and is left out; "" where it is whole."""
    if path.suffix.lower() not in (".csv", ".tsv", ".txt"):
        return ""
    with _opened(path) as stream:
        head, last = _head([stream.readline(LOOK) for _ in range(PREAMBLE + 2)], path), ""
        _pass_over(stream, head)
        for line in stream:
            last = line
    short = last.strip() and len(_cells(last, head.mark)) < len(head.names)
    if not short or not _is_cut([last]):
        return ""
    return (
        f"its last row, {last.strip()[:80]!r}, was cut off and is left out: the file ends in the "
        "middle of it, what came after is lost"
    )


def _opened(path: Path) -> TextIO:
    """The text in its encoding: UTF-8, UTF-16 where it says so, else that of Windows."""
    with path.open("rb") as stream:
        start = stream.read(LOOK)
    encoding = "utf-8-sig"
    if start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = "utf-16"
    else:
        try:
            codecs.getincrementaldecoder("utf-8")().decode(start)
        except UnicodeDecodeError:
            encoding = "cp1252"
    return path.open(encoding=encoding, errors="replace", newline="")


def _pass_over(stream: TextIO, head: _Head) -> None:
    """Moves to the first row."""
    stream.seek(0)
    for _ in range(head.rows):
        stream.readline()


def _head(lines: Sequence[str], path: Path) -> _Head:
    """The line that names the columns: the first one above a row of numbers, else the first."""
    for i, line in enumerate(lines[:PREAMBLE]):
        below = next((row for row in lines[i + 1 :] if row.strip()), "")
        for mark in (m for m in "\t;," if m in line):
            cells, row = _cells(line, mark), _cells(below, mark)
            if len(cells) == len(row) > 1 and _share(cells) == 0 and _share(row) > 0.5:
                return _named(lines, i, mark)
    mark = next((m for m in "\t;," if m in lines[0]), ",")
    cells = _cells(lines[0], mark)
    if not any(map(column_name, cells)) or _share(cells) == 1:
        raise GroundedError(
            f"{path} begins with {lines[0][:40].strip()!r}: a line above its rows must name the "
            "columns, one of them 't' (time in seconds), such as 't,x,v'"
        )
    return _named(lines, 0, mark)


def _named(lines: Sequence[str], at: int, mark: str) -> _Head:
    """The head at a line, which is the line of units where the one above it names the time."""
    cells, units, rows = _cells(lines[at], mark), [], at + 1
    above = _cells(lines[at - 1], mark) if at else []
    if len(above) == len(cells) and _any_time(above) and not _any_time(cells):
        cells, units, at = above, cells, at - 1
        units = [re.sub(r"^[\[(](.*)[\])]$", r"\1", unit.strip()) for unit in units]
        pairs = zip(cells, units, strict=True)
        cells = [f"{c} [{u}]" if u and not re.search(r"[\[(]", c) else c for c, u in pairs]
    return _Head(tuple(map(column_name, cells)), tuple(cells), mark, at + 1, rows)


def _cells(line: str, mark: str) -> list[str]:
    return [cell.strip() for cell in next(csv.reader([line], delimiter=mark), [])]


def _any_time(cells: Sequence[str]) -> bool:
    return any(is_time(column_name(cell)) for cell in cells)


def _share(cells: Sequence[str]) -> float:
    """How many of the cells that hold something hold a number or a time."""
    full = [cell for cell in cells if cell]
    held = [c for c in full if not np.isnan(_number(c.replace(",", ".", 1))) or _moment(c)]
    return len(held) / max(len(full), 1)


def _times_among(head: _Head, lines: Sequence[str], path: Path) -> str:
    """The name of the column of times; the message where none is names what could be."""
    found = time_among(head.names) or next((n for n in head.names if n.lower() in DATES), "")
    if found:
        return found
    rows = [_cells(row, head.mark) for row in lines[head.rows :] if row.strip()]
    rising = [n for i, n in enumerate(head.names) if n and _rises([r[i : i + 1] for r in rows])]
    maybe = f"'{rising[0]}' rises from row to row: if that is the time, name it" if rising else ""
    raise GroundedError(
        f"{path} has no column of times among {', '.join(filter(None, head.names[:8]))}, which its "
        f"line {head.line} names. {maybe or 'Name one'} 't' (seconds), or 't_ms', 't_us' or 't_ns' "
        "in their units ('time', 'stamp', 'clock', 'Zeit', 'temps', 'tiempo' will do too)"
    )


def _rises(cells: Sequence[Sequence[str]]) -> bool:
    found = [_number(cell[0].replace(",", ".", 1)) for cell in cells if cell]
    return len(found) > 2 and bool(np.all(np.diff(found) > 0))


def _with_texts(stream: TextIO, head: _Head, times: str, path: Path) -> tuple[Floats, Any]:
    """Rows with texts or empty cells, which are no number, and the times [ns] where those are.

    Without a last row that was cut off.
    """
    rows: list[list[float]] = []
    width, at = len(head.names), head.names.index(times)
    date = next((i for i, n in enumerate(head.names) if n.lower() in DATES and i != at), None)
    texts: list[tuple[int, str, str]] = []
    lines = list(stream)
    for number, row in enumerate(csv.reader(lines, delimiter=head.mark), start=head.rows + 1):
        if not any(cell.strip() for cell in row):
            continue
        if len(row) != width:
            if number > len(lines) + head.rows - 1 and len(row) < width and _is_cut(lines):
                break  # whoever wrote it was stopped there
            raise GroundedError(
                f"{path}, line {number}: it has {len(row)} cells, line {head.line} names {width}"
            )
        texts.append((number, row[at], "" if date is None else row[date]))
        if head.mark != ",":  # half of Europe writes 0,5
            row = [cell.replace(",", ".", 1) if "." not in cell else cell for cell in row]
        rows.append([_number(cell) for cell in row])
    values = np.array(rows, dtype=float).reshape(-1, width)
    if np.isfinite(values[:, at]).any() or not rows:
        return values, None  # numbers; those that are missing are counted with the times
    return values, _stamps(texts, times, path)


def _is_cut(lines: Sequence[str]) -> bool:
    return not lines[-1].endswith("\n")


def _stamps(texts: Sequence[tuple[int, str, str]], name: str, path: Path) -> Any:
    """Times [ns] of texts: since 1970 with a date, UTC where no zone is said, else of the day."""
    found, days = list[datetime](), timedelta()
    for line, text, date in texts:
        moment = _moment(f"{date.strip()} {text.strip()}".strip()) or _moment(text)
        if moment is None:
            raise GroundedError(
                f"{path}, line {line}: '{name}' is {text.strip()!r}, which is no time. Read are "
                "numbers (seconds, or in the unit that the name ends with, _ms, _us or _ns), "
                "2026-11-21 10:05:00.250, 21.11.2026 10:05:00.250 and 10:05:00.250, with the date "
                "in a column 'Date' or without one"
            )
        if found and moment + days < found[-1] - timedelta(hours=12) and moment.year == 1970:
            days += timedelta(days=1)  # past midnight, without a date
        found.append(moment + days)
    micro = timedelta(microseconds=1)
    start = datetime(1970, 1, 1, tzinfo=UTC)
    return np.array([(moment - start) // micro for moment in found], dtype=np.int64) * 1000


def _moment(text: str) -> datetime | None:
    """A date, a time of day (of 1970-01-01), or both; None for other texts."""
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
