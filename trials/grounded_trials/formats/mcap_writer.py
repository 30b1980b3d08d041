"""Writing MCAP: records in chunks, with the index and the statistics that readers seek by.

Written by https://mcap.dev/spec, byte for byte as the mcap package does, which takes longer to
import and to write a candidate of 3000 steps than the search to find it. Our own files are not
compressed: a trial is small, its numbers compress badly, and so equal input gives equal bytes
whatever the version of a compressor.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import IO, Any

import numpy as np

from grounded.frozen import Array
from grounded_trials.formats import mcap_records as record
from grounded_trials.formats.mcap_records import (
    Attachment,
    Channel,
    Header,
    Messages,
    Metadata,
    Schema,
)
from grounded_trials.formats.protobuf import double_tag, doubles_tag, varint

LIBRARY = "grounded"
CHUNK_SIZE = 2**20  # [bytes]; a chunk ends with the message that exceeds it

CHUNK_INDEX, ATTACHMENT_INDEX, STATISTICS, METADATA_INDEX, SUMMARY_OFFSET = 8, 10, 11, 13, 14
_MESSAGE = struct.Struct("<BQHIQQ")  # type, length; channel, sequence, log time, publish time


class _Writer:
    """An MCAP file being written to a stream."""

    def __init__(self, stream: IO[bytes], header: Header, *, compressed: bool) -> None:
        self._stream, self._compressed = stream, compressed
        self._offset = self._crc = 0
        repeated = (record.SCHEMA, record.CHANNEL, STATISTICS, CHUNK_INDEX)
        self._summary: dict[int, list[bytes]] = {
            kind: [] for kind in (*repeated, ATTACHMENT_INDEX, METADATA_INDEX)
        }
        self._counts: dict[int, int] = {}  # messages by channel
        self._span = (2**64, 0)  # first and last log time [ns]
        self._begin_chunk()
        self._write(record.MAGIC)
        self._write(_record(record.HEADER, _text(header.profile), _text(header.library)))

    def metadata(self, table: Metadata) -> None:
        """Adds a table of strings."""
        name = _text(table.name)
        whole = _record(record.METADATA, name, _table(table.data))
        index = _numbers("QQ", self._offset, len(whole))
        self._summary[METADATA_INDEX].append(_record(METADATA_INDEX, index, name))
        self._write(whole)

    def attachment(self, file: Attachment) -> None:
        """Adds a file."""
        times = _numbers("QQ", file.log_time, file.create_time)
        size, texts = _numbers("Q", len(file.data)), _text(file.name) + _text(file.media_type)
        content = b"".join([times, texts, size, file.data])
        whole = _record(record.ATTACHMENT, content, _numbers("I", zlib.crc32(content)))
        index = _numbers("QQ", self._offset, len(whole))
        self._summary[ATTACHMENT_INDEX].append(_record(ATTACHMENT_INDEX, index, times, size, texts))
        self._write(whole)

    def finish(self) -> None:
        """Ends the file; the stream stays open."""
        self._end_chunk()
        self._write(_record(record.DATA_END, _numbers("I", self._crc)))
        self._summary[STATISTICS] = [self._statistics()]
        groups, offsets, start = list[bytes](), list[bytes](), self._offset
        for kind, records in self._summary.items():
            groups.append(b"".join(records))
            offsets.append(
                _record(SUMMARY_OFFSET, _numbers("BQQ", kind, self._offset, len(groups[-1])))
            )
            self._offset += len(groups[-1])
        summary = b"".join(groups + offsets)
        footer = _numbers("BQQQ", record.FOOTER, 20, start, self._offset)
        checksum = _numbers("I", zlib.crc32(footer, zlib.crc32(summary)))
        self._stream.write(b"".join([summary, footer, checksum, record.MAGIC]))
        self._stream.flush()

    def _write(self, data: bytes) -> None:
        self._stream.write(data)
        self._crc = zlib.crc32(data, self._crc)
        self._offset += len(data)

    def _define(self, kind: int, *content: bytes) -> None:
        """A schema or a channel: in the chunk, and again in the summary."""
        self._summary[kind].append(_record(kind, *content))
        self._parts.append(self._summary[kind][-1])
        self._size += len(self._parts[-1])

    def _schema(self, name: str, encoding: str, data: bytes) -> int:
        number, size = len(self._summary[record.SCHEMA]) + 1, _numbers("I", len(data))
        texts = _text(name), _text(encoding)
        self._define(record.SCHEMA, _numbers("H", number), *texts, size, data)
        return number

    def _channel(self, topic: str, encoding: str, schema: int, table: Mapping[str, str]) -> int:
        number = len(self._summary[record.CHANNEL]) + 1
        content = _text(topic), _text(encoding), _table(table)
        self._define(record.CHANNEL, _numbers("HH", number, schema), *content)
        return number

    def _message(
        self, channel: int, log_time: int, data: bytes, publish_time: int, sequence: int
    ) -> None:
        if channel not in self._index:
            self._index[channel] = []
        self._index[channel] += (log_time, self._size)
        length = record.MESSAGE_HEADER + len(data)
        self._parts += (
            _MESSAGE.pack(record.MESSAGE, length, channel, sequence, log_time, publish_time),
            data,
        )
        self._size += 9 + length
        if self._size > CHUNK_SIZE:
            self._end_chunk()

    def _begin_chunk(self) -> None:
        self._parts, self._size = list[bytes](), 0
        self._index: dict[int, list[int]] = {}  # channel -> log time and position, in turn

    def _end_chunk(self) -> None:
        """Writes the chunk, unless it has no message, and where each channel's messages lie."""
        if not self._index:
            return
        data = b"".join(self._parts)
        stored, name = (_zstd(data), _text("zstd")) if self._compressed else (data, _text(""))
        first = min(min(index[::2]) for index in self._index.values())
        last = max(max(index[::2]) for index in self._index.values())
        self._span = (min(first, self._span[0]), max(last, self._span[1]))
        sizes = _numbers("QQQI", first, last, len(data), zlib.crc32(data))
        at = self._offset
        self._write(_record(record.CHUNK, sizes, name, _numbers("Q", len(stored)), stored))
        start, places = self._offset, b""
        for channel, index in self._index.items():
            self._counts[channel] = self._counts.get(channel, 0) + len(index) // 2
            places += _numbers("HQ", channel, self._offset)
            head = _numbers("HI", channel, 8 * len(index))
            self._write(_record(record.MESSAGE_INDEX, head, _numbers(f"{len(index)}Q", *index)))
        about = _numbers("QQQQI", first, last, at, start - at, len(places))
        end = _numbers("QQ", len(stored), len(data))
        indexed = _numbers("Q", self._offset - start)
        self._summary[CHUNK_INDEX].append(_record(CHUNK_INDEX, about, places, indexed, name, end))
        self._begin_chunk()

    def _statistics(self) -> bytes:
        kinds = (record.CHANNEL, ATTACHMENT_INDEX, METADATA_INDEX, CHUNK_INDEX)
        sizes = (len(self._summary[kind]) for kind in kinds)
        messages, schemas = sum(self._counts.values()), len(self._summary[record.SCHEMA])
        span = self._span if messages else (0, 0)
        counts = b"".join(_numbers("HQ", *pair) for pair in self._counts.items())
        about = _numbers("QHIIIIQQI", messages, schemas, *sizes, *span, len(counts))
        return _record(STATISTICS, about, counts)


