"""MCAP's records: what each holds, and how its bytes are read.

Integers are little-endian; a text is u32 length and UTF-8; a table is u32 length and pairs of
texts. Messages come in batches: one buffer and the positions of the messages in it, so that a
million of them can be decoded by array operations.

The compressions a chunk may have: none, lz4, zstd; decompressed to its stated size, never more.

The libraries are imported when the first chunk needs them.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from struct import Struct

import numpy as np
from numpy.typing import NDArray

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK = 1, 2, 3, 4, 5, 6
MESSAGE_INDEX, ATTACHMENT, METADATA, DATA_END = 7, 9, 12, 15
MESSAGE_HEADER = 22  # channel u16, sequence u32, log time u64, publish time u64

_U16, _U32, _U64 = Struct("<H"), Struct("<I"), Struct("<Q")


@dataclass(frozen=True)
class Header:
    """The first record: who wrote the file, by which conventions."""

    profile: str
    library: str


@dataclass(frozen=True)
class Schema:
    """The definition of a message type, in the language `encoding` (ros2msg, protobuf, ...)."""

    id: int
    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True)
class Channel:
    """A topic, and how its messages are encoded (cdr, protobuf, json, ...)."""

    id: int
    topic: str
    encoding: str
    schema_id: int
    metadata: dict[str, str]


@dataclass(frozen=True, eq=False)
class Messages:
    """A batch of N messages: message i is buffer[starts[i]:ends[i]], in file order."""

    buffer: bytes
    starts: NDArray[np.int64]
    ends: NDArray[np.int64]
    channels: NDArray[np.uint16]
    sequences: NDArray[np.uint32]
    log_times: NDArray[np.int64]  # [ns]
    publish_times: NDArray[np.int64]  # [ns]

    def __len__(self) -> int:
        return len(self.starts)

    def take(self, chosen: NDArray[np.bool_]) -> Messages:
        """The messages where `chosen` (N,) is true."""
        return Messages(
            self.buffer,
            self.starts[chosen],
            self.ends[chosen],
            self.channels[chosen],
            self.sequences[chosen],
            self.log_times[chosen],
            self.publish_times[chosen],
        )


@dataclass(frozen=True)
class Attachment:
    """A named file inside the file."""

    name: str
    media_type: str
    data: bytes = field(repr=False)
    log_time: int = 0
    create_time: int = 0


@dataclass(frozen=True)
class Metadata:
    """A named table of strings."""

    name: str
    data: dict[str, str]


@dataclass(frozen=True)
class End:
    """The file ended as it should; `data_crc`: its data section had a checksum, which fits."""

    data_crc: bool


Record = Header | Schema | Channel | Messages | Attachment | Metadata | End


def windows(buffer: bytes, dtype: str) -> NDArray[np.generic]:
    """A view whose element i is the value of `dtype` that starts at byte i, without copying."""
    kind = np.dtype(dtype)
    count = max(0, len(buffer) - kind.itemsize + 1)
    return np.ndarray((count,), kind, buffer if count else b"\0" * kind.itemsize, 0, (1,))


def batch(buffer: bytes, positions: list[int]) -> Messages:
    """The message records at these positions of a buffer."""
    at = np.array(positions, dtype=np.int64)
    lengths = windows(buffer, "<i8")[at + 1]
    return Messages(
        buffer,
        at + 9 + MESSAGE_HEADER,
        at + 9 + lengths.astype(np.int64),
        windows(buffer, "<u2")[at + 9].astype(np.uint16),
        windows(buffer, "<u4")[at + 11].astype(np.uint32),
        windows(buffer, "<i8")[at + 15].astype(np.int64),
        windows(buffer, "<i8")[at + 23].astype(np.int64),
    )


class Short(Exception):
    """A record's content ends too early."""

    def __str__(self) -> str:
        return "it is too short for what it must hold"


class Fields:
    """Reads a record's content from left to right."""

    def __init__(self, content: bytes) -> None:
        self.content, self.pos = content, 0

    def skip(self, count: int) -> bytes:
        """The next `count` bytes."""
        end = self.pos + count
        if end > len(self.content):
            raise Short
        piece = self.content[self.pos : end]
        self.pos = end
        return piece

    def u16(self) -> int:
        """The next number."""
        return int(_U16.unpack(self.skip(2))[0])

    def u32(self) -> int:
        """The next number."""
        return int(_U32.unpack(self.skip(4))[0])

    def u64(self) -> int:
        """The next number."""
        return int(_U64.unpack(self.skip(8))[0])

    def text(self) -> str:
        """The next text."""
        return self.skip(self.u32()).decode("utf-8")

    def blob(self) -> bytes:
        """The next bytes, after their length."""
        return self.skip(self.u64())

    def table(self) -> dict[str, str]:
        """The next table of texts."""
        inner = Fields(self.skip(self.u32()))
        pairs: dict[str, str] = {}
        while inner.pos < len(inner.content):
            key = inner.text()
            pairs[key] = inner.text()
        return pairs


