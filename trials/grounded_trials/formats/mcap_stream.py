"""Writes an MCAP file without compression: records in order, the chunks' indices, the summary.

The layout is that of mcap.dev/spec, and every byte is what the mcap package writes, which isn't
needed for it: its import takes 30 ms and each message 5 us, as long as planning a whole flight.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from struct import Struct, pack
from typing import IO

from grounded_trials.formats.mcap_records import (
    ATTACHMENT,
    CHANNEL,
    CHUNK,
    DATA_END,
    FOOTER,
    HEADER,
    MESSAGE,
    MESSAGE_HEADER,
    MESSAGE_INDEX,
    METADATA,
    SCHEMA,
)
from grounded_trials.formats.mcap_walk import MAGIC

CHUNK_INDEX, ATTACHMENT_INDEX, STATISTICS, METADATA_INDEX, SUMMARY_OFFSET = 8, 10, 11, 13, 14
SUMMARY = (SCHEMA, CHANNEL, STATISTICS, CHUNK_INDEX, ATTACHMENT_INDEX, METADATA_INDEX)  # in order
CHUNK_SIZE = 2**20  # [bytes] after which a chunk ends

_MESSAGE = Struct("<BQHIQQ")  # opcode, length, channel, sequence, log and publish time
_ENTRY = Struct("<HQ")  # of a table from channels to numbers


def _record(opcode: int, content: bytes) -> bytes:
    return pack("<BQ", opcode, len(content)) + content


def _text(value: str) -> bytes:
    data = value.encode()
    return pack("<I", len(data)) + data


def _table(pairs: Mapping[str, str]) -> bytes:
    inside = b"".join(_text(key) + _text(value) for key, value in pairs.items())
    return pack("<I", len(inside)) + inside


def _numbers(pairs: Mapping[int, int]) -> bytes:
    inside = b"".join(_ENTRY.pack(*pair) for pair in pairs.items())
    return pack("<I", len(inside)) + inside


class McapStream:
    """A file being written; times are in nanoseconds.

    A chunk is written when it is full, at `flush` and at `finish`; everything else at once.
    """

    def __init__(self, stream: IO[bytes], profile: str, library: str) -> None:
        self._stream, self._offset, self._crc = stream, 0, 0
        self._summary: dict[int, list[bytes]] = {opcode: [] for opcode in SUMMARY}
        self._counts: dict[int, int] = {}  # messages of each channel, in finished chunks
        self._span: list[int] = []  # first and last time of each chunk
        self._parts: list[bytes] = []  # of the chunk
        self._size = 0
        self._index: dict[int, list[int]] = {}  # the chunk's: time, place, time, place ...
        self._write(MAGIC + _record(HEADER, _text(profile) + _text(library)))

    def _write(self, data: bytes) -> int:
        """Writes; returns where."""
        start = self._offset
        self._crc = zlib.crc32(data, self._crc)
        self._offset += len(data)
        self._stream.write(data)
        return start

    def metadata(self, name: str, table: Mapping[str, str]) -> None:
        """Adds a table of strings."""
        record = _record(METADATA, _text(name) + _table(table))
        place = pack("<QQ", self._write(record), len(record))
        self._summary[METADATA_INDEX].append(_record(METADATA_INDEX, place + _text(name)))

    def attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Adds a file, without a date."""
        names, undated = _text(name) + _text(media_type), pack("<QQ", 0, 0)
        content = undated + names + pack("<Q", len(data)) + data
        record = _record(ATTACHMENT, content + pack("<I", zlib.crc32(content)))
        place = pack("<QQ", self._write(record), len(record))
        index = place + undated + pack("<Q", len(data)) + names
        self._summary[ATTACHMENT_INDEX].append(_record(ATTACHMENT_INDEX, index))

    def schema(self, name: str, encoding: str, data: bytes) -> int:
        """Adds a schema; returns its id."""
        number = len(self._summary[SCHEMA]) + 1
        content = pack("<H", number) + _text(name) + _text(encoding) + pack("<I", len(data)) + data
        self._defined(SCHEMA, content)
        return number

    def channel(self, topic: str, encoding: str, schema: int) -> int:
        """Adds a channel; returns its id."""
        number = len(self._summary[CHANNEL]) + 1
        names = _text(topic) + _text(encoding) + _table({})
        self._defined(CHANNEL, pack("<HH", number, schema) + names)
        return number

    def _defined(self, opcode: int, content: bytes) -> None:
        record = _record(opcode, content)
        self._summary[opcode].append(record)
        self._put(record)

    def message(self, channel: int, time: int, data: bytes) -> None:
        """Adds a message that was sampled and logged at `time`; each channel's are numbered."""
        row = self._index.setdefault(channel, [])
        number, length = self._counts.get(channel, 0) + len(row) // 2, MESSAGE_HEADER + len(data)
        row += (time, self._size)
        self._put(_MESSAGE.pack(MESSAGE, length, channel, number, time, time) + data)

    def _put(self, record: bytes) -> None:
        self._parts.append(record)
        self._size += len(record)
        if self._size > CHUNK_SIZE:
            self._end_chunk()

    def _end_chunk(self) -> None:
        """Writes the chunk and its index; one without messages waits for them."""
        if not self._index:
            return
        data, index = b"".join(self._parts), self._index
        times = [time for row in index.values() for time in row[::2]]
        first, last, size = min(times), max(times), len(data)
        head = pack("<QQQI", first, last, size, zlib.crc32(data)) + _text("") + pack("<Q", size)
        start = self._write(_record(CHUNK, head + data))
        length, places = self._offset - start, dict[int, int]()
        for channel, row in index.items():
            pairs = pack(f"<HI{len(row)}Q", channel, 8 * len(row), *row)
            places[channel] = self._write(_record(MESSAGE_INDEX, pairs))
            self._counts[channel] = self._counts.get(channel, 0) + len(row) // 2
        found = pack("<QQQQ", first, last, start, length) + _numbers(places)
        found += pack("<Q", self._offset - start - length) + _text("") + pack("<QQ", size, size)
        self._summary[CHUNK_INDEX].append(_record(CHUNK_INDEX, found))
        self._span += [first, last]
        self._parts, self._size, self._index = [], 0, {}

    def flush(self) -> None:
        """Hands everything added so far to the operating system."""
        self._end_chunk()
        self._stream.flush()

    def finish(self) -> None:
        """Ends the file; the stream stays open."""
        self._end_chunk()
        self._write(_record(DATA_END, pack("<I", self._crc)))
        self._summary[STATISTICS] = [_record(STATISTICS, self._statistics())]
        start, groups = self._offset, b""
        offsets = list[bytes]()
        for opcode, records in self._summary.items():
            group = b"".join(records)
            place = pack("<BQQ", opcode, start + len(groups), len(group))
            offsets.append(_record(SUMMARY_OFFSET, place))
            groups += group
        places = pack("<QQ", start, start + len(groups))
        summary = groups + b"".join(offsets) + pack("<BQ", FOOTER, len(places) + 4) + places
        self._write(summary + pack("<I", zlib.crc32(summary)) + MAGIC)
        self._stream.flush()

    def _statistics(self) -> bytes:
        span, many = self._span or [0], self._summary
        counted = [len(many[c]) for c in (CHANNEL, ATTACHMENT_INDEX, METADATA_INDEX, CHUNK_INDEX)]
        messages = sum(self._counts.values())
        head = pack("<QHIIII", messages, len(many[SCHEMA]), *counted)
        return head + pack("<QQ", min(span), max(span)) + _numbers(self._counts)
