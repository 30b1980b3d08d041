"""Reading a file that we wrote: all of it, checked, or a message that says what is wrong.

The whole file is read before any number leaves: a data checksum must be there and must fit, so
that no flipped bit goes unnoticed. Limits keep a file from a stranger from taking all memory.

What writing a trial and writing a candidate have in common.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from grounded.errors import GroundedError
from grounded.frozen import Array
from grounded_trials.formats.mcap_records import (
    Attachment,
    Channel,
    End,
    Messages,
    Metadata,
    Schema,
)
from grounded_trials.formats.mcap_walk import DamagedFile, read_records
from grounded_trials.formats.messages import Array as ArrayType
from grounded_trials.formats.messages import BadMessage, BadSchema, Ints, Number, Struct
from grounded_trials.formats.protobuf import protobuf_messages, uniform_doubles
from grounded_trials.formats.schemas import struct_of
from grounded_trials.store.store import write_atomically

FILE_LIMIT = 1 * 2**30  # [bytes]
STEP_LIMIT = 2_000_000  # messages of a channel
NAME_LIMIT = 1000  # states, or inputs

TRIAL, CANDIDATE = "grounded trial 1", "grounded candidate 1"
RESERVED = (
    "format",
    "dt",
    "states",
    "inputs",
    "candidate",
    "start_inputs",
    "start_ns",
    "policy",
    "steps",
)

Meta = Mapping[str, str]
Units = Mapping[str, str]
Target = str | Path | IO[bytes]


@dataclass(frozen=True, eq=False)
class OwnFile:
    """What a file of ours holds: messages by topic, the table `grounded`, attached files."""

    name: str
    data: bytes
    meta: dict[str, str]
    attachments: dict[str, bytes]
    types: dict[str, Struct]
    messages: dict[str, list[Messages]]

    def entry(self, key: str) -> str:
        """An entry of the table, which must be there."""
        if key not in self.meta:
            raise GroundedError(f"{self.name}: its metadata has no '{key}'")
        return self.meta[key]

    def number(self, key: str) -> float:
        """A positive finite number from the table."""
        text = self.entry(key)
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and value > 0):
            raise GroundedError(
                f"{self.name}: its metadata '{key}' is '{text[:40]}', not a positive number"
            )
        return value

    def json(self, key: str, kind: type, *, optional: bool = False) -> Any:
        """A JSON entry of the table; None for null where `optional`."""
        try:
            value = json.loads(self.entry(key))
        except (ValueError, RecursionError):
            raise GroundedError(f"{self.name}: its metadata '{key}' is not JSON") from None
        if value is None and optional:
            return None
        if (
            not isinstance(value, dict | list)
            or not isinstance(value, kind)
            or len(value) > NAME_LIMIT
        ):
            raise GroundedError(f"{self.name}: its metadata '{key}' is not a {kind.__name__}")
        return value

    def floats(self, value: Any, what: str, size: int, null: float | None = None) -> Array:
        """A list of `size` numbers from JSON; `null` stands for None."""
        if isinstance(value, list) and len(value) == size:
            numbers = [null if item is None else item for item in value]
            if all(isinstance(item, int | float) for item in numbers):
                return np.array(numbers, dtype=np.float64)
        raise GroundedError(f"{self.name}: its metadata '{what}' must be a list of {size} numbers")

    def doubles(self, topic: str, names: list[str]) -> Array:
        """The numbers of a topic's messages, (N, len(names))."""
        type, batches = self._topic(topic)
        for name in names:
            field = type.by_name.get(name)
            if field is None or not isinstance(field.type, Number):
                raise GroundedError(f"{self.name}: {topic} has no number '{name}'")
        numbers = [type.by_name[name].number for name in names]
        blocks = [self._doubles(type, names, numbers, batch) for batch in batches]
        return np.concatenate(blocks) if blocks else np.zeros((0, len(names)))

    def times(self, topic: str) -> Ints:
        """When a topic's messages were sampled (N,) [ns]."""
        _, batches = self._topic(topic)
        return np.concatenate([b.publish_times for b in batches] or [np.zeros(0, np.int64)])

    def integer(self, key: str) -> int:
        """An integer of the table that is not negative."""
        text = self.entry(key)
        if not (text.isascii() and text.isdigit() and len(text) < 20):
            raise GroundedError(
                f"{self.name}: its metadata '{key}' is '{text[:40]}', not an integer"
            )
        return int(text)

    def _doubles(
        self, type: Struct, names: list[str], numbers: list[int], batch: Messages
    ) -> Array:
        fast = uniform_doubles(batch.buffer, batch.starts, batch.ends, numbers)
        if fast is not None:
            return fast
        try:
            root = protobuf_messages(batch.buffer, type, batch.starts, batch.ends)
            return np.column_stack([root.field(name).numbers() for name in names])
        except BadMessage as error:
            raise DamagedFile(self.name, 0, f"message {error.message}: {error}") from None

    @property
    def sha256(self) -> str:
        """The hash of the whole file."""
        return hashlib.sha256(self.data).hexdigest()

    def names(self, key: str) -> list[str]:
        """The names of a JSON object of the table, in order."""
        table = self.json(key, dict)
        if not table or not all(isinstance(unit, str) for unit in table.values()):
            raise GroundedError(f"{self.name}: its metadata '{key}' must give each name a unit")
        return list(table)

    def lists(self, topic: str, sizes: dict[str, int]) -> list[Array]:
        """Lists of a topic's messages, (N, size) each; (0, size) where no message has any."""
        type, batches = self._topic(topic)
        found: dict[str, list[Array]] = {name: [] for name in sizes}
        count = sum(len(batch) for batch in batches)
        for batch in batches:
            for name in sizes:
                field = type.by_name.get(name)
                if field is None or field.type != ArrayType(Number("f8")):
                    raise GroundedError(f"{self.name}: {topic} has no list '{name}' of doubles")
                try:
                    root = protobuf_messages(batch.buffer, type, batch.starts, batch.ends)
                    items = root.field(name).items(0, -1)
                    found[name].append(self._list(topic, name, sizes[name], items, len(batch)))
                except BadMessage as error:
                    raise DamagedFile(self.name, 0, f"message {error.message}: {error}") from None
        lists = []
        for name, size in sizes.items():
            values = np.concatenate(found[name] or [np.zeros((0, size))])
            if len(values) not in (0, count):
                raise GroundedError(f"{self.name}: only some messages of {topic} have a '{name}'")
            lists.append(values)
        return lists

    def _list(self, topic: str, name: str, size: int, items: Any, count: int) -> Array:
        lengths = np.bincount(items.rows, minlength=count)
        if not lengths.any():
            return np.zeros((0, size))
        if (lengths != size).any():
            k = int(np.argmax(lengths != size))
            raise GroundedError(
                f"{self.name}: {topic} message {k} has {lengths[k]} numbers in '{name}', not {size}"
            )
        values: Array = items.numbers().reshape(count, size)
        return values

    def _topic(self, topic: str) -> tuple[Struct, list[Messages]]:
        if topic not in self.types:
            raise GroundedError(f"{self.name}: it has no channel {topic}")
        return self.types[topic], self.messages.get(topic, [])

    def check_grid(self, topic: str, start_ns: int, dt: float) -> None:
        """Refuses a topic whose samples do not lie within half a step of start + k dt."""
        times = (self.times(topic) - start_ns) * 1e-9
        off = np.abs(times - dt * np.arange(len(times))) > 0.5 * dt
        if off.any():
            k = int(np.argmax(off))
            raise GroundedError(
                f"{self.name}: {topic} sample {k} is stamped {times[k]:.4f} s, its place on the "
                f"grid of {dt} s is {k * dt:.4f} s: samples are missing, or came late. A trial "
                "needs one at every step: run it again"
            )


