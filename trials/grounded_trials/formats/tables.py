"""Tables of numbers as log records; those of `.npz` and PX4's `.ulg` are read here.

Every reader of tables is a function (path, layout) -> {topic: {column: numbers}}; `text_tables` has
that of `.csv`. `table_records` makes a topic of each table, whose rows are its messages, so that
tables are read like bags: `/csv.speed`, `/run03.q[1]`. Every table needs a column of times, which
is stated in the name of its type ("csv, time in 't'"). Names keep letters, digits and underscores;
a unit in brackets is left out.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from grounded.checks import refused
from grounded.units import factor_between
from grounded_trials.formats.mcap_records import About, Channel, End, Header, Record, Rows, Schema
from grounded_trials.formats.messages import Floats

C = TypeVar("C")
STAMPS = ("t", "time", "timestamp", "stamp", "times", "timestamps", "tout")
CANDIDATE = {"candidate", "feedforward", "law"}  # names of arrays in an exported one
TICKS = {  # an Arduino's functions, and their units in full
    **dict.fromkeys(("millis", "milliseconds"), "ms"),
    **{"micros": "us", "microseconds": "us", "nanoseconds": "ns"},
}
TIMES = (*STAMPS, "seconds", "secs", "clock", "clk", "elapsed", *TICKS)
ABROAD = (  # the same in other languages, used if no column has an English name
    *("zeit", "zeitstempel", "uhrzeit", "temps", "horodatage", "heure", "tiempo", "hora"),
    *("tempo", "ora", "tijd", "tid", "czas", "aika", "время", "时间", "時間", "时间戳"),
)
LATEST = 4e18  # [ns], the year 2096

Columns = Mapping[str, Floats]
Tables = dict[str, Columns]  # by topic


class Described(Tables):
    """Tables of a file that says more of them."""

    about = About()


@dataclass(frozen=True)
class Layout:
    """What a table without names or times does not say: `[log] columns` and `rate`."""

    columns: tuple[str, ...] = ()  # names of a text table's columns; (): its first line names them
    rate: float = 0.0  # [Hz] of the rows; 0: a column has their times


AS_IT_SAYS = Layout()


def columns_by_name(columns: Iterable[tuple[str, C]], path: Path) -> dict[str, C]:
    """Return columns by their names, which no two may share; one without a name is left out."""
    by_name: dict[str, C] = {}
    for name, column in columns:
        if name in by_name:
            raise refused("given.twice", path, name=name)
        if name:
            by_name[name] = column
    return by_name


def npz_tables(path: Path, layout: Layout = AS_IT_SAYS) -> Tables:
    """Return the tables of a NumPy archive: arrays of one length and their times.

    `NAME` (N, k) with `NAME_t` (N,) becomes the table /NAME, its columns named by an array of k
    texts if there is one; arrays (N,) with a time of that length become the table /npz. With a
    rate, the longest array and those of its length are that.
    """
    with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    if arrays.keys() >= CANDIDATE:
        raise refused("file.no_log", path, head=f"candidate {arrays['candidate']}")
    texts = {key: a for key, a in arrays.items() if a.ndim == 1 and a.dtype.kind == "U"}
    labels = {key: list(map(column_name, a)) for key, a in texts.items()}
    numbers = {k: np.asarray(a, float) for k, a in arrays.items() if a.dtype.kind in "fiub"}

    # The tables with times of their own, NAME and NAME_t.
    tables: Tables = {}
    for name, t in [(n, t) for n, t in numbers.items() if n.endswith("_t") and t.ndim == 1]:
        stem = name.removesuffix("_t")
        own = numbers.get(stem, np.zeros(0))
        if len(own) == len(t) and own.ndim <= 2:
            named = _columns(own, _labels(stem, own, labels, numbers), column_name(stem))
            tables["/" + column_name(stem)] = {"t": t} | columns_by_name(named, path)

    # What is left is one table: what is as long as its times, or with a rate as the longest.
    used = {name for name in numbers if "/" + column_name(name.removesuffix("_t")) in tables}
    rest = {k: a for k, a in numbers.items() if k not in used and a.ndim in (1, 2)}
    clocks = [k for k, a in rest.items() if a.ndim == 1 and len(a) > 1 and is_time(k)]
    rows = len(rest[clocks[0]]) if clocks else 0
    if layout.rate and not tables and not clocks:
        rows = max(map(len, rest.values()), default=0)
    flat = [(column_name(k), rest.pop(k)) for k in clocks[:1]]
    flat += [c for k, a in rest.items() if len(a) == rows for c in _columns(a, [], column_name(k))]
    return tables | ({"/npz": columns_by_name(flat, path)} if rows else {})


def _labels(
    table: str, array: Floats, labels: Mapping[str, list[str]], numbers: Mapping[str, Any]
) -> list[str]:
    """Return the array of texts that names an array's columns: `table_names`, else one as long.

    One that is called after another table, `other_names`, names that one's.
    """
    count = array.shape[1] if array.ndim == 2 else -1
    fits = {key: label for key, label in labels.items() if len(label) == count}
    others = {f"{other}_names" for other in numbers if other != table}
    free = (label for key, label in fits.items() if key not in others)
    return fits.get(f"{table}_names") or next(free, [])


def _columns(array: Floats, names: list[str], table: str) -> list[tuple[str, Floats]]:
    if array.ndim == 1:
        return [(table, array)]
    names = names or [f"{table}_{i}" for i in range(array.shape[1])]
    return [(name, array[:, i]) for i, name in enumerate(names) if not is_time(name)]


def ulog_tables(path: Path, layout: Layout = AS_IT_SAYS) -> Tables:
    """Return the topics of a PX4 log, read with pyulog."""
    from pyulog import ULog

    # pyulog prints problems, and does not close a file that it opened itself
    with path.open("rb") as stream, redirect_stdout(io.StringIO()):
        log = ULog(stream)
    tables: Tables = {}
    for data in log.data_list:
        topic = f"/{data.name}" + (f"_{data.multi_id}" if data.multi_id else "")
        fields = {k: np.asarray(v, float) for k, v in data.data.items() if "padding" not in k}
        tables[topic] = {"timestamp_us": fields.pop("timestamp")} | fields
    return tables


def table_records(
    tables: Mapping[str, Columns], kind: str, path: Path, rate: float = 0.0
) -> Iterator[Record]:
    """Yield tables, columns by topic, as records, one topic per table.

    `kind` is that of the file, such as "csv"; `rate` that of the rows [Hz], whatever times they
    have; 0: a column has their times.
    """
    if not tables:
        raise refused("file.no_times", path)
    yield Header("", kind)
    if isinstance(tables, Described):
        yield tables.about
    made = []
    for i, (topic, columns) in enumerate(tables.items()):
        if rate:  # the times are those of the rows, no column's
            rows = np.arange(len(next(iter(columns.values()))))
            name, stamps = "rows", np.rint(rows * (1e9 / rate)).astype(np.int64)
        else:
            name, stamps = _times(columns, path)
        yield Schema(i + 1, f"{kind}, time in '{name}'", "", b"")
        yield Channel(i, topic, "table", i + 1, {})
        made.append(Rows(i, stamps, {k: column for k, column in columns.items() if k != name}))
    yield from made
    yield End(data_crc=False)


def _times(columns: Columns, path: Path) -> tuple[str, Any]:
    """Return the name of the column of times, and its values [ns]."""
    for name, values in columns.items():
        if values.dtype.kind == "i":  # [ns], from texts
            return name, values
    if not (name := time_among(list(columns))):
        raise refused("file.no_times", path, names=tuple(columns)[:8])
    word = name.lower().rpartition("_")[2]
    unit = TICKS.get(word, word if word in ("ns", "us", "ms") else "")
    values = columns[name]
    finite = values[np.isfinite(values)]
    top = float(np.abs(finite).max(initial=0.0))
    if not unit:
        unit = "ns" if top > 1e17 else "us" if top > 1e14 else "ms" if top > 1e11 else "s"
    if lost := len(values) - len(finite):
        raise refused("file.times", path, name=name, lost=lost)
    nanoseconds = round(1e9 * (factor_between(unit, "s") or 1.0))
    if top * nanoseconds > LATEST:
        raise refused("file.times", path, name=name, text=f"{top:g} {unit}")
    return name, np.rint(values * nanoseconds).astype(np.int64)


def time_among(names: Sequence[str]) -> str:
    """Return the first name of a column of times, English before other languages; "" for none."""
    ranked = (n for words in (TIMES, ABROAD) for n in names if is_time(n, words))
    return next(ranked, "")


def is_time(name: str, words: Sequence[str] = (*TIMES, *ABROAD)) -> bool:
    """Check whether a column's name is that of a time, perhaps with a unit at the end."""
    stem = re.sub(rf"_?(in_)?(s|ns|us|ms|sec|{'|'.join(TICKS)})$", "", name.lower()) or name.lower()
    return name.lower() in words or stem in words


def column_name(cell: str) -> str:
    """Return a column's name in a form that a message path can contain."""
    bare = re.sub(r"[\[(].*?[\])]", "", cell.strip()) if not re.search(r"\[\d+\]", cell) else cell
    name = re.sub(r"[^\w\[\]]+", "_", bare.strip()).strip("_")
    unit = re.search(r"[\[(]\s*(ms|us|ns)\s*[\])]$", cell.strip())
    return f"{name}_{unit[1]}" if unit and is_time(name) else name