def _header(f: Fields) -> Header:
    return Header(f.text(), f.text())


def _schema(f: Fields) -> Schema:
    return Schema(f.u16(), f.text(), f.text(), f.skip(f.u32()))


def _channel(f: Fields) -> Channel:
    identity, schema_id = f.u16(), f.u16()
    return Channel(identity, f.text(), f.text(), schema_id, f.table())


def _attachment(f: Fields) -> Attachment:
    log_time, create_time = f.u64(), f.u64()
    attachment = Attachment(f.text(), f.text(), f.blob(), log_time, create_time)
    end = f.pos
    stated = f.u32()
    if stated and zlib.crc32(f.content[:end]) != stated:
        raise BadChunk("its checksum does not fit its content")
    return attachment


def _metadata(f: Fields) -> Metadata:
    return Metadata(f.text(), f.table())


PARSERS: dict[int, Callable[[Fields], Record]] = {
    HEADER: _header,
    SCHEMA: _schema,
    CHANNEL: _channel,
    ATTACHMENT: _attachment,
    METADATA: _metadata,
}


class BadChunk(Exception):
    """Why a chunk can't be read; the walk over the file says where."""


def decompress(compression: str, data: bytes, size: int, limit: int) -> bytes:
    """The content of a chunk.

    Args:
        compression: "", "lz4" or "zstd".
        data: the compressed bytes.
        size: the size that the chunk states for its content [bytes].
        limit: the largest size that is accepted [bytes].

    Raises:
        BadChunk: for another compression, a size beyond the limit, or content of another size.
    """
    if size > limit:
        raise BadChunk(f"it claims {size} bytes when decompressed, the limit is {limit}")
    if compression == "":
        content = data
    elif compression == "zstd":
        content = _zstd(data, size)
    elif compression == "lz4":
        content = _lz4(data, size)
    else:
        raise BadChunk(f"its compression '{compression}' is not one of zstd, lz4 and none")
    if len(content) != size:
        raise BadChunk(f"it holds {len(content)} bytes, not the {size} that it states")
    return content


def _zstd(data: bytes, size: int) -> bytes:
    import zstandard

    decoder = zstandard.ZstdDecompressor(max_window_size=2**27)
    try:
        with decoder.stream_reader(data) as reader:
            content: bytes = reader.read(size + 1)
    except zstandard.ZstdError as error:
        raise BadChunk(f"it can't be decompressed ({error})") from None
    return content


def _lz4(data: bytes, size: int) -> bytes:
    from lz4.frame import LZ4FrameDecompressor

    decoder = LZ4FrameDecompressor()
    try:
        content: bytes = decoder.decompress(data, max_length=size + 1)
    except (RuntimeError, EOFError, ValueError, MemoryError) as error:
        raise BadChunk(f"it can't be decompressed ({error})") from None
    return content


def decompress_part(compression: str, data: bytes, limit: int) -> bytes:
    """What can still be decompressed of a chunk whose end is missing, at most `limit` bytes."""
    if compression == "zstd":
        return _zstd_part(data, limit)
    if compression == "lz4":
        return _lz4_part(data, limit)
    return data[:limit] if compression == "" else b""


def _zstd_part(data: bytes, limit: int) -> bytes:
    import zstandard

    parts: list[bytes] = []
    decoder = zstandard.ZstdDecompressor(max_window_size=2**27)
    with decoder.stream_reader(data) as reader:
        try:
            while sum(map(len, parts)) < limit and (part := reader.read(2**17)):
                parts.append(part)
        except zstandard.ZstdError:
            pass
    return b"".join(parts)


def _lz4_part(data: bytes, limit: int) -> bytes:
    from lz4.frame import LZ4FrameDecompressor

    decoder, parts = LZ4FrameDecompressor(), []
    try:
        for start in range(0, len(data), 2**12):
            parts.append(decoder.decompress(data[start : start + 2**12], max_length=limit))
    except (RuntimeError, EOFError, ValueError, MemoryError):
        pass
    return b"".join(parts)[:limit]
