"""Write a whole MCAP file at once, byte for byte as the mcap package does message by message.

Used for candidates: that of an aircraft has 9,001 messages, which take the package 0.1 s of CPU, a
quarter of `propose`, plus 0.03 s for its import. Here columns become records in NumPy. Files
written while they are sampled, which must survive a flat battery, use the package (`mcap_writer`).
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from zlib import crc32

import numpy as np

from grounded_trials.formats.mcap_walk import MAGIC
from grounded_trials.formats.mcap_writer import LIBRARY, Rows, file_descriptor_set

CHUNK = 1024 * 1024  # [bytes] after which a chunk ends
MESSAGE = np.dtype(  # the part of a record before the message's data
    {
        "names": ["op", "size", "channel", "sequence", "logged", "published"],
        "formats": ["u1", "<u8", "<u2", "<u4", "<u8", "<u8"],
    }
)
HEAD = MESSAGE.itemsize


@dataclass(frozen=True, eq=False)
class Column:
    """Messages of one channel.

    Args:
        topic: of the channel.
        message: the name of its type, which has one double (or list of doubles) per field.
        fields: names of the fields.
        rows: the encoded messages (N, bytes).
        times: of each message, increasing [ns].
        repeated: whether the fields are lists.
    """

    topic: str
    message: str
    fields: Sequence[str]
    rows: Rows
    times: np.ndarray[Any, np.dtype[np.int64]]
    repeated: bool = False

    def records(self, channel: int) -> Rows:
        """Return the message records (N, HEAD + bytes)."""
        count, size = self.rows.shape
        head = np.zeros(count, MESSAGE)
        head["op"], head["size"], head["channel"] = 0x05, HEAD - 9 + size, channel
        head["sequence"], head["logged"] = np.arange(count), self.times
        head["published"] = self.times
        return np.hstack([head.view(np.uint8).reshape(count, HEAD), self.rows])


def whole_file(
    table: Mapping[str, str], about: bytes, columns: Sequence[Column], written: Sequence[int]
) -> bytes:
    """Return the bytes of a file with a table `grounded`, a text `about`, and messages by time.

    Args:
        table: of strings.
        about: content of the attachment, text/plain.
        columns: in the order of their channel numbers, from 1.
        written: rank of each column where times are equal.
    """
    header = _record(0x01, _text(""), _text(LIBRARY))
    metadata = _record(0x0C, _text("grounded"), _map(table))
    body = [bytes(16), _text("about"), _text("text/plain"), _long(len(about)), about]
    attachment = _record(0x09, *body, struct.pack("<I", crc32(b"".join(body))))
    parts = [MAGIC, header, metadata, attachment]
    at = np.cumsum([len(part) for part in parts]).tolist()

    schemas, channels = [], []
    for number, one in enumerate(columns, start=1):
        descriptor = file_descriptor_set(one.message, one.fields, repeated=one.repeated)
        data = struct.pack("<I", len(descriptor)) + descriptor
        name = _text(f"grounded.{one.message}")
        schemas.append(_record(0x03, struct.pack("<H", number), name, _text("protobuf"), data))
        both = struct.pack("<HH", number, number)
        channels.append(_record(0x04, both, _text(one.topic), _text("protobuf"), _map({})))
    before = b"".join(a + b for a, b in zip(schemas, channels, strict=True))
    chunks = _chunked(columns, written, before)
    offset, indices = at[-1], []
    for chunk in chunks:
        records, index = chunk.at(offset)
        parts += records
        indices.append(index)
        offset += sum(map(len, records))

    checked = 0
    for part in parts:
        checked = crc32(part, checked)
    end = _record(0x0F, struct.pack("<I", checked))
    counts = [len(one.rows) for one in columns]
    order = [k + 1 for k in sorted(range(len(columns)), key=written.index) if counts[k]]
    times = np.concatenate([one.times for one in columns])
    statistics = _record(
        0x0B,
        struct.pack("<QHIIII", sum(counts), len(columns), len(columns), 1, 1, len(chunks)),
        struct.pack("<QQI", int(times.min()), int(times.max()), 10 * len(order)),
        *(struct.pack("<HQ", number, counts[number - 1]) for number in order),
    )
    about_index = _record(
        0x0A,
        struct.pack("<QQQQQ", at[2], len(attachment), 0, 0, len(about)),
        _text("about"),
        _text("text/plain"),
    )
    table_index = _record(0x0D, struct.pack("<QQ", at[1], len(metadata)), _text("grounded"))
    groups = [
        (0x03, b"".join(schemas)),
        (0x04, b"".join(channels)),
        (0x0B, statistics),
        (0x08, b"".join(indices)),
        (0x0A, about_index),
        (0x0D, table_index),
    ]
    start = offset + len(end)
    starts = np.cumsum([start, *(len(group) for _, group in groups)]).tolist()
    offsets = [
        _record(0x0E, struct.pack("<BQQ", code, begin, len(group)))
        for (code, group), begin in zip(groups, starts, strict=False)
    ]
    summary = b"".join([*(group for _, group in groups), *offsets])
    footer = struct.pack("<BQQQ", 0x02, 20, start, starts[-1])
    crc = struct.pack("<I", crc32(summary + footer))
    return b"".join([*parts, end, summary, footer, crc, MAGIC])


@dataclass(frozen=True)
class _Chunk:
    """Records of some messages, with an index by channel."""

    data: bytes
    first: int  # [ns]
    last: int  # [ns]
    entries: Mapping[int, bytes]  # by channel: times and positions in the data

    def at(self, offset: int) -> tuple[list[bytes], bytes]:
        """Return the chunk and its message indexes in pieces, and the chunk's index record."""
        size, span = len(self.data), struct.pack("<QQ", self.first, self.last)
        head = span + struct.pack("<QI", size, crc32(self.data)) + _text("") + _long(size)
        head, places = _head(0x06, len(head) + size) + head, b""
        length, indexes = len(head) + size, b""
        for channel, entries in self.entries.items():
            places += struct.pack("<HQ", channel, offset + length + len(indexes))
            indexes += _record(0x07, struct.pack("<HI", channel, len(entries)), entries)
        index = _record(
            0x08,
            span,
            struct.pack("<QQI", offset, length, len(places)),
            places,
            _long(len(indexes)),
            _text(""),
            struct.pack("<QQ", size, size),
        )
        return [head, self.data, indexes], index