def read_own(source: str | Path | bytes, name: str, kind: str) -> OwnFile:
    """Reads and checks a file of ours.

    Args:
        source: its path, or its bytes.
        name: of the file in messages, when `source` is bytes.
        kind: the format that it must state.

    Raises:
        GroundedError: if it can't be read, is damaged, or is something else.
    """
    if not isinstance(source, bytes):
        name, source = str(source), read_file(Path(source), FILE_LIMIT)
    meta: dict[str, str] | None = None
    attachments: dict[str, bytes] = {}
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    messages: dict[str, list[Messages]] = {}
    for record in read_records(io.BytesIO(source), name, limit=FILE_LIMIT):
        if isinstance(record, Metadata) and record.name == "grounded":
            meta = record.data
        elif isinstance(record, Attachment):
            attachments[record.name] = record.data
        elif isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Messages):
            _sort(record, channels, messages, name)
        elif isinstance(record, End) and not record.data_crc and meta is not None:
            raise DamagedFile(name, len(source), "its checksum is missing")
    if meta is None or meta.get("format") != kind:
        stated = f"its format is '{meta.get('format', '')}'" if meta else "it has no such metadata"
        raise GroundedError(f"{name} is not a '{kind}' file: {stated}")
    types = {c.topic: _type(c, schemas, name) for c in channels.values()}
    return OwnFile(name, source, meta, attachments, types, messages)


