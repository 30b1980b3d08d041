"""MCAP's outer layer: the bytes of a file as records, every checksum checked, in bounded memory.

An MCAP file is  magic, records, magic;  a record is  opcode u8, length u64, content.  The data
section (header, schemas, channels, messages, chunks of them, attachments, metadata) ends with a
DataEnd record that may hold the CRC of everything before it; the summary that follows ends with
the footer, which may hold the summary's CRC. Nothing in the summary is trusted or needed here.

A record or chunk beyond a limit is refused before any memory is taken for it.

Why not the mcap package: its stream reader takes 5 us a record, hands out short records at the end
of a truncated file, and checks neither summary nor attachments; its import costs 40 ms.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from struct import Struct
from typing import BinaryIO

from grounded.errors import GroundedError, NextCommand
from grounded_trials.formats.mcap_records import (
    CHANNEL,
    CHUNK,
    DATA_END,
    FOOTER,
    MESSAGE,
    MESSAGE_HEADER,
    PARSERS,
    SCHEMA,
    BadRecord,
    End,
    Fields,
    Messages,
    Record,
    batch,
    chunk_content,
)

MAGIC = b"\x89MCAP0\r\n"
RECORD_LIMIT = 512 * 2**20  # [bytes] of one record, and of one chunk when decompressed
BLOCK = 4 * 2**20  # [bytes] read at a time

_HEAD = Struct("<BQ")
_U32 = Struct("<I")


class DamagedFile(GroundedError):
    """A file that is not what MCAP says it must be; `offset` is where that was noticed [bytes]."""

    def __init__(self, name: str, offset: int, found: str, advice: str | None = None) -> None:
        self.found, self.offset = found, offset
        then = NextCommand("recover", (name,)) if advice is None else None
        advice = advice or "`recover` saves what can be saved"
        super().__init__(f"{name}: {found} (at byte {offset}); {advice}", then)


def read_records(stream: BinaryIO, name: str, *, limit: int = RECORD_LIMIT) -> Iterator[Record]:
    """Yields the records of an MCAP stream in order, ending with `End`.

    Args:
        stream: a seekable binary file, read from its beginning.
        name: of the file, for messages.
        limit: largest record, and largest chunk when decompressed [bytes].

    Raises:
        DamagedFile: where the bytes are not a complete, undamaged MCAP file.
    """
    yield from _Walk(stream, name, limit).records()


class _Walk:
    """One pass over a file; `buffer[pos:]` is what has been read and not used yet."""

    def __init__(self, stream: BinaryIO, name: str, limit: int) -> None:
        self.stream, self.name, self.limit = stream, name, limit
        self.size = stream.seek(0, 2)
        stream.seek(0)
        self.buffer, self.pos, self.base = b"", 0, 0
        self.crc, self.crc_pos = 0, 0  # of the bytes up to buffer[crc_pos]
        self.data_crc: bool | None = None  # None: still in the data section

    @property
    def offset(self) -> int:
        return self.base + self.pos

    def damaged(self, found: str, offset: int | None = None) -> DamagedFile:
        return DamagedFile(self.name, self.offset if offset is None else offset, found)

    def fold(self) -> int:
        """The CRC of everything used so far."""
        self.crc = zlib.crc32(memoryview(self.buffer)[self.crc_pos : self.pos], self.crc)
        self.crc_pos = self.pos
        return self.crc

    def need(self, count: int, what: str) -> None:
        """Makes `count` unused bytes available at buffer[pos]."""
        if len(self.buffer) - self.pos >= count:
            return
        if self.offset + count > self.size:
            raise self.damaged(f"the file ends inside {what}")
        self.fold()
        self.base += self.pos
        parts = [self.buffer[self.pos :]]
        have = len(parts[0])
        while have < count:
            block = self.stream.read(max(BLOCK, count - have))
            if not block:
                raise self.damaged(f"the file ends inside {what}")
            parts.append(block)
            have += len(block)
        self.buffer, self.pos, self.crc_pos = b"".join(parts), 0, 0

    def records(self) -> Iterator[Record]:
        self._magic()
        while True:
            self.need(9, "a record's head; its end is missing")
            opcode, length = _HEAD.unpack_from(self.buffer, self.pos)
            if opcode == MESSAGE and self.data_crc is None:
                self.need(9 + self._allowed(length), "a message")
                yield self._run_of_messages()
                continue
            self.need(9 + self._allowed(length), f"a record of type {opcode}")
            at, start = self.offset, self.pos + 9
            content = self.buffer[start : start + length]
            if opcode == DATA_END and self.data_crc is None:
                self._data_end(content)
            elif opcode == FOOTER:
                self._footer(content)
                yield End(bool(self.data_crc))
                return
            self.pos = start + length
            if self.data_crc is None:
                yield from self._data_record(opcode, content, at)

    def _magic(self) -> None:
        if self.size == 0:
            raise DamagedFile(self.name, 0, "the file is empty", "nothing can be saved")
        head = self.stream.read(8)
        self.stream.seek(0)
        if head != MAGIC:
            advice = "give a log in the MCAP format (ROS 1 bags: `mcap convert` turns them)"
            found = "this is not an MCAP file"
            if MAGIC.startswith(head):
                found, advice = "the file ends inside its first 8 bytes", "nothing can be saved"
            raise DamagedFile(self.name, 0, found, advice)
        self.need(8, "its first 8 bytes")
        self.pos += 8

    def _allowed(self, length: int) -> int:
        if length > self.limit:
            raise self.damaged(f"a record claims {length} bytes, the limit is {self.limit}")
        return int(length)

    def _run_of_messages(self) -> Messages:
        """All message records that follow each other in the buffer."""
        try:
            positions, self.pos = message_positions(self.buffer, self.pos, len(self.buffer))
        except BadRecord as error:
            raise self.damaged(str(error)) from None
        return batch(self.buffer, positions)

    def _data_record(self, opcode: int, content: bytes, at: int) -> Iterator[Record]:
        try:
            if opcode == CHUNK:
                yield from chunk_records(chunk_content(content, self.limit)[0])
            elif opcode in PARSERS:
                yield PARSERS[opcode](Fields(content))
        except BadRecord as error:
            names = {CHUNK: "a chunk", SCHEMA: "a schema", CHANNEL: "a channel"}
            what = names.get(opcode, f"a record of type {opcode}")
            raise self.damaged(f"{what} is damaged: {error}", at) from None

    def _data_end(self, content: bytes) -> None:
        stated = Fields(content).uint(32) if len(content) >= 4 else 0
        if stated and stated != self.fold():
            raise self.damaged("the checksum of the data section does not fit its content")
        self.data_crc = bool(stated)
        start = self.pos + 9 + len(content)
        self.crc, self.crc_pos = 0, start

    def _footer(self, content: bytes) -> None:
        if self.data_crc is None:
            raise self.damaged("the footer comes before the end of the data")
        if len(content) < 20:
            raise self.damaged("the footer is too short")
        begin = self.pos
        self.pos += 9 + 16
        stated = _U32.unpack_from(content, 16)[0]
        if stated and stated != self.fold():
            raise self.damaged("the checksum of the summary does not fit its content")
        self.pos = begin + 9 + len(content)
        self.need(8, "its last 8 bytes")
        if self.buffer[self.pos : self.pos + 8] != MAGIC:
            raise self.damaged("the file does not end as an MCAP file does")
        self.pos += 8
        if self.offset != self.size:
            raise self.damaged(f"{self.size - self.offset} bytes follow after the end")


def chunk_records(data: bytes, *, cut: bool = False) -> Iterator[Record]:
    """Yields the schemas and channels of a decompressed chunk, then its messages as one batch.

    Args:
        data: the chunk's content.
        cut: its end is missing: stop at the first record that is not wholly there.

    Raises:
        BadRecord: if the records do not fit the chunk.
    """
    positions: list[int] = []
    pos, end = 0, len(data)
    while pos < end:
        opcode, length = _HEAD.unpack_from(data, pos) if end - pos >= 9 else (0, end)
        if length > end - pos - 9:
            if cut:
                break
            raise BadRecord("it ends inside a record")
        if opcode == MESSAGE:
            more, pos = message_positions(data, pos, end)
            positions.extend(more)
            continue
        if opcode in (SCHEMA, CHANNEL):
            yield PARSERS[opcode](Fields(data[pos + 9 : pos + 9 + length]))
        pos += 9 + length
    yield batch(data, positions)


def message_positions(buffer: bytes, pos: int, end: int) -> tuple[list[int], int]:
    """Starts of the complete message records from `pos` on, and where they stop.

    Raises:
        BadRecord: for a message that is shorter than its header.
    """
    positions: list[int] = []
    append, unpack = positions.append, _HEAD.unpack_from
    while end - pos >= 9:
        opcode, length = unpack(buffer, pos)
        if opcode != MESSAGE or length > end - pos - 9:
            break
        if length < MESSAGE_HEADER:
            raise BadRecord(f"a message claims {length} bytes, it needs {MESSAGE_HEADER}")
        append(pos)
        pos += 9 + length
    return positions, pos
