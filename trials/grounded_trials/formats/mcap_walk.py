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
from collections.abc import Iterator
from mmap import ACCESS_READ, mmap
from struct import Struct
from typing import Any, BinaryIO

import numpy as np

from grounded.errors import GroundedError, NextCommand
from grounded.findings import found
from grounded_trials.formats.bad import BadRecord
from grounded_trials.formats.mcap_records import (
    CHANNEL,
    CHUNK,
    DATA_END,
    FOOTER,
    MAGIC,
    MESSAGE,
    MESSAGE_HEADER,
    PARSERS,
    SCHEMA,
    Channel,
    End,
    Fields,
    Messages,
    Record,
    Schema,
    batch,
    chunk_content,
)

Data = bytes | mmap
BLOCK = 4 * 2**20  # [bytes] of messages in a batch
SMALL_CHUNK = 2**16  # [bytes] chunks smaller than this are joined ...
TOGETHER = 2**20  # [bytes] ... up to this size
BATCH_MESSAGES = 250_000  # messages in a batch
SAMPLE = 32  # messages in which a cycle of lengths is looked for
PERIOD = 8  # longest such cycle, in messages

PARSED = frozenset((*PARSERS, CHUNK, MESSAGE))
_NAMES = {MESSAGE: "a message", CHUNK: "a chunk", SCHEMA: "a schema", CHANNEL: "a channel"}
_HEAD = Struct("<BQ")
_U32 = Struct("<I")


class DamagedFile(GroundedError):
    """A file that violates the MCAP format.

    Args:
        name: of the file.
        offset: where that was noticed [bytes].
        what: what is wrong there: `file.damaged` says it in words.
        where: the part of the file.
        why: the cause, if known.
        lost: whether nothing can be saved.
    """

    def __init__(
        self, name: str, offset: int, what: str, where: str = "", why: str = "", lost: bool = False
    ) -> None:
        self.offset, self.what = offset, what
        facts: dict[str, Any] = {"what": what, "where": where, "why": why}
        then = None if lost else NextCommand("recover", (name,))
        code = "file.no_message" if lost else "file.damaged"
        code = "file.no_log" if what == "other" else code
        super().__init__(found(code, name, then=then, byte=offset, **facts))


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
    yield from _Walk(data, name, packed).records()


