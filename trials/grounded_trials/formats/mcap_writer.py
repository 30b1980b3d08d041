"""Write MCAP: chunks of messages with checksums and indexes, tables of strings, attachments.

The bytes are those that the mcap package writes, which takes seven times as long and 30 ms for its
import: a quarter of `propose` for an aircraft, whose candidate has 9,001 messages. Files of ours
are not compressed: they are small, their numbers compress badly, and without compression equal
input gives equal bytes whatever the version of the compressor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain
from struct import Struct, pack
from typing import IO
from zlib import crc32

from grounded_trials.formats.mcap_records import MAGIC, MESSAGE_HEADER, Header, Messages, Op
from grounded_trials.formats.protobuf import file_descriptor_set

LIBRARY = "grounded"
CHUNK_SIZE = 1024 * 1024  # [bytes] after which a chunk ends
_MESSAGE = Struct("<BQHIQQ")  # opcode, size, channel, sequence, log and publish time


class McapWriter:
    """An MCAP file being written to a stream.

    Args:
        stream: takes the bytes; it stays open.
        header: the profile of the file and the library that writes it.
        compressed: whether chunks are compressed by zstd.
    """

    def __init__(
        self, stream: IO[bytes], header: Header | None = None, *, compressed: bool = False
    ) -> None:
        header = header or Header("", LIBRARY)
        self.stream, self.compressed = stream, compressed
        self.at, self.crc = 0, 0  # bytes written, and their checksum
        self.schemas: dict[tuple[str, str, bytes], bytes] = {}  # their records
        self.channels: list[bytes] = []
        self.counts: dict[int, int] = {}  # messages by channel
        self.times: list[int] = []  # first and last of each chunk [ns]
        kinds = (Op.CHUNK_INDEX, Op.ATTACHMENT_INDEX, Op.METADATA_INDEX)
        self.indices: dict[int, list[bytes]] = {kind: [] for kind in kinds}
        self._new_chunk()
        self._put(MAGIC)
        self._put(_record(Op.HEADER, _text(header.profile), _text(header.library)))

    def metadata(self, name: str, table: Mapping[str, str]) -> None:
        """Add a table of strings."""
        record = _record(Op.METADATA, _text(name), _map(table))
        index = _record(Op.METADATA_INDEX, pack("<QQ", self.at, len(record)), _text(name))
        self.indices[Op.METADATA_INDEX].append(index)
        self._put(record)

    def attachment(
        self, name: str, media_type: str, data: bytes, log_time: int = 0, create_time: int = 0
    ) -> None:
        """Add a named file; for the times [ns] see `mcap_records.Attachment`."""
        times, called = pack("<QQ", log_time, create_time), _text(name) + _text(media_type)
        content = times + called + pack("<Q", len(data)) + data
        record = _record(Op.ATTACHMENT, content, pack("<I", crc32(content)))
        place = pack("<QQ", self.at, len(record)) + times + pack("<Q", len(data))
        self.indices[Op.ATTACHMENT_INDEX].append(_record(Op.ATTACHMENT_INDEX, place, called))
        self._put(record)

    def schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add the definition of a message type, once; return its id."""
        key = name, encoding, data
        if key not in self.schemas:
            number, length = len(self.schemas) + 1, pack("<I", len(data))
            head = pack("<H", number) + _text(name) + _text(encoding)
            self.schemas[key] = _record(Op.SCHEMA, head, length, data)
            self._add(self.schemas[key])
        return list(self.schemas).index(key) + 1

    def channel(
        self, topic: str, encoding: str, schema: int, metadata: Mapping[str, str] | None = None
    ) -> int:
        """Open a channel whose messages have the schema of an id, 0 for none; return its id."""
        number = len(self.channels) + 1
        head = pack("<HH", number, schema)
        record = _record(Op.CHANNEL, head, _text(topic), _text(encoding), _map(metadata or {}))
        self.channels.append(record)
        self._add(record)
        return number

    def doubles(
        self, topic: str, message: str, names: Sequence[str], *, repeated: bool = False
    ) -> int:
        """Open a protobuf channel whose message has one double (or list of doubles) per name."""
        definition = file_descriptor_set(message, names, repeated=repeated)
        schema = self.schema(f"grounded.{message}", "protobuf", definition)
        return self.channel(topic, "protobuf", schema)

    def message(
        self,
        channel: int,
        log_time: int,
        data: bytes,
        publish_time: int | None = None,
        sequence: int | None = None,
    ) -> None:
        """Add a message; without a time of publication or a number it has the usual ones [ns]."""
        count = self.counts.get(channel, 0)
        self.counts[channel] = count + 1
        self.entries.setdefault(channel, []).extend((log_time, self.size))
        number = count if sequence is None else sequence
        published = log_time if publish_time is None else publish_time
        size = MESSAGE_HEADER + len(data)
        self._add(_MESSAGE.pack(Op.MESSAGE, size, channel, number, log_time, published), data)
        if self.size > CHUNK_SIZE:
            self._end_chunk()

    def messages(self, batch: Messages, channel: int) -> None:
        """Add the messages of a batch, all of one channel, as they were read."""
        columns = (batch.starts, batch.ends, batch.log_times, batch.publish_times, batch.sequences)
        for start, end, logged, published, number in zip(
            *(column.tolist() for column in columns), strict=True
        ):
            data = batch.buffer[start:end]
            self.message(channel, logged, data, published % 2**64, number)

    def flush(self) -> None:
        """Pass everything written so far to the operating system."""
        self._end_chunk()
        self.stream.flush()

    def finish(self) -> None:
        """End the file; the stream stays open."""
        self._end_chunk()
        self._put(_record(Op.DATA_END, pack("<I", self.crc)))

        # The summary repeats schemas and channels, and says where everything is.
        kinds = Op.ATTACHMENT_INDEX, Op.METADATA_INDEX, Op.CHUNK_INDEX
        tables = (len(self.indices[kind]) for kind in kinds)
        statistics = _record(
            Op.STATISTICS,
            pack("<QHI", sum(self.counts.values()), len(self.schemas), len(self.channels)),
            pack("<III", *tables),
            pack("<QQ", min(self.times, default=0), max(self.times, default=0)),
            pack("<I", 10 * len(self.counts)),
            *(pack("<HQ", *one) for one in self.counts.items()),
        )
        groups = {
            Op.SCHEMA: [*self.schemas.values()],
            Op.CHANNEL: self.channels,
            Op.STATISTICS: [statistics],
            **self.indices,
        }
        begin, offsets = self.at, list[bytes]()
        start = begin
        for opcode, records in groups.items():
            length = sum(map(len, records))
            offsets.append(_record(Op.SUMMARY_OFFSET, pack("<BQQ", opcode, start, length)))
            start += length
        summary = b"".join([*chain(*groups.values()), *offsets])
        summary += pack("<BQQQ", Op.FOOTER, 20, begin, start)
        self._put(summary + pack("<I", crc32(summary)) + MAGIC)
        self.stream.flush()

    def _put(self, data: bytes) -> None:
        self.stream.write(data)
        self.at, self.crc = self.at + len(data), crc32(data, self.crc)

    def _add(self, *parts: bytes) -> None:
        """Add records to the chunk."""
        self.chunk += parts
        self.size += sum(map(len, parts))

    def _new_chunk(self) -> None:
        self.chunk, self.size = list[bytes](), 0
        self.entries: dict[int, list[int]] = {}  # times and positions of its messages by channel

    def _end_chunk(self) -> None:
        """Write the chunk and its indexes, if it has messages."""
        if not self.entries:
            return
        packed = data = b"".join(self.chunk)
        kind = "zstd" * self.compressed
        if kind:
            import zstandard

            packed = zstandard.compress(data)
        stamps = [e[::2] for e in self.entries.values()]
        times = min(map(min, stamps)), max(map(max, stamps))
        self.times += times
        span, sizes, start = pack("<QQ", *times), pack("<QQ", len(packed), len(data)), self.at
        head = pack("<QI", len(data), crc32(data)) + _text(kind) + pack("<Q", len(packed))
        self._put(_record(Op.CHUNK, span, head, packed))
        ended, places = self.at, b""
        for channel, entries in self.entries.items():
            places += pack("<HQ", channel, self.at)
            index = pack(f"<HI{len(entries)}Q", channel, 8 * len(entries), *entries)
            self._put(_record(Op.MESSAGE_INDEX, index))
        place = pack("<QQI", start, ended - start, len(places)) + places
        where = place + pack("<Q", self.at - ended)
        self.indices[Op.CHUNK_INDEX].append(
            _record(Op.CHUNK_INDEX, span, where, _text(kind), sizes)
        )
        self._new_chunk()


def _record(opcode: int, *parts: bytes) -> bytes:
    return b"".join([pack("<BQ", opcode, sum(map(len, parts))), *parts])


def _text(text: str) -> bytes:
    data = text.encode()
    return pack("<I", len(data)) + data


def _map(table: Mapping[str, str]) -> bytes:
    data = b"".join(_text(key) + _text(value) for key, value in table.items())
    return pack("<I", len(data)) + data
