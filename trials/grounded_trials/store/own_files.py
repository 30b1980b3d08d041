"""The common part of trial files and candidate files: their metadata table and a strict reader.

The whole file is read before any number is returned: it must have a matching data checksum, so that
flipped bits are detected. Limits keep untrusted files from exhausting the memory. Errors name the
file and the position.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from grounded.checks import refused, unknown, wrong
from grounded.errors import GroundedError
from grounded.frozen import Array
from grounded_trials.formats.bad import BadSchema
from grounded_trials.formats.mcap_records import MAGIC, Attachment, End, Messages, Metadata, Schema
from grounded_trials.formats.mcap_walk import (
    DamagedFile,
    Part,
    Topic,
    by_topic,
    mapped,
    read_records,
)
from grounded_trials.formats.protobuf import double_tag, doubles_tag, numbers_in, uniform_doubles
from grounded_trials.plain_file import open_file, read_file, unreadable

FILE_LIMIT = 1 * 2**30  # [bytes]
NAME_LIMIT = 1000  # number of states or of inputs

TRIAL, CANDIDATE = "grounded trial 1", "grounded candidate 1"
RESERVED = ["format", "dt", "states", "inputs", "policy", "steps"]
RESERVED += ["candidate", "start_inputs", "start_states", "start_ns", "sha256"]

Meta = Mapping[str, str]
Units = Mapping[str, str]
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class OwnFile:
    """The contents of a trial or candidate file: messages by topic, metadata, attachments."""

    name: str
    data: bytes
    meta: dict[str, str]
    attachments: dict[str, bytes]
    types: dict[str, Schema]
    messages: dict[str, list[Messages]]

    @property
    def sha256(self) -> str:
        """The hash of the whole file."""
        return hashlib.sha256(self.data).hexdigest()

    def bad(self, key: str, given: object, **expected: Any) -> GroundedError:
        """Return an error about an entry of the metadata; `expected` as of `checks.wrong`."""
        return wrong(f"{self.name}: metadata '{key}'", given, **expected)

    def entry(self, key: str) -> str:
        """Return an entry of the metadata, which must exist."""
        if key not in self.meta:
            raise unknown("metadata", key, self.meta, self.name)
        return self.meta[key]

    def number(self, key: str) -> float:
        """Return a positive finite number from the metadata."""
        if 0 < (value := self._parsed(key, float, must="positive")) < math.inf:
            return value
        raise self.bad(key, self.meta[key], must="positive")

    def integer(self, key: str, *, signed: bool = False) -> int:
        """Return an integer of 64 bits from the metadata, not negative unless `signed`."""
        low = -(2**63) if signed else 0
        if low <= (value := self._parsed(key, int, must="whole")) < 2**63:
            return value
        raise self.bad(key, self.meta[key], must="whole")

    def json(self, key: str, kind: type[list[Any] | dict[str, Any]]) -> Any:
        """Return a JSON list or object from the metadata."""
        value = self._parsed(key, json.loads, type=kind.__name__)
        if isinstance(value, kind) and len(value) <= NAME_LIMIT:
            return value
        raise self.bad(key, self.meta[key], type=kind.__name__)

    def _parsed(self, key: str, parse: Callable[[str], T], **expected: Any) -> T:
        text = self.entry(key)
        try:
            return parse(text)
        except (ValueError, RecursionError):
            raise self.bad(key, text, **expected) from None

    def names(self, key: str) -> list[str]:
        """Return the names of a JSON object of the metadata, in order."""
        table = self.json(key, dict)
        if {*map(type, table.values())} != {str}:
            raise self.bad(key, table, must="units")
        return list(table)

    def floats(self, value: Any, what: str, size: int, null: float | None = None) -> Array:
        """Return a JSON list of `size` numbers as an array; `null` replaces None."""
        kinds = {int, float, bool} if null is None else {int, float, bool, type(None)}
        if isinstance(value, list) and len(value) == size and {*map(type, value)} <= kinds:
            given = np.array(value, dtype=object)
            return np.where(given == None, np.nan if null is None else null, given).astype(float)  # noqa: E711
        raise self.bad(what, value, shape=f"({size},)")

    def doubles(self, topic: str, names: list[str]) -> Array:
        """Return the numbers of a topic's messages, (N, len(names))."""
        return np.column_stack(self._read(topic, dict.fromkeys(names, 1), listed=False))

    def lists(self, topic: str, sizes: Mapping[str, int]) -> list[Array]:
        """Return the lists of a topic's messages, (N, size) each; (0, size) if all are empty."""
        return self._read(topic, sizes, listed=True)

    def _read(self, topic: str, sizes: Mapping[str, int], *, listed: bool) -> list[Array]:
        """Return the numbers of some fields of a topic's messages, (N, size) each."""
        if topic not in self.types:
            raise unknown("channel", topic, self.types, self.name)
        where, batches = f"{self.name}: {topic}", self.messages.get(topic, [])
        try:
            doubles = numbers_in(self.types[topic])
        except BadSchema as error:
            raise unreadable(where, error) from None
        there = dict[str, int]()
        for name, (number, many) in doubles.items():
            if many is listed:
                there[name] = number
        for name in sizes:
            if name not in there:
                raise unknown("list" if listed else "number", name, there, where)
        if not batches:
            return [np.zeros((0, size)) for size in sizes.values()]
        tags = list[tuple[bytes, int]]()
        for name, size in sizes.items():
            tag = doubles_tag(there[name], size) if listed else double_tag(there[name])
            tags.append((tag, size))
        # of an open-loop policy only the first list is there
        for some in (tags, tags[:1]) if listed else (tags,):
            read = [uniform_doubles(b.buffer, b.starts, b.ends, some) for b in batches]
            if None not in read:
                found = [*map(np.concatenate, zip(*read, strict=True))]
                return found + [np.zeros((0, size)) for _, size in tags[len(some) :]]
        raise unreadable(where, "messages that grounded did not write")

    def check_grid(self, topic: str, start_ns: int, dt: float) -> None:
        """Raise an error if a topic's sample k is over half a step away from start_ns + k dt."""
        batches = self.messages.get(topic, [])
        stamps = np.concatenate([np.zeros(0, np.int64), *map(attrgetter("publish_times"), batches)])
        times = (stamps - start_ns) * 1e-9
        off = np.abs(times - dt * np.arange(len(times))) > 0.5 * dt
        if not off.any():
            return
        apart = float(np.median(np.diff(times, prepend=times[0] - dt)))
        for factor in (1e3, 1e-3):
            if abs(apart / (dt * factor) - 1) < 0.1:
                facts = {"unit": f"{1 / factor:g}", "every": apart, "dt": dt}
                raise refused("file.grid", f"{self.name}: {topic}", **facts)
        k = int(np.argmax(off))
        facts = {"sample": str(k), "at": times[k], "expected": k * dt, "dt": dt, "robot": 1}
        raise refused("file.grid", f"{self.name}: {topic}", **facts)