class _Walk:
    """One pass over a file, up to `pos`."""

    def __init__(self, data: Data, name: str, packed: bool) -> None:
        self.data, self.name, self.packed = data, name, packed
        self.pos, self.size = 0, len(data)
        self.summary = 0  # where the summary begins
        self.data_crc: bool | None = None  # None: still in the data section
        self.defined: dict[tuple[type, int], Schema | Channel] = {}
        self.small: list[bytes] = []  # the contents of small chunks, and the messages in them
        self.small_size, self.positions = 0, list[int]()
        self.messages = False  # a message, or a chunk of them, has begun

    def damaged(
        self, what: str, where: str = "", why: str = "", offset: int | None = None
    ) -> DamagedFile:
        at = self.pos if offset is None else offset
        return DamagedFile(self.name, at, what, where, why)

    def checksum(self, start: int) -> int:
        """Return the CRC from `start` to here."""
        return zlib.crc32(memoryview(self.data)[start : self.pos])

    def need(self, count: int, what: str) -> None:
        """Check that the file has so many bytes more; before its first message none is saved."""
        if self.pos + count > self.size:
            raise DamagedFile(self.name, self.size, "cut", what, lost=not self.messages)

    def records(self) -> Iterator[Record]:
        self._magic()
        while True:
            self.need(9, "a record's head")
            opcode, length = _HEAD.unpack_from(self.data, self.pos)
            self.messages |= opcode in (CHUNK, MESSAGE)
            self.need(9 + length, _NAMES.get(opcode, f"a record of type {opcode}"))
            if self.data_crc is None and opcode in PARSED:
                if opcode != CHUNK:
                    yield from self._together()
                if opcode == MESSAGE:
                    yield self._run_of_messages(9 + length)
                    continue
            elif opcode not in (DATA_END, FOOTER):  # an index, or part of the summary
                self.pos += 9 + length
                continue
            at, start = self.pos, self.pos + 9
            content = memoryview(self.data)[start : start + length]
            if opcode == DATA_END and self.data_crc is None:
                yield from self._together()
                self._data_end(content)
            elif opcode == FOOTER:
                self._footer(content)
                yield End(bool(self.data_crc))
                return
            self.pos = start + length
            if self.data_crc is None:
                yield from self._data_record(opcode, content, at)

    def _magic(self) -> None:
        if (head := self.data[:8]) != MAGIC:
            what = "empty" if not head else "cut" if MAGIC.startswith(head) else "other"
            raise DamagedFile(self.name, 0, what, "its first 8 bytes", lost=True)
        self.pos = 8

    def _run_of_messages(self, first: int) -> Messages:
        """Return consecutive message records: a block of them, at least the first."""
        start, end = self.pos, min(self.size, self.pos + max(first, BLOCK))
        block = self.data[start:end]
        try:
            positions, stop = message_positions(block, 0, len(block))
        except BadRecord as error:
            raise self.damaged("record", "message", error.finding.what) from None
        self.pos += stop
        return self._in_calendar(batch(block, positions))

    def _in_calendar(self, messages: Messages) -> Messages:
        if len(messages) and messages.log_times.min() < 0:
            raise self.damaged("time", "a message")
        return messages

    def _together(self) -> Iterator[Messages]:
        """Yield the messages of the small chunks collected so far."""
        if self.positions:
            yield self._in_calendar(batch(b"".join(self.small), self.positions))
        self.small, self.small_size, self.positions = [], 0, []

    def _chunk(self, data: bytes) -> Iterator[Record]:
        if (
            len(data) >= SMALL_CHUNK
            or self.small_size > TOGETHER
            or len(self.positions) > BATCH_MESSAGES
        ):
            yield from self._together()
        if len(data) < SMALL_CHUNK:
            for part in chunk_parts(data):
                if isinstance(part, list):
                    self.positions += [self.small_size + at for at in part]
                else:
                    yield self._defined(part)
            self.small.append(data)
            self.small_size += len(data)
            return
        for record in chunk_records(data):
            if isinstance(record, Messages):
                yield self._in_calendar(record)
            else:
                yield self._defined(record)

    def _defined(self, record: Record) -> Record:
        """Return the record; raise an error if its id belongs to another schema or channel."""
        if isinstance(record, Schema | Channel):
            known = self.defined.setdefault((type(record), record.id), record)
            if known != record:
                raise again(known, record)
        return record

    def _data_record(self, opcode: int, content: memoryview, at: int) -> Iterator[Record]:
        try:
            if opcode == CHUNK:
                yield from self._chunk(chunk_content(content, packed=self.packed)[0])
            elif opcode in PARSERS:
                yield self._defined(PARSERS[opcode](Fields(content)))
        except BadRecord as error:
            what = _NAMES.get(opcode, f"a record of type {opcode}")
            raise self.damaged("record", what, error.finding.what, at) from None

    def _data_end(self, content: memoryview) -> None:
        stated = Fields(content).uint(32) if len(content) >= 4 else 0
        if stated and stated != self.checksum(0):
            raise self.damaged("checksum", "the data section")
        self.data_crc = bool(stated)
        self.summary = self.pos + 9 + len(content)

    def _footer(self, content: memoryview) -> None:
        if self.data_crc is None:
            raise self.damaged("record", "the footer")
        if len(content) < 20:
            raise self.damaged("record", "the footer")
        begin = self.pos
        self.pos += 9 + 16
        stated = _U32.unpack_from(content, 16)[0]
        if stated and stated != self.checksum(self.summary):
            raise self.damaged("checksum", "the summary")
        self.pos = begin + 9 + len(content)
        self.need(8, "its last 8 bytes")
        if self.data[self.pos : self.pos + 8] != MAGIC:
            raise self.damaged("record", "its end")
        self.pos += 8
        if self.pos != self.size:
            raise self.damaged("record", "its end", f"{self.size - self.pos} bytes more")


