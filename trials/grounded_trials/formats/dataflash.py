"""Read ArduPilot's logs, `.bin`.

A log is a sequence of messages: A3 95, a type, a body of fixed length. Messages FMT say the name,
length, fields and names of each type; FMTU, UNIT and MULT the fields' units. A type becomes a topic
/ATT, its second instance /IMU_1, and its messages are decoded at once. A damaged part is passed
over: reading goes on at the next message that another follows.

Source: https://ardupilot.org/dev/docs/code-overview-adding-a-new-log-message.html and
`libraries/AP_Logger/LogStructure.h`. pymavlink reads these logs too, message by message, but its
reader is under the GPL.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from grounded_trials.formats.mcap_records import About
from grounded_trials.formats.messages import Floats
from grounded_trials.formats.tables import AS_IT_SAYS, Described, Layout, Tables, column_name

BEGINS = b"\xa3\x95\x80"  # a log's first message is an FMT
HEAD, FMT, FMT_LENGTH = BEGINS[:2], 0x80, 89
TIMES = {"TimeUS": "time_us", "TimeMS": "time_ms"}  # since the autopilot was switched on
FIELDS = {  # letter -> type in NumPy, and the factor of what it stores
    **{"b": ("i1", 1.0), "B": ("u1", 1.0), "M": ("u1", 1.0), "h": ("<i2", 1.0), "H": ("<u2", 1.0)},
    **{"i": ("<i4", 1.0), "I": ("<u4", 1.0), "q": ("<i8", 1.0), "Q": ("<u8", 1.0)},
    **{"g": ("<f2", 1.0), "f": ("<f4", 1.0), "d": ("<f8", 1.0), "L": ("<i4", 1e-7)},
    **{"c": ("<i2", 0.01), "C": ("<u2", 0.01), "e": ("<i4", 0.01), "E": ("<u4", 0.01)},
    **{"n": ("S4", 0.0), "N": ("S16", 0.0), "Z": ("S64", 0.0), "a": ("V64", 0.0)},
}
INSTANCE = "#"  # the unit of a field that counts sensors of one kind
SPELLED = {"m/s/s": "m/s^2", "degheading": "deg"}


@dataclass
class _Type:
    """A type of messages: its name, and where its fields are."""

    name: str
    length: int
    letters: str
    columns: list[str]
    units: str = ""  # a letter for each field
    at: list[int] = field(default_factory=list)  # where its messages begin

    @property
    def layout(self) -> np.dtype[Any]:
        """Return the layout of a message's body."""
        kinds = [FIELDS[letter][0] for letter in self.letters]
        return np.dtype(list(zip(self.columns, kinds, strict=True)))


def dataflash_tables(path: Path, layout: Layout = AS_IT_SAYS) -> Tables:
    """Return the messages of a log that have numbers and a time, and the units that it states."""
    data = path.read_bytes()
    types = _types(data)
    labels = {chr(unit): text for unit, text in _texts(data, types, "UNIT", "Id", "Label")}
    tables, units = Described(), dict[str, str]()
    for one in types:
        for kind, topic, rows in _instances(one, _rows(data, one)):
            if columns := _numbers(kind, rows):
                tables[topic] = columns
            for column, letter in zip(kind.columns, kind.units, strict=False):
                if label := labels.get(letter):
                    units[f"{topic}.{column_name(column)}"] = SPELLED.get(label, label)
    tables.about = About(units)
    return tables


def _types(data: bytes) -> list[_Type]:
    """Return the types of messages in a log, with the places of theirs."""
    types: dict[int, _Type] = {FMT: _Type("FMT", FMT_LENGTH, "BBnNZ", [*"tlnfc"])}
    lengths, at, end = [0] * 256, 0, len(data)
    lengths[FMT] = FMT_LENGTH
    while 0 <= at < end - 3:
        number = data[at + 2]
        length, after = lengths[number], at + lengths[number]
        goes_on = after >= end - 3 or data[after : after + 2] == HEAD  # or the log ends
        if data[at : at + 2] != HEAD or not length or after > end or not goes_on:
            at = data.find(HEAD, at + 1)
            continue
        types[number].at.append(at)
        if number == FMT:
            made = _defined(data[at + 3 : after])
            if made is not None:
                types[data[at + 3]], lengths[data[at + 3]] = made, made.length
        at = after
    for number, units in _texts(data, types.values(), "FMTU", "FmtType", "UnitIds"):
        if number in types:
            types[number].units = units
    return [kind for number, kind in types.items() if number != FMT]


def _defined(body: bytes) -> _Type | None:
    """Return the type that an FMT defines; None if it can't be decoded."""
    name, letters, columns = (
        body[a:b].split(b"\0")[0].decode("ascii", "replace") for a, b in ((2, 6), (6, 22), (22, 86))
    )
    made = _Type(name, body[1], letters, [one for one in columns.split(",") if one])
    known = all(letter in FIELDS for letter in letters) and len(letters) == len(made.columns)
    distinct = len(set(made.columns)) == len(letters)
    return made if known and distinct and made.layout.itemsize + 3 == made.length else None


def _rows(data: bytes, kind: _Type) -> Any:
    """Return the messages of a type as a structured array."""
    places = np.array(kind.at, np.int64)[:, None] + np.arange(3, kind.length)
    return np.frombuffer(data, np.uint8)[places].view(kind.layout)[:, 0]


def _texts(data: bytes, types: Iterable[_Type], name: str, *keys: str) -> list[tuple[int, str]]:
    """Return pairs of two fields of all messages with a name, a number and a text."""
    pairs: list[tuple[int, str]] = []
    for kind in types:
        if kind.name == name and {*keys} <= {*kind.columns}:
            numbers, texts = (_rows(data, kind)[key].tolist() for key in keys)
            pairs += zip(numbers, (one.decode("latin-1") for one in texts), strict=True)
    return pairs


def _instances(kind: _Type, rows: Any) -> Iterator[tuple[_Type, str, Any]]:
    """Yield the topic of each sensor of a type, and its messages."""
    name = re.sub(r"\W", "_", kind.name)
    counted = [c for c, unit in zip(kind.columns, kind.units, strict=False) if unit == INSTANCE]
    if not counted or not len(rows) or rows[counted[0]].dtype.kind not in "iu":
        yield kind, f"/{name}", rows
        return
    for number in np.unique(rows[counted[0]]).tolist():
        topic = f"/{name}" + f"_{number}" * (number != 0)
        yield kind, topic, rows[rows[counted[0]] == number]


def _numbers(kind: _Type, rows: Any) -> dict[str, Floats]:
    """Return the columns of numbers of messages, and their times; {} without these."""
    time = next((name for name in kind.columns if name in TIMES), "")
    if not time or not len(rows):
        return {}
    columns = {
        column_name(name): rows[name] * FIELDS[letter][1]
        for name, letter in zip(kind.columns, kind.letters, strict=True)
        if FIELDS[letter][1] and name != time
    }
    return {TIMES[time]: rows[time].astype(float)} | columns if columns else {}