def _chunked(columns: Sequence[Column], written: Sequence[int], before: bytes) -> list[_Chunk]:
    """Split messages, sorted by time, into chunks; the records `before` go into the first one."""
    number = np.repeat(np.arange(len(columns)), [len(one.rows) for one in columns])
    times = np.concatenate([one.times for one in columns])
    order = np.lexsort((np.argsort(written)[number], times))
    number, times = number[order], times[order]
    width = np.array([HEAD + one.rows.shape[1] for one in columns])
    ends = np.cumsum(width[number])
    left = [iter(_cut(one.records(k), width[k - 1])) for k, one in enumerate(columns, start=1)]
    found, begin = list[_Chunk](), 0
    while begin < len(times):
        gone = int(ends[begin - 1]) if begin else -len(before)
        stop = 1 + int(np.searchsorted(ends[:-1], gone + CHUNK, side="right"))
        own, at = number[begin:stop], times[begin:stop]
        places = ends[begin:stop] - width[own] - gone
        entries = {
            k + 1: np.stack([at[own == k], places[own == k]], axis=1).astype("<u8").tobytes()
            for k in dict.fromkeys(own.tolist())
        }
        data = b"".join([before * (begin == 0), *map(next, map(left.__getitem__, own.tolist()))])
        found.append(_Chunk(data, int(at[0]), int(at[-1]), entries))
        begin = stop
    return found


def _cut(records: Rows, width: int) -> list[bytes]:
    data = records.tobytes()
    return [data[at : at + width] for at in range(0, len(data), width)]


def _record(opcode: int, *parts: bytes) -> bytes:
    return b"".join([_head(opcode, sum(map(len, parts))), *parts])


def _head(opcode: int, length: int) -> bytes:
    return struct.pack("<BQ", opcode, length)


def _text(text: str) -> bytes:
    data = text.encode()
    return struct.pack("<I", len(data)) + data


def _long(number: int) -> bytes:
    return struct.pack("<Q", number)


def _map(table: Mapping[str, str]) -> bytes:
    data = b"".join(_text(key) + _text(value) for key, value in table.items())
    return struct.pack("<I", len(data)) + data