def _record(kind: int, *content: bytes) -> bytes:
    return b"".join([_numbers("BQ", kind, sum(map(len, content))), *content])


def _numbers(form: str, *values: int) -> bytes:
    return struct.pack("<" + form, *values)


def _text(value: str) -> bytes:
    data = value.encode()
    return _numbers("I", len(data)) + data


def _table(pairs: Mapping[str, str]) -> bytes:
    data = b"".join(_text(key) + _text(value) for key, value in pairs.items())
    return _numbers("I", len(data)) + data


def _zstd(data: bytes) -> bytes:
    import zstandard

    return zstandard.compress(data)


class LogWriter(_Writer):
    """Writes one file: metadata and attachments first, then messages, flushed in time."""

    def __init__(self, stream: IO[bytes]) -> None:
        super().__init__(stream, Header("", LIBRARY), compressed=False)
        self._sequences: dict[int, int] = {}

    def channel(
        self, topic: str, message: str, names: Sequence[str], *, repeated: bool = False
    ) -> int:
        """Opens a protobuf channel; its message has one double (or list of doubles) a name."""
        descriptor = file_descriptor_set(message, names, repeated=repeated)
        schema = self._schema(f"grounded.{message}", "protobuf", descriptor)
        return self._channel(topic, "protobuf", schema, {})

    def message(self, channel: int, time_ns: int, data: bytes) -> None:
        """Adds a message that was sampled, and logged, at `time_ns`."""
        sequence = self._sequences.get(channel, 0)
        self._sequences[channel] = sequence + 1
        self._message(channel, time_ns, data, time_ns, sequence)

    def flush(self) -> None:
        """Hands everything written so far to the operating system."""
        self._end_chunk()
        self._stream.flush()