def format_of(path: Path) -> str:
    """Return the `format` stated in a file written by grounded, "" for any other file.

    Damage is ignored here; it is reported when the file is read.
    """
    try:
        with open_file(path) as stream:
            mcap = stream.read(len(MAGIC)) == MAGIC
            for record in read_records(mapped(stream), str(path), packed=False) if mcap else ():
                if isinstance(record, Metadata) and record.name == "grounded":
                    return record.data.get("format", "")
                if isinstance(record, Messages):
                    break
    except (OSError, GroundedError):
        pass
    return ""


def read_own(source: str | Path | bytes, name: str, kind: str) -> OwnFile:
    """Read and check a file of a kind, `TRIAL` or `CANDIDATE`: of a path, or bytes with a name."""
    if not isinstance(source, bytes):
        name, source = str(source), read_file(Path(source), FILE_LIMIT)
    meta: dict[str, str] | None = None
    attachments: dict[str, bytes] = {}
    topics: list[Topic] = []
    messages: dict[str, list[Messages]] = {}
    for record in by_topic(read_records(source, name, packed=False), name):
        if isinstance(record, Metadata) and record.name == "grounded":
            meta = record.data
        elif isinstance(record, Attachment):
            attachments[record.name] = record.data
        elif isinstance(record, Topic):
            topics.append(record)
        elif isinstance(record, Part) and isinstance(record.content, Messages):
            messages.setdefault(record.topic.name, []).append(record.content)
        elif isinstance(record, End) and not record.data_crc and meta is not None:
            raise DamagedFile(name, len(source), "record", "its end", "no checksum")
    if meta is None or meta.get("format") != kind:
        has = str(meta and meta.get("format"))
        raise unreadable(name, f"format {has}", kind=f"{kind} file")
    types = dict[str, Schema]()
    for topic in topics:
        types[topic.name] = _type(topic, name)
    return OwnFile(name, source, meta, attachments, types, messages)


def _type(topic: Topic, name: str) -> Schema:
    schema, encoding = topic.schema, topic.channel.encoding
    if encoding != "protobuf" or schema is None or schema.encoding != "protobuf":
        raise unreadable(f"{name}: {topic.name}", encoding)
    return schema


def stated(
    kind: str, dt: float, states: Units, inputs: Units, meta: Meta, **more: str
) -> dict[str, str]:
    """Return the metadata record of a file: what is always there, `more`, and `meta`."""
    for key in meta:
        if key in RESERVED:
            raise wrong("metadata", key, must="free")
    always = {"format": kind, "dt": repr(float(dt))}
    always |= {"states": json.dumps(dict(states)), "inputs": json.dumps(dict(inputs))}
    return always | more | {key: str(value) for key, value in meta.items()}


def with_units(names: tuple[str, ...], units: Units | None) -> dict[str, str]:
    """Return name -> unit for each name, "1" where the unit is not known."""
    return {name: (units or {}).get(name, "1") for name in names}