def again(known: Schema | Channel, other: Schema | Channel) -> BadRecord:
    """Return the error for a second definition with the id of a first one."""
    names = [r.topic if isinstance(r, Channel) else r.name for r in (known, other)]
    what, (one, two) = f"{type(known).__name__.lower()} {known.id}", (n[:80] for n in names)
    return BadRecord("decode", what=what, at=one, why=two)


def chunk_records(data: bytes, *, cut: bool = False) -> Iterator[Schema | Channel | Messages]:
    """Yield the schemas and channels of a decompressed chunk, and its messages in batches.

    Args:
        data: the chunk's content.
        cut: its end is missing: stop at the first incomplete record.

    Raises:
        BadRecord: if the records do not fit the chunk.
    """
    positions: list[int] = []
    for part in chunk_parts(data, cut=cut):
        if not isinstance(part, list):
            yield part
            continue
        positions += part
        if len(positions) >= BATCH_MESSAGES:
            yield batch(data, positions)
            positions = []
    yield batch(data, positions)


def chunk_parts(data: bytes, *, cut: bool = False) -> Iterator[Schema | Channel | list[int]]:
    """Yield the schemas and channels of a chunk, and the positions of the messages between them.

    Arguments and errors are those of `chunk_records`.
    """
    pos, end = 0, len(data)
    while pos < end:
        opcode, length = _HEAD.unpack_from(data, pos) if end - pos >= 9 else (0, end)
        if length > end - pos - 9:
            if cut:
                break
            raise BadRecord("decode", what="content")
        if opcode == MESSAGE:
            positions, pos = message_positions(data, pos, end)
            yield positions
            continue
        if opcode in (SCHEMA, CHANNEL):
            record = PARSERS[opcode](Fields(data[pos + 9 : pos + 9 + length]))
            assert isinstance(record, Schema | Channel)
            yield record
        pos += 9 + length


def message_positions(buffer: bytes, pos: int, end: int) -> tuple[list[int], int]:
    """Return the starts of consecutive message records from `pos` on, and their end.

    Raises:
        BadRecord: for a message that is shorter than its header.
    """
    positions: list[int] = []
    append, unpack, look = positions.append, _HEAD.unpack_from, SAMPLE
    while end - pos >= 9 and len(positions) < BATCH_MESSAGES:
        opcode, length = unpack(buffer, pos)
        if opcode != MESSAGE or length > end - pos - 9:
            break
        if length < MESSAGE_HEADER:
            raise BadRecord("decode", what="header", at=f"{length} bytes")
        append(pos)
        pos += 9 + length
        if len(positions) == look:
            more, pos = _repeated(buffer, positions[-SAMPLE:], pos, end)
            positions += more
            look = len(positions) + (SAMPLE if more else 8 * SAMPLE)
    return positions[:BATCH_MESSAGES], positions[BATCH_MESSAGES] if len(
        positions
    ) > BATCH_MESSAGES else pos


def _repeated(buffer: bytes, last: list[int], pos: int, end: int) -> tuple[list[int], int]:
    """Continue `message_positions` as long as the lengths of the last messages repeat.

    A log of a few topics at one rate does so nearly to its end, and comparing headers with those
    that are expected takes a tenth of the time of following them one by one.
    """
    sizes = np.diff([*last, pos])
    cycles = (p for p in range(1, PERIOD + 1) if (sizes[p:] == sizes[:-p]).all())
    period = next(cycles, 0)
    if not period:
        return [], pos
    cycle = sizes[-period:]
    count = min((end - pos) // int(cycle.sum()), BATCH_MESSAGES // period) * period
    if count < SAMPLE:
        return [], pos
    expected = np.tile(cycle, count // period)
    starts = pos + np.cumsum(expected) - expected
    anywhere = np.ndarray((len(buffer) - 8,), "<u8", buffer, offset=1, strides=(1,))
    right = np.frombuffer(buffer, np.uint8)[starts] == MESSAGE
    right &= anywhere[starts] == (expected - 9).astype("<u8")
    good = count if right.all() else int(right.argmin())
    return starts[:good].tolist(), pos + int(expected[:good].sum())