def read_file(path: Path, limit: int) -> bytes:
    """The bytes of a file.

    Raises:
        GroundedError: if it is missing, unreadable, or larger than `limit` bytes.
    """
    try:
        with path.open("rb") as stream:
            data = stream.read(limit + 1)
    except FileNotFoundError:
        raise GroundedError(f"{path} does not exist") from None
    except OSError as error:
        raise GroundedError(f"{path} can't be read: {error.strerror}") from None
    if len(data) > limit:
        raise GroundedError(f"{path} is larger than {limit} bytes: grounded writes no such file")
    return data


def _sort(
    batch: Messages, channels: dict[int, Channel], messages: dict[str, list[Messages]], name: str
) -> None:
    for identity in batch.channel_ids():
        if identity not in channels:
            raise DamagedFile(
                name, 0, f"a message belongs to channel {identity}, which is not defined"
            )
        own = messages.setdefault(channels[identity].topic, [])
        own.append(batch.of(identity))
        if sum(len(part) for part in own) > STEP_LIMIT:
            raise GroundedError(f"{name}: more than {STEP_LIMIT} messages on one channel")


def _type(channel: Channel, schemas: dict[int, Schema], name: str) -> Struct:
    schema = schemas.get(channel.schema_id)
    if channel.encoding != "protobuf" or schema is None or schema.encoding != "protobuf":
        raise GroundedError(f"{name}: {channel.topic} is not protobuf")
    try:
        return struct_of(schema)
    except BadSchema as error:
        raise GroundedError(f"{name}: {channel.topic}: {error}") from None


def with_meta(table: dict[str, str], meta: Meta) -> dict[str, str]:
    """The table with the entries of `meta`; a reserved one is refused."""
    for key, value in meta.items():
        if key in RESERVED:
            raise GroundedError(f"metadata '{key}' is written by grounded itself; use another name")
        table[key] = str(value)
    return table


def with_units(names: tuple[str, ...], units: Units | None) -> dict[str, str]:
    """Name -> unit for each name, "1" where none is known."""
    return {name: (units or {}).get(name, "1") for name in names}


def rows(values: Array, count: int, size: int) -> Array:
    """The values as doubles of shape (count, size), or a GroundedError."""
    array = np.asarray(values, dtype=np.float64)
    if array.shape != (count, size):
        raise GroundedError(f"expected an array of shape {(count, size)}, got {array.shape}")
    return array


def deliver(target: Target, data: bytes) -> None:
    """Writes the bytes to a stream, or to a path at once."""
    if isinstance(target, str | Path):
        write_atomically(Path(target), data)
    else:
        target.write(data)
