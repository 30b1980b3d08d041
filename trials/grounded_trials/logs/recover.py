"""Recover a damaged log: write what can be saved to a new file, and report what was lost.

The file is read record by record. A chunk with a wrong checksum is dropped entirely, since its
wrong numbers can't be located; the message indexes after it show what it contained. Of a chunk cut
off by the end of the file, the messages before the cut are kept. Schemas and channels are taken
from anywhere in the file, including the summary.

Nothing marks the start of a record, but each states where the next one starts. After damage, the
next place with an intact chain is sought: a chunk whose inner lengths are consistent, the first of
several records in a row, or the last ones of the file.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from struct import Struct
from typing import IO, Any

import numpy as np

from grounded.checks import wrong
from grounded.errors import GroundedError
from grounded.findings import Finding, found
from grounded.result import UNSAID, Document
from grounded_trials.formats.bad import BadRecord
from grounded_trials.formats.mcap_records import (
    ATTACHMENT,
    CHUNK,
    DATA_END,
    FOOTER,
    MAGIC,
    MESSAGE,
    MESSAGE_HEADER,
    MESSAGE_INDEX,
    METADATA,
    PARSERS,
    Attachment,
    Channel,
    Fields,
    Header,
    Messages,
    Metadata,
    Record,
    Schema,
    batch,
    chunk_content,
    decompress,
)
from grounded_trials.formats.mcap_walk import Data, again, chunk_records, mapped, message_positions
from grounded_trials.formats.mcap_writer import McapWriter
from grounded_trials.formats.messages import Ints
from grounded_trials.logs.log_files import empty, open_log
from grounded_trials.store.candidate_file import read_candidate
from grounded_trials.store.own_files import TRIAL
from grounded_trials.store.store import sync_folder
from grounded_trials.within import within

MOST_LOSSES = 50  # number of losses listed
HEAD = 2**20  # [bytes] at the beginning of a log, in which its first chunk begins
COMPRESSED = (b"\4\0\0\0zstd", b"\3\0\0\0lz4")  # a chunk's; then the copy is compressed, too


OF_A_TRIAL: Mapping[str, Any] = {"brief": True}  # a field that is None for other files


@dataclass(frozen=True, eq=False)
class Recovery(Document):
    """What was saved, what was lost, and how much of it has no valid checksum."""

    file: Path
    messages: Mapping[str, int]  # saved, by topic
    lost_messages: Mapping[str, int]  # known to be lost, by topic
    findings: tuple[Finding, ...]  # what was lost; empty if the file was not damaged
    unverified: int  # saved messages without a valid checksum
    duration_s: float  # from the first to the last saved message
    losses: tuple[str, ...]  # the findings in words
    complete: bool  # nothing was lost, and everything saved is verified
    candidate: str | None = field(metadata=OF_A_TRIAL, default=None)  # the one that it ran
    steps: int | None = field(metadata=OF_A_TRIAL, default=None)  # saved ones
    planned_steps: int | None = field(metadata=OF_A_TRIAL, default=None)  # of its policy, if saved
    # steps before the last one are missing, so it can't be read as a trial
    hole: bool | None = field(metadata=OF_A_TRIAL, default=None)
    format: str = field(metadata=UNSAID, default="")  # TRIAL or CANDIDATE if grounded wrote it


def recover_log(source: str | Path, target: str | Path) -> Recovery:
    """Write what can be saved of a log to a new file.

    Args:
        source: the damaged file; it is not changed.
        target: the file to write; it must not exist.

    Raises:
        GroundedError: if nothing can be saved, `source` can't be read, or `target` can't be
            written.
    """
    source, target = Path(source), Path(target)
    if target.exists():
        raise GroundedError(found("file.exists", str(target)))
    if target.suffix.lower() != ".mcap":
        raise wrong("name of the copy", str(target), like="copy.mcap")
    if not target.parent.is_dir():
        raise GroundedError(found("file.unwritable", str(target), folder=str(target.parent)))
    with open_log(source) as stream:
        size = stream.seek(0, 2)
    if not size:
        raise empty(source)
    try:
        return within(source, size, _recover, source, target)
    except BaseException:
        target.unlink(missing_ok=True)
        raise


def _recover(source: Path, target: Path) -> Recovery:
    with open_log(source) as stream:
        data = mapped(stream)
    head, salvage = data[:HEAD], Salvage(data, str(source))
    try:
        with target.open("xb") as out:
            copy = _Copy(out, compressed=any(name in head for name in COMPRESSED))
            for record in salvage.records():
                copy.add(record)
            copy.finish()
        sync_folder(target.parent)
    except OSError as error:
        raise GroundedError(
            found("file.unwritable", str(target), why=str(error.strerror))
        ) from error
    if not copy.anything:
        raise GroundedError(found("file.no_message", str(source)))
    losses = salvage.losses[:MOST_LOSSES]
    if more := len(salvage.losses) - len(losses):
        losses.append(found("file.lost", more=more))
    if copy.homeless:
        losses.append(found("file.lost", messages=copy.homeless))
    losses += copy.without(salvage.dropped)
    lost = Counter({copy.topic(c): n for c, n in salvage.lost_messages.items()})
    words = tuple(one.sentence for one in losses)
    much = (tuple(losses), salvage.unverified, copy.duration_s, words, not losses)
    return _own(Recovery(target, copy.counts, lost, *much), copy)


def _own(saved: Recovery, copy: _Copy) -> Recovery:
    """Add what was saved of a file written by grounded, in steps."""
    kind = copy.meta.get("format", "")
    if kind != TRIAL:
        return replace(saved, format=kind)
    states, inputs = (saved.messages.get(topic, 0) for topic in ("/state", "/input"))
    return replace(
        saved,
        format=kind,
        candidate=copy.meta.get("candidate", ""),
        steps=max(0, min(states - 1, inputs)),
        planned_steps=_horizon(copy.policy) if copy.policy else None,
        hole=_hole(copy, states),
    )


def _hole(copy: _Copy, states: int) -> bool:
    """Check whether steps are missing among the saved states, from the start on."""
    try:
        start, step = max(int(copy.meta["start_ns"]), 0), float(copy.meta["dt"]) * 1e9
        first, last = copy.span or (start, start)
        return first - start > step / 2 or abs((last - first) / step - (states - 1)) > 0.5
    except (KeyError, ValueError, ZeroDivisionError, OverflowError):
        return True


def _horizon(policy: bytes) -> int | None:
    try:
        return read_candidate(policy, "policy")[0].horizon
    except GroundedError:
        return None


class _Copy:
    """The file that is being written; messages wait until their channel is known."""

    def __init__(self, out: IO[bytes], *, compressed: bool) -> None:
        self.out, self.compressed = out, compressed
        self.writer: McapWriter | None = None
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.numbers: dict[int, int] = {}
        self.waiting: list[Messages] = []
        self.counts: Counter[str] = Counter()
        self.homeless = 0
        self.anything = False
        self.span: tuple[int, int] | None = None  # first and last log time [ns]
        self.meta: dict[str, str] = {}  # our own table, if it has one
        self.policy = b""  # the attached policy of a trial of ours

    def add(self, record: Record) -> None:
        """Takes over a record."""
        if isinstance(record, Header):
            self.start(record)
        elif isinstance(record, Schema):
            self.schemas.setdefault(record.id, record)
        elif isinstance(record, Channel):
            self.channels.setdefault(record.id, record)
        elif isinstance(record, Messages):
            self.messages(record, final=False)
        elif isinstance(record, Metadata):
            self.start().metadata(record.name, record.data)
            self.anything = True
            if record.name == "grounded":
                self.meta = record.data
        elif isinstance(record, Attachment):
            self.start().attachment(**vars(record))
            self.anything = True
            if record.name == "policy":
                self.policy = record.data

    def start(self, header: Header | None = None) -> McapWriter:
        """Return the writer, opened at the first record."""
        if self.writer is None:
            header = header or Header("", "")
            self.writer = McapWriter(self.out, header, compressed=self.compressed)
        return self.writer

    def opened(self, channel: Channel, schema: Schema | None) -> int:
        """Open a channel as it was read; return its number in the copy."""
        writer, about = self.start(), (channel.topic, channel.encoding)
        number = writer.schema(schema.name, schema.encoding, schema.data) if schema else 0
        return writer.channel(*about, number, channel.metadata)

    def messages(self, batch: Messages, *, final: bool) -> None:
        """Write the messages of known channels; keep the others, or count them at the end."""
        for identity in batch.channel_ids():
            own = batch.of(identity)
            channel = self.channels.get(identity)
            schema = self.schemas.get(channel.schema_id) if channel else None
            if channel is None or (schema is None and channel.schema_id):
                if final:
                    self.homeless += len(own)
                else:
                    self.waiting.append(own)
                continue
            if identity not in self.numbers:
                self.numbers[identity] = self.opened(channel, schema)
            self.start().messages(own, self.numbers[identity])
            self.counts[channel.topic] += len(own)
            self.anything = True
            ends = (int(own.log_times.min()), int(own.log_times.max()))
            first, last = self.span or ends
            self.span = (min(first, ends[0]), max(last, ends[1]))

    def topic(self, channel: int) -> str:
        """Return a channel's topic, or its number if the topic is unknown."""
        known = self.channels.get(channel)
        return known.topic if known else f"channel {channel}"

    @property
    def duration_s(self) -> float:
        """Time from the first to the last saved message [s]."""
        return 0.0 if self.span is None else (self.span[1] - self.span[0]) * 1e-9

    def without(self, dropped: Sequence[tuple[int, int]]) -> list[Finding]:
        """Return the time spans of dropped chunks, if plausible: these may be damaged as well."""
        if self.span is None:
            return []
        first, last = self.span
        room = 10 * (last - first)
        sane = [(a, b) for a, b in dropped if first - room <= a <= b <= last + room]
        first = min([first, *(a for a, _ in sane)])
        return [
            found("file.lost", span=f"{1e-9 * (a - first):.2f} to {1e-9 * (b - first):.2f}")
            for a, b in sane
        ]

    def finish(self) -> None:
        """Write the messages kept back, and end the file."""
        waiting, self.waiting = self.waiting, []
        for one in waiting:
            self.messages(one, final=True)
        self.start().finish()


