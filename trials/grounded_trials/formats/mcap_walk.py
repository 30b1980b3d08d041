"""Read the records of an MCAP file in order, with every checksum verified, in bounded memory.

An MCAP file is  magic, records, magic;  a record is  opcode u8, length u64, content.  The data
section (header, schemas, channels, messages, chunks of them, attachments, metadata) ends with a
DataEnd record that may hold the CRC of everything before it. The summary that follows ends with the
footer, which may hold the summary's CRC. The contents of the summary are not used here.

Refused are ids shared by two schemas or channels, and messages logged after 2262 (2^63 ns).

The mcap package is not used for reading: its stream reader takes 5 us per record, returns short
records at the end of a truncated file, and checks neither summary nor attachments; importing it
takes 40 ms.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from mmap import ACCESS_READ, mmap
from struct import Struct
from typing import Any, BinaryIO

from grounded.errors import GroundedError, NextCommand
from grounded.findings import found
from grounded_trials.formats.bad import BadRecord
from grounded_trials.formats.mcap_records import (
    MAGIC,
    MESSAGE_HEADER,
    PARSERS,
    RECORD_HEAD,
    Channel,
    End,
    Fields,
    Messages,
    Op,
    Record,
    Rows,
    Schema,
    batch,
    chunk_content,
    record_name,
)

Data = bytes | mmap
BLOCK = 4 * 2**20  # [bytes] of messages outside chunks in a batch

PARSED = frozenset((*PARSERS, Op.CHUNK, Op.MESSAGE))
_U32 = Struct("<I")


class DamagedFile(GroundedError):
    """A file that violates the MCAP format.

    `offset` is where that was noticed [bytes]; `what` is wrong there, which `file.damaged` says in
    words; `lost`: nothing can be saved.
    """

    def __init__(
        self, name: str, offset: int, what: str, part: str = "", why: str = "", lost: bool = False
    ) -> None:
        self.offset, self.what = offset, what
        facts: dict[str, Any] = {"byte": offset, "what": what, "part": part, "why": why}
        then = None if lost else NextCommand("recover", (name,))
        code = "no_log" if what == "other" else "no_message" if lost else "damaged"
        super().__init__(found(f"file.{code}", name, then=then, **facts))


def mapped(stream: BinaryIO) -> Data:
    """Return the bytes of an open file as they are read, without copying."""
    empty = not stream.seek(0, 2)
    return b"" if empty else mmap(stream.fileno(), 0, access=ACCESS_READ)


def read_records(data: Data, name: str, *, packed: bool = True) -> Iterator[Record]:
    """Yield the records of an MCAP file in order, ending with `End`.

    Args:
        data: the file's bytes, see `mapped`.
        name: of the file, for messages.
        packed: whether chunks may be compressed; if not, reading takes time and memory in
            proportion to the size of the file.

    Raises:
        DamagedFile: if it is not a complete, undamaged MCAP file.
    """
    return _Walk(data, name, packed).records()


class _Walk:
    """One pass over a file, up to `pos`."""

    def __init__(self, data: Data, name: str, packed: bool) -> None:
        self.data, self.name, self.packed = data, name, packed
        self.pos, self.size = 0, len(data)
        self.summary = 0  # where the summary begins
        self.data_crc: bool | None = None  # None: still in the data section
        self.defined: dict[tuple[type, int], Schema | Channel] = {}
        self.messages = False  # a message, or a chunk of them, has begun

    def damaged(self, what: str, part: str, why: str = "", at: int | None = None) -> DamagedFile:
        return DamagedFile(self.name, self.pos if at is None else at, what, part, why)

    def checksum(self, start: int, end: int) -> int:
        return zlib.crc32(memoryview(self.data)[start:end])

    def need(self, count: int, what: str) -> None:
        """Check that the file has so many bytes more; before its first message none is saved."""
        if self.pos + count > self.size:
            raise DamagedFile(self.name, self.size, "cut", what, lost=not self.messages)

    def records(self) -> Iterator[Record]:
        if (head := self.data[:8]) != MAGIC:
            what = "empty" if not head else "cut" if MAGIC.startswith(head) else "other"
            raise DamagedFile(self.name, 0, what, "its first 8 bytes", lost=True)
        self.pos = 8
        while True:
            self.need(9, "a record's head")
            opcode, length = RECORD_HEAD.unpack_from(self.data, self.pos)
            self.messages |= opcode in (Op.CHUNK, Op.MESSAGE)
            self.need(9 + length, record_name(opcode))
            at, start, end = self.pos, self.pos + 9, self.pos + 9 + length
            if opcode == Op.MESSAGE and self.data_crc is None:
                yield self._sound(self._run_of_messages(9 + length))
                continue
            if opcode == Op.FOOTER:
                self._footer(start, end)
                yield End(bool(self.data_crc))
                return
            if self.data_crc is None and (opcode in PARSED or opcode == Op.DATA_END):
                content = memoryview(self.data)[start:end]
                if opcode == Op.DATA_END:
                    stated = Fields(content).uint(32) if length >= 4 else 0
                    if stated and stated != self.checksum(0, at):
                        raise self.damaged("checksum", "the data section")
                    self.data_crc, self.summary = bool(stated), end
                else:
                    self.pos = end
                    yield from self._data_record(opcode, content, at)
            self.pos = end  # also behind an index, or a part of the summary

    def _run_of_messages(self, first: int) -> Messages:
        """Return consecutive message records: a block of them, at least the first."""
        block = self.data[self.pos : self.pos + max(first, BLOCK)]
        try:
            positions, stop = message_positions(block, 0, len(block))
        except BadRecord as error:
            raise self.damaged("record", "message", error.finding.what) from None
        self.pos += stop
        return batch(block, positions)

    def _sound(self, record: Record) -> Record:
        """Return the record; raise an error for a second definition, or a time outside ours."""
        if isinstance(record, Schema | Channel):
            known = self.defined.setdefault((type(record), record.id), record)
            if known != record:
                raise again(known, record)
        elif isinstance(record, Messages) and len(record) and record.log_times.min() < 0:
            raise self.damaged("time", "a message")
        return record

    def _data_record(self, opcode: int, content: memoryview, at: int) -> Iterator[Record]:
        try:
            if opcode == Op.CHUNK:
                for record in chunk_records(chunk_content(content, packed=self.packed)[0]):
                    yield self._sound(record)
            else:
                yield self._sound(PARSERS[opcode](Fields(content)))
        except BadRecord as error:
            raise self.damaged("record", record_name(opcode), error.finding.what, at) from None

    def _footer(self, start: int, end: int) -> None:
        if self.data_crc is None or end - start < 20:
            raise self.damaged("record", "the footer")
        stated = _U32.unpack_from(self.data, start + 16)[0]
        if stated and stated != self.checksum(self.summary, start + 16):
            raise self.damaged("checksum", "the summary")
        self.pos = end
        self.need(8, "its last 8 bytes")
        if self.data[end : end + 8] != MAGIC:
            raise self.damaged("record", "its end")
        self.pos += 8
        if self.pos != self.size:
            raise self.damaged("record", "its end", f"{self.size - self.pos} bytes more")


@dataclass(frozen=True, eq=False)
class Topic:
    """A topic of a file: its channel, and the type of its messages."""

    channel: Channel
    schema: Schema | None

    @property
    def name(self) -> str:
        """Its name."""
        return self.channel.topic

    @property
    def type(self) -> str:
        """The name of its messages' type, else their encoding."""
        return self.schema.name if self.schema else self.channel.encoding


