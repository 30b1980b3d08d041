"""MCAP records: their contents, how their bytes are parsed, and how chunks are decompressed.

Integers are little-endian; a text is a u32 length and UTF-8; a table is a u32 length and pairs of
texts. Messages come in batches: one buffer with the positions of its messages, so that a million of
them can be decoded by array operations. A chunk (lz4, zstd or uncompressed) is decompressed at most
to the size that it states.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from grounded.findings import Finding
from grounded_trials.formats.bad import BadRecord

MAGIC = b"\x89MCAP0\r\n"  # at the beginning and the end of a file
MESSAGE_HEADER = 22  # channel u16, sequence u32, log time u64, publish time u64
RECORD_HEAD = struct.Struct("<BQ")  # opcode, length
_CHUNK = struct.Struct("<16xQII")  # times; size when decompressed, its CRC, length of a name
PIECE = 2**17  # [bytes] decompressed at once; what comes before an error is kept
_U64 = struct.Struct("<Q")


Op = IntEnum(
    "Op",
    "HEADER FOOTER SCHEMA CHANNEL MESSAGE CHUNK MESSAGE_INDEX CHUNK_INDEX ATTACHMENT "
    "ATTACHMENT_INDEX STATISTICS METADATA METADATA_INDEX SUMMARY_OFFSET DATA_END",
)

_NAMES: dict[int, str] = {
    Op.HEADER: "the header",
    Op.SCHEMA: "a schema",
    Op.CHANNEL: "a channel",
    Op.MESSAGE: "a message",
    Op.CHUNK: "a chunk",
    Op.ATTACHMENT: "an attached file",
    Op.METADATA: "a table of metadata",
}


@dataclass(frozen=True)
class Header:
    """The first record: the profile of the file, and the library that wrote it."""

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

    def channel_ids(self) -> list[int]:
        """Return the ids of channels with messages in the batch, in increasing order."""
        return np.flatnonzero(np.bincount(self.channels)).tolist()  # unique imports numpy.ma

    def of(self, channel: int) -> Messages:
        """Return the messages of one channel."""
        chosen = self.channels == channel
        return self if chosen.all() else self.take(chosen)

    def take(self, chosen: NDArray[np.bool_]) -> Messages:
        """Return the messages where `chosen` (N,) is true."""
        _, *columns = vars(self).values()
        return Messages(self.buffer, *(column[chosen] for column in columns))


@dataclass(frozen=True, eq=False)
class Rows:
    """The rows of a table, as the messages of a channel with the encoding "table"."""

    channel: int
    times: NDArray[np.int64]  # (N,) [ns]
    columns: dict[str, NDArray[np.float64]]  # (N,) each; q[0], q[1] ... are an array


@dataclass(frozen=True)
class About:
    """What a file says of its tables, and what is odd about them."""

    units: Mapping[str, str] = field(default_factory=dict)  # of its numbers, by message path
    findings: tuple[Finding, ...] = ()


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
    """The regular end of a file; `data_crc`: its data section had a valid checksum."""

    data_crc: bool


Record = Header | Schema | Channel | Messages | Rows | About | Attachment | Metadata | End


def record_name(opcode: int) -> str:
    """Return what to call a record."""
    return _NAMES.get(opcode, f"a record of type {opcode}")


def windows(buffer: bytes, dtype: str) -> NDArray[np.generic]:
    """Return a view whose element i is the value of `dtype` at byte i, without copying."""
    kind = np.dtype(dtype)
    count = max(0, len(buffer) - kind.itemsize + 1)
    return np.ndarray((count,), kind, buffer if count else b"\0" * kind.itemsize, 0, (1,))


def batch(buffer: bytes, positions: list[int]) -> Messages:
    """Return the message records at these positions of a buffer."""
    at = np.array(positions, dtype=np.int64)
    return Messages(
        buffer,
        at + 9 + MESSAGE_HEADER,
        at + 9 + windows(buffer, "<i8")[at + 1].astype(np.int64),
        windows(buffer, "<u2")[at + 9].astype(np.uint16),
        windows(buffer, "<u4")[at + 11].astype(np.uint32),
        windows(buffer, "<i8")[at + 15].astype(np.int64),
        windows(buffer, "<i8")[at + 23].astype(np.int64),
    )


class Fields:
    """Parses a record's content from left to right."""

    def __init__(self, content: bytes | memoryview) -> None:
        self.content, self.pos = content, 0

    def skip(self, count: int) -> bytes:
        """Return the next `count` bytes."""
        end = self.pos + count
        if end > len(self.content):
            raise BadRecord("decode", what="content")
        piece = bytes(self.content[self.pos : end])
        self.pos = end
        return piece

    def uint(self, bits: int) -> int:
        """Return the next unsigned integer."""
        return int.from_bytes(self.skip(bits // 8), "little")

    def text(self) -> str:
        """Return the next text."""
        try:
            return self.skip(self.uint(32)).decode("utf-8")
        except UnicodeDecodeError:
            raise BadRecord("decode", what="text") from None

    def table(self) -> dict[str, str]:
        """Return the next table of texts."""
        inner = Fields(self.skip(self.uint(32)))
        pairs: dict[str, str] = {}
        while inner.pos < len(inner.content):
            key = inner.text()
            pairs[key] = inner.text()
        return pairs


def _channel(f: Fields) -> Channel:
    identity, schema_id = f.uint(16), f.uint(16)
    return Channel(identity, f.text(), f.text(), schema_id, f.table())


def _attachment(f: Fields) -> Attachment:
    log_time, create_time = f.uint(64), f.uint(64)
    attachment = Attachment(f.text(), f.text(), f.skip(f.uint(64)), log_time, create_time)
    end = f.pos
    stated = f.uint(32)
    if stated and zlib.crc32(f.content[:end]) != stated:
        raise BadRecord("decode", what="checksum")
    return attachment


PARSERS: dict[int, Callable[[Fields], Record]] = {
    Op.HEADER: lambda f: Header(f.text(), f.text()),
    Op.SCHEMA: lambda f: Schema(f.uint(16), f.text(), f.text(), f.skip(f.uint(32))),
    Op.CHANNEL: _channel,
    Op.ATTACHMENT: _attachment,
    Op.METADATA: lambda f: Metadata(f.text(), f.table()),
}


def chunk_content(content: bytes | memoryview, *, packed: bool = True) -> tuple[bytes, bool]:
    """Return the decompressed records of a chunk, and whether it has a checksum."""
    try:
        size, crc, length = _CHUNK.unpack_from(content)
        name, start = bytes(content[32 : 32 + length]), 40 + length
        stored = _U64.unpack_from(content, 32 + length)[0]
    except struct.error:
        raise BadRecord("decode", what="content") from None
    if start + stored > len(content):
        raise BadRecord("decode", what="content")
    if name and not packed:
        raise BadRecord("decode", what="content", why="compressed")
    inside = bytes(content[start : start + stored])
    data, wrong = decompress(name.decode("utf-8", "replace"), inside, size)
    if wrong:
        raise BadRecord("decode", what="compression", why=wrong)
    if len(data) != size:
        raise BadRecord("decode", what="size")
    if crc and zlib.crc32(data) != crc:
        raise BadRecord("decode", what="checksum")
    return data, bool(crc)


def decompress(compression: str, data: bytes, size: int) -> tuple[bytes, str]:
    """Return a chunk's content up to an error or to size + 1 bytes, and the error, "" for none.

    The compression is "", "lz4" or "zstd"; `size` is what the chunk states.
    """
    if not compression:
        return data, ""
    known = {"zstd": _zstd, "lz4": _lz4}
    if compression not in known:
        return b"", f"'{compression[:40]}', not zstd or lz4"
    parts: list[bytes] = []
    have, wrong = 0, ""
    try:
        for part in known[compression](data):
            parts.append(part)
            have += len(part)
            if have > size:
                break
    except MemoryError:
        raise
    except Exception as error:  # each library has its own
        wrong = str(error)
    return b"".join(parts)[: size + 1], wrong


def _zstd(data: bytes) -> Iterator[bytes]:
    import zstandard

    with zstandard.ZstdDecompressor(max_window_size=2**27).stream_reader(data) as reader:
        while part := reader.read(PIECE):
            yield part


def _lz4(data: bytes) -> Iterator[bytes]:
    from lz4.frame import LZ4FrameDecompressor

    decoder, part = LZ4FrameDecompressor(), data
    while not decoder.eof and (part or decoder.needs_input is False):
        yield decoder.decompress(part, max_length=PIECE)
        part = b""