_HEAD = Struct("<BQ")
_SPAN = Struct("<QQ")  # a chunk's first and last time
_NAMES = {1: "the header", 3: "a schema", 4: "a channel", 5: "a message", 6: "a block of messages"}
_NAMES |= {9: "an attached file", 12: "a table of metadata"}
BATCH = 2**22  # [bytes] of messages outside chunks passed on together
CHAIN = 3  # consecutive plausible records after which a place is accepted


class Salvage:
    """One pass over a damaged file.

    Attributes:
        losses: sentences on what was lost.
        lost_messages: messages in dropped chunks by channel, according to the indexes.
        dropped: first and last time stated in each dropped chunk [ns].
        unverified: number of saved messages without a valid checksum.
    """

    def __init__(self, data: Data, name: str) -> None:
        self.data, self.name, self.size = data, name, len(data)
        self.losses: list[Finding] = []
        self.lost_messages: Counter[int] = Counter()
        self.dropped: list[tuple[int, int]] = []
        self.unverified = 0
        self._crc = 0
        self._outside = 0  # messages outside checked chunks, covered only by the data checksum
        self._tables = 0  # metadata and attachments covered only by the data checksum
        self._ended = False  # the data section has ended; only the index follows
        self._pending, self._waiting = list[bytes](), 0  # messages outside chunks; their bytes
        self._defined: dict[tuple[type, int], Schema | Channel] = {}
        self._doubtful: set[int] = set()  # channels with two different definitions

    def records(self) -> Iterator[Record]:
        """Yield what can be saved, in file order."""
        pos = self._first()
        dropped_chunk, before = False, 0  # the record before, 0 after a gap
        while pos is not None and pos < self.size - len(MAGIC):
            end = self._end_of(pos)
            if end is None:
                yield from self._flush()
                after = None if self._is_cut_chunk(pos) else self._next_chain(pos + 1)
                if after is None:
                    yield from self._cut(pos)
                    return
                self.losses.append(found("file.lost", bytes=after - pos, byte=pos))
                pos, before = after, 0
                continue
            opcode, content = self._read(pos, end)
            chunked = before in (CHUNK, MESSAGE_INDEX)  # such a file has none outside
            if opcode == MESSAGE and (chunked or self._ended):
                self.losses.append(found("file.lost", part=_NAMES[MESSAGE], byte=pos))
            elif opcode == MESSAGE:
                yield from self._message(content)
            else:
                yield from self._flush()
                if opcode == FOOTER:
                    self._tail(end)
                    return
                if opcode == MESSAGE_INDEX and dropped_chunk:
                    self._count_lost(content)
                kept = len(self.losses)
                yield from self._record(opcode, content, pos)
                dropped_chunk = opcode == MESSAGE_INDEX and dropped_chunk
                dropped_chunk |= opcode == CHUNK and len(self.losses) > kept
                before = opcode
            pos = end
        yield from self._flush()
        self.losses.append(self._ends_early())

    def _ends_early(self) -> Finding:
        return found("file.cut", byte=self.size, index=int(self._ended))

    def _first(self) -> int | None:
        if self.data[:8] == MAGIC:
            self._crc = zlib.crc32(MAGIC)
            return len(MAGIC)
        self.losses.append(found("file.lost", part="its beginning"))
        return self._next_chain(0)

    def _read(self, pos: int, end: int) -> tuple[int, bytes]:
        record = self.data[pos:end]
        if record[0] == DATA_END:
            self._data_end(record)
        self._crc = zlib.crc32(record, self._crc)
        return record[0], record[9:]

    def _record(self, opcode: int, content: bytes, pos: int) -> Iterator[Record]:
        try:
            if opcode == CHUNK:
                yield from self._chunk(content)
            elif opcode in PARSERS:
                record = PARSERS[opcode](Fields(content))
                self._tables += opcode in (METADATA, ATTACHMENT)
                yield from self._sound(record)
        except BadRecord as error:
            what = _NAMES.get(opcode, f"a record of type {opcode}")
            self.losses.append(found("file.lost", part=what, byte=pos, why=error.finding.what))
            if opcode == CHUNK and len(content) >= 16:
                self.dropped.append(_SPAN.unpack_from(content))

    def _chunk(self, content: bytes) -> Iterator[Record]:
        data, checked = chunk_content(content)
        for record in list(chunk_records(data)):
            if isinstance(record, Messages) and not checked:
                self._outside += len(record)
            yield from self._sound(record)

    def _sound(self, record: Record) -> Iterator[Record]:
        """Yield the record without messages of an ambiguous channel or an invalid time."""
        if isinstance(record, Schema | Channel):
            known = self._defined.setdefault((type(record), record.id), record)
            if known != record:
                self.losses.append(again(known, record).finding)
                self._doubtful |= {
                    c.id
                    for c in self._defined.values()
                    if isinstance(c, Channel) and record.id in (c.id, c.schema_id)
                }
                return
        elif isinstance(record, Messages):
            good = (record.log_times >= 0) & ~np.isin(record.channels, list(self._doubtful))
            if not good.all():
                self.losses.append(found("file.lost", messages=int((~good).sum())))
                record = record.take(good)
        yield record

    def _message(self, content: bytes) -> Iterator[Record]:
        self._pending.append(_HEAD.pack(MESSAGE, len(content)) + content)
        self._waiting += len(content) + 9
        self._outside += 1
        if self._waiting > BATCH:
            yield from self._flush()

    def _flush(self) -> Iterator[Record]:
        if self._pending:
            data = b"".join(self._pending)
            self._pending, self._waiting = [], 0
            yield from self._sound(batch(data, message_positions(data, 0, len(data))[0]))

    def _data_end(self, record: bytes) -> None:
        stated = int.from_bytes(record[9:13], "little")
        wrong = bool(stated) and stated != self._crc
        if wrong and not self.losses and (self._outside or self._tables):
            self.losses.append(found("file.lost", wrong=True, messages=self._outside))
        if self.losses or not stated:
            self.unverified += self._outside
        self._outside, self._ended = 0, True

    def _count_lost(self, content: bytes) -> None:
        try:
            fields = Fields(content)
            channel = fields.uint(16)
            self.lost_messages[channel] += fields.uint(32) // 16
        except BadRecord:
            return

    def _is_cut_chunk(self, pos: int) -> bool:
        """Check whether an intact chunk begins here that is cut off by the end of the file."""
        start = self.data[pos : pos + 9 + 64]
        if len(start) < 49 or start[0] != CHUNK:
            return False
        return is_chunk(start[9:], int.from_bytes(start[1:9], "little"))

    def _end_of(self, pos: int) -> int | None:
        """Return where the record there ends; None if there can't be one."""
        if self.size - pos < 9:
            return None
        opcode, length = _HEAD.unpack_from(self.data, pos)
        end = pos + 9 + int(length)
        short = opcode == MESSAGE and length < MESSAGE_HEADER
        if opcode == 0 or opcode > DATA_END or end > self.size or short:
            return None
        if opcode == CHUNK and not is_chunk(self.data[pos + 9 : pos + 73], int(length)):
            return None
        return end

    @cached_property
    def _places(self) -> Ints:
        """Where a record may begin: an opcode there, and a length below 2^32."""
        octets = np.frombuffer(self.data, dtype=np.uint8)
        count = max(len(octets) - 8, 0)
        maybe = (octets[:count] > 0) & (octets[:count] <= DATA_END)
        for i in range(5, 9):
            maybe &= octets[i : count + i] == 0
        return np.flatnonzero(maybe)

    def _next_chain(self, start: int) -> int | None:
        """Return the first offset from `start` on with a chain of records, None for none."""
        after = self._places[np.searchsorted(self._places, start) :]
        return next((int(at) for at in after if self._is_chain(int(at))), None)

    def _is_chain(self, pos: int) -> bool:
        if self.data[pos] == CHUNK:
            return self._end_of(pos) is not None
        for _ in range(CHAIN):
            end = self._end_of(pos)
            if end is None:
                return False
            if end == self.size - len(MAGIC) and self.data[end:] == MAGIC:
                return True
            pos = end
        return True

    def _cut(self, pos: int) -> Iterator[Record]:
        """Yield the intact parts of the record at `pos`, in which the file ends."""
        rest = self.data[pos:]
        saved = 0
        if len(rest) > 49 and rest[0] == CHUNK:
            for record in self._cut_chunk(rest[9:]):
                saved += len(record) if isinstance(record, Messages) else 0
                yield record
        self.unverified += saved + self._outside
        self.losses.append(self._ends_early())

    def _cut_chunk(self, content: bytes) -> Iterator[Record]:
        try:
            fields = Fields(content)
            fields.skip(16)
            size = fields.uint(64)
            fields.skip(4)
            compression = fields.text()
        except BadRecord:
            return
        data = decompress(compression, content[fields.pos + 8 :], size)[0]
        try:
            for record in list(chunk_records(data, cut=True)):
                yield from self._sound(record)
        except BadRecord:
            return

    def _tail(self, end: int) -> None:
        if self.data[end : end + 9] != MAGIC:
            self.losses.append(found("file.lost", part="its end"))


def is_chunk(start: bytes, length: int) -> bool:
    """Check whether a chunk of this length may start so: its inner lengths are consistent."""
    if len(start) < 40:
        return False
    name = int.from_bytes(start[28:32], "little")
    if name > 8 or start[32 : 32 + name] not in (b"", b"zstd", b"lz4"):
        return False
    return int.from_bytes(start[32 + name : 40 + name], "little") == length - 40 - name