@dataclass(frozen=True, eq=False)
class Part:
    """Messages, or rows of a table, of one topic."""

    topic: Topic
    content: Messages | Rows


def by_topic(records: Iterable[Record], name: str) -> Iterator[Record | Topic | Part]:
    """Yield records with topics in place of schemas and channels, and messages with theirs."""
    schemas, topics = dict[int, Schema](), dict[int, Topic]()
    for record in records:
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            if record.id not in topics:
                topics[record.id] = Topic(record, schemas.get(record.schema_id))
                yield topics[record.id]
        elif isinstance(record, Rows):
            yield Part(topics[record.channel], record)
        elif isinstance(record, Messages):
            for identity in record.channel_ids():
                if identity not in topics:
                    raise DamagedFile(name, 0, "record", "a message", f"channel {identity}")
                yield Part(topics[identity], record.of(identity))
        else:
            yield record


def again(known: Schema | Channel, other: Schema | Channel) -> BadRecord:
    """Return the error for a second definition with the id of a first one."""
    names = [r.topic if isinstance(r, Channel) else r.name for r in (known, other)]
    what, (one, two) = f"{type(known).__name__.lower()} {known.id}", (n[:80] for n in names)
    return BadRecord("decode", what=what, at=one, why=two)


def chunk_records(data: bytes, *, cut: bool = False) -> Iterator[Schema | Channel | Messages]:
    """Yield the schemas and channels of a decompressed chunk, then its messages.

    `cut`: its end is missing; stop at the first incomplete record.
    """
    positions, pos, end = list[int](), 0, len(data)
    while pos < end:
        some, pos = message_positions(data, pos, end)
        positions += some
        opcode, length = RECORD_HEAD.unpack_from(data, pos) if end - pos >= 9 else (0, end - pos)
        if pos < end and length > end - pos - 9:
            if cut:
                break
            raise BadRecord("decode", what="content")
        if opcode in (Op.SCHEMA, Op.CHANNEL):
            record = PARSERS[opcode](Fields(data[pos + 9 : pos + 9 + length]))
            assert isinstance(record, Schema | Channel)
            yield record
        if opcode != Op.MESSAGE:
            pos += 9 + length
    yield batch(data, positions)


def message_positions(buffer: bytes, pos: int, end: int) -> tuple[list[int], int]:
    """Return the starts of consecutive message records from `pos` on, and their end."""
    positions: list[int] = []
    append, unpack, message = positions.append, RECORD_HEAD.unpack_from, int(Op.MESSAGE)
    while end - pos >= 9:
        opcode, length = unpack(buffer, pos)
        if opcode != message or length > end - pos - 9:
            break
        if length < MESSAGE_HEADER:
            raise BadRecord("decode", what="header", at=f"{length} bytes")
        append(pos)
        pos += 9 + length
    return positions, pos