class CopyWriter(_Writer):
    """Writes records as they were read; ids are given anew."""

    def __init__(self, stream: IO[bytes], header: Header, *, compressed: bool) -> None:
        super().__init__(stream, header, compressed=compressed)
        self._known: dict[Schema, int] = {}

    def channel(self, channel: Channel, schema: Schema | None) -> int:
        """Adds a channel with its schema; returns the id for its messages."""
        number = 0
        if schema is not None:
            if schema not in self._known:
                self._known[schema] = self._schema(schema.name, schema.encoding, schema.data)
            number = self._known[schema]
        return self._channel(channel.topic, channel.encoding, number, channel.metadata)

    def messages(self, batch: Messages, channel: int) -> None:
        """Adds the messages of a batch, all of one channel."""
        columns = (batch.starts, batch.ends, batch.log_times, batch.publish_times, batch.sequences)
        rows = zip(*(column.tolist() for column in columns), strict=True)
        for start, end, log_time, publish_time, sequence in rows:
            data = batch.buffer[start:end]
            self._message(channel, log_time, data, publish_time % 2**64, sequence)


def file_descriptor_set(message: str, names: Sequence[str], *, repeated: bool = False) -> bytes:
    """A serialised FileDescriptorSet of one proto3 message of doubles, numbered from 1.

    Written out here, by the numbers of google/protobuf/descriptor.proto: the protobuf package takes
    longer to import than to say this.
    """
    label, double = (3 if repeated else 1), 1  # LABEL_REPEATED, LABEL_OPTIONAL; TYPE_DOUBLE
    fields = [
        _bytes(1, name.encode()) + _integer(3, number) + _integer(4, label) + _integer(5, double)
        for number, name in enumerate(names, start=1)
    ]
    definition = _bytes(1, message.encode()) + b"".join(_bytes(2, field) for field in fields)
    name = f"grounded/{message}.proto".encode()
    file = _bytes(1, name) + _bytes(2, b"grounded") + _bytes(4, definition) + _bytes(12, b"proto3")
    return _bytes(1, file)


class DoublesEncoder:
    """Protobuf messages of `count` doubles, numbered from 1.

    Zeros are written too, so that every message has the same length and -0.0 survives.
    """

    def __init__(self, count: int) -> None:
        tags = [double_tag(number) for number in range(1, count + 1)]
        self._form = struct.Struct("<" + "".join(f"{len(tag)}sd" for tag in tags))
        self._parts: list[bytes | float] = [0.0] * (2 * count)
        self._parts[::2] = tags

    def __call__(self, values: Array) -> bytes:
        """The message of these values (count,)."""
        self._parts[1::2] = values.tolist()
        return self._form.pack(*self._parts)


def encode_doubles(values: Array) -> list[bytes]:
    """The messages of `DoublesEncoder` for many rows, (N, count)."""
    tags = [double_tag(number) for number in range(1, values.shape[1] + 1)]
    return _encoded(list(zip(tags, values.T[:, :, None], strict=True)), len(values))


def encode_lists(lists: Sequence[Array]) -> list[bytes]:
    """Messages of packed repeated doubles, numbered from 1; an empty list is absent.

    Each list has a row for each message, (N, count).
    """
    fields = [
        (doubles_tag(number, values.shape[1]), values)
        for number, values in enumerate(lists, start=1)
        if values.shape[1]
    ]
    return _encoded(fields, len(lists[0]))


def _encoded(fields: Sequence[tuple[bytes, Array]], count: int) -> list[bytes]:
    """Rows of fields, each the same prefix and then the row's doubles (N, ...)."""
    parts = list[np.ndarray[Any, np.dtype[np.uint8]]]()
    for prefix, values in fields:
        data = np.ascontiguousarray(values, dtype="<f8").view(np.uint8)
        parts += [np.tile(np.frombuffer(prefix, np.uint8), (count, 1)), data]
    return [row.tobytes() for row in np.hstack(parts)]


def _bytes(number: int, data: bytes) -> bytes:
    return varint(number << 3 | 2) + varint(len(data)) + data


def _integer(number: int, value: int) -> bytes:
    return varint(number << 3) + varint(value)
