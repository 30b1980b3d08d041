"""Recover a damaged log: write what can be saved to a new file, and report what was lost.

The file is read record by record. A chunk with a wrong checksum is dropped entirely, since its
wrong numbers can't be located; the message indexes after it show what it contained. Of a chunk cut
off by the end of the file, the messages before the cut are kept. Schemas and channels are taken
from anywhere in the file, including the summary.

Each record states where the next one starts: behind one whose length is damaged nothing is saved.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from struct import Struct
from typing import Any

import numpy as np

from grounded.checks import refused, wrong
from grounded.findings import Finding, found
from grounded.result import UNSAID, Document
from grounded_trials.formats.bad import BadRecord
from grounded_trials.formats.mcap_records import (
    MAGIC,
    MESSAGE_HEADER,
    PARSERS,
    RECORD_HEAD,
    Attachment,
    Channel,
    Fields,
    Header,
    Messages,
    Metadata,
    Op,
    Record,
    Schema,
    batch,
    chunk_content,
    decompress,
    record_name,
)
from grounded_trials.formats.mcap_walk import Data, again, chunk_records, mapped, message_positions
from grounded_trials.formats.mcap_writer import McapWriter
from grounded_trials.logs.log_paths import empty, open_log
from grounded_trials.store.store import sync_folder
from grounded_trials.within import within

MOST_LOSSES = 50  # number of losses listed
HEAD = 2**20  # [bytes] at the beginning of a log, in which its first chunk begins
COMPRESSED = (b"\4\0\0\0zstd", b"\3\0\0\0lz4")  # a chunk's; then the copy is compressed, too


@dataclass(frozen=True, eq=False)
class Recovery(Document):
    """What was saved, and what was lost."""

    file: Path
    messages: Mapping[str, int]  # saved, by topic
    lost_messages: Mapping[str, int]  # known to be lost, by topic
    findings: tuple[Finding, ...]  # what was lost; empty if the file was not damaged
    duration_s: float  # from the first to the last saved message
    losses: tuple[str, ...]  # the findings in words
    complete: bool  # nothing was lost
    format: str = field(metadata=UNSAID, default="")  # of a file that grounded wrote


def recover_log(source: str | Path, target: str | Path) -> Recovery:
    """Write what can be saved of a log to a new file; refuse if that is nothing."""
    source, target = Path(source), Path(target)
    if target.exists():
        raise refused("file.exists", target)
    if target.suffix.lower() != ".mcap":
        raise wrong("name of the copy", str(target), like="copy.mcap")
    if not target.parent.is_dir():
        raise refused("file.unwritable", target, folder=str(target.parent))
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

    # What is defined anywhere in the file, also after its messages.
    channels, schemas = dict[int, Channel](), dict[int, Schema]()
    for record in Salvage(data).records():
        if isinstance(record, Channel):
            channels.setdefault(record.id, record)
        elif isinstance(record, Schema):
            schemas.setdefault(record.id, record)

    # The copy.
    salvage, meta, ends, homeless = Salvage(data), dict[str, str](), list[int](), 0
    saved, numbers, anything = Counter[str](), dict[int, int](), False
    try:
        with target.open("xb") as out:
            packed = any(name in data[:HEAD] for name in COMPRESSED)
            copy: McapWriter | None = None
            for record in salvage.records():
                header = record if isinstance(record, Header) else Header("", "")
                copy = copy or McapWriter(out, header, compressed=packed)
                anything |= isinstance(record, Metadata | Attachment | Messages)
                if isinstance(record, Metadata):
                    copy.metadata(record.name, record.data)
                    meta = record.data if record.name == "grounded" else meta
                elif isinstance(record, Attachment):
                    copy.attachment(**vars(record))
                for own in _by_channel(record):
                    channel = channels.get(identity := int(own.channels[0]))
                    schema = schemas.get(channel.schema_id) if channel else None
                    if channel is None or (schema is None and channel.schema_id):
                        homeless += len(own)
                        continue
                    if identity not in numbers:
                        numbers[identity] = _opened(copy, channel, schema)
                    copy.messages(own, numbers[identity])
                    saved[channel.topic] += len(own)
                    ends += [int(own.log_times.min()), int(own.log_times.max())]
            if copy is not None:
                copy.finish()
        sync_folder(target.parent)
    except OSError as error:
        raise refused("file.unwritable", target, why=str(error.strerror)) from error
    if not anything:
        raise refused("file.no_message", source)

    # What was lost.
    losses = salvage.losses[:MOST_LOSSES]
    if more := len(salvage.losses) - len(losses):
        losses.append(found("file.lost", more=more))
    if homeless:
        losses.append(found("file.lost", messages=homeless))
    first, last = min(ends, default=0), max(ends, default=0)
    room = 10 * (last - first)  # the times of dropped chunks may be damaged as well
    spans = [(a, b) for a, b in salvage.dropped if first - room <= a <= b <= last + room]
    begin = min([first, *(a for a, _ in spans)])
    for a, b in spans:
        span = f"{1e-9 * (a - begin):.2f} to {1e-9 * (b - begin):.2f}"
        losses.append(found("file.lost", span=span))
    return Recovery(
        file=target,
        messages=saved,
        lost_messages={
            channels[c].topic if c in channels else f"channel {c}": n
            for c, n in salvage.lost_messages.items()
        },
        findings=tuple(losses),
        duration_s=(last - first) * 1e-9,
        losses=tuple(one.sentence for one in losses),
        complete=not losses,
        format=meta.get("format", ""),
    )


def _by_channel(record: Record) -> list[Messages]:
    """Return the messages of a record, of one channel each; [] of another record."""
    if not isinstance(record, Messages):
        return []
    return [record.of(identity) for identity in record.channel_ids()]


def _opened(copy: McapWriter, channel: Channel, schema: Schema | None) -> int:
    """Open a channel as it was read; return its number in the copy."""
    number = copy.schema(schema.name, schema.encoding, schema.data) if schema else 0
    return copy.channel(channel.topic, channel.encoding, number, channel.metadata)


_SPAN = Struct("<QQ")  # a chunk's first and last time


class Salvage:
    """One pass over a damaged file, up to the first record whose head can't be one."""

    def __init__(self, data: Data) -> None:
        self.data, self.size = data, len(data)
        self.losses: list[Finding] = []
        self.lost_messages: Counter[int] = Counter()  # in dropped chunks, as the indexes say
        self.dropped: list[tuple[int, int]] = []  # first and last time that each states [ns]
        self._outside = 0  # messages outside checked chunks, covered only by the data checksum
        self._tables = 0  # metadata and attachments covered only by it
        self._ended = False  # the data section has ended; only the index follows
        self._defined: dict[tuple[type, int], Schema | Channel] = {}
        self._doubtful: set[int] = set()  # channels with two different definitions

    def records(self) -> Iterator[Record]:
        """Yield what can be saved, in file order."""
        if self.data[:8] != MAGIC:
            self._lose(part="its beginning")
        pos, before, dropped_chunk = len(MAGIC), 0, False  # the kind of the record before
        while (stop := self._end_of(pos)) is not None:
            opcode, content, kept = self.data[pos], self.data[pos + 9 : stop], len(self.losses)
            if opcode == Op.MESSAGE and (self._ended or before in (Op.CHUNK, Op.MESSAGE_INDEX)):
                self._lose(part=record_name(Op.MESSAGE), byte=pos)
            elif opcode == Op.MESSAGE:  # a run of messages outside chunks
                while (further := self._end_of(stop)) and self.data[stop] == Op.MESSAGE:
                    stop = further
                run = self.data[pos:stop]
                positions = message_positions(run, 0, len(run))[0]
                self._outside += len(positions)
                yield from self._sound(batch(run, positions))
            elif opcode == Op.FOOTER:
                if self.data[stop : stop + 9] != MAGIC:
                    self._lose(part="its end")
                return
            else:
                if opcode == Op.DATA_END:
                    self._data_end(pos, content)
                elif opcode == Op.MESSAGE_INDEX and dropped_chunk and len(content) >= 6:
                    channel, size = Struct("<HI").unpack_from(content)
                    self.lost_messages[channel] += size // 16
                yield from self._record(opcode, content, pos)
                dropped_chunk &= opcode == Op.MESSAGE_INDEX
                dropped_chunk |= opcode == Op.CHUNK and len(self.losses) > kept
                before = opcode
            pos = stop
        yield from self._cut(self.data[pos:])
        if self.data[-len(MAGIC) :] == MAGIC:  # the file is whole, the record's head is not
            self._lose(bytes=self.size - pos, byte=pos)
        else:
            self.losses.append(found("file.cut", byte=self.size, index=int(self._ended)))

    def _lose(self, **facts: Any) -> None:
        self.losses.append(found("file.lost", **facts))

    def _record(self, opcode: int, content: bytes, pos: int) -> Iterator[Record]:
        try:
            if opcode == Op.CHUNK:
                data, checked = chunk_content(content)
                for record in list(chunk_records(data)):
                    if isinstance(record, Messages) and not checked:
                        self._outside += len(record)
                    yield from self._sound(record)
            elif opcode in PARSERS:
                self._tables += opcode in (Op.METADATA, Op.ATTACHMENT)
                yield from self._sound(PARSERS[opcode](Fields(content)))
        except BadRecord as error:
            self._lose(part=record_name(opcode), byte=pos, why=error.finding.what)
            if opcode == Op.CHUNK and len(content) >= 16:
                self.dropped.append(_SPAN.unpack_from(content))

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
                self._lose(messages=int((~good).sum()))
                record = record.take(good)
            if not len(record):
                return
        yield record

    def _data_end(self, pos: int, content: bytes) -> None:
        stated, self._ended = int.from_bytes(content[:4], "little"), True
        wrong = bool(stated) and stated != zlib.crc32(memoryview(self.data)[:pos])
        if wrong and not self.losses and (self._outside or self._tables):
            self._lose(wrong=True, messages=self._outside)

    def _end_of(self, pos: int) -> int | None:
        """Return where the record there ends; None if there can't be one."""
        if self.size - pos < 9:
            return None
        opcode, length = RECORD_HEAD.unpack_from(self.data, pos)
        end = pos + 9 + int(length)
        short = opcode == Op.MESSAGE and length < MESSAGE_HEADER
        return None if opcode == 0 or opcode > Op.DATA_END or end > self.size or short else end

    def _cut(self, rest: bytes) -> Iterator[Record]:
        """Yield the intact parts of the record in which the file ends."""
        if len(rest) > 49 and rest[0] == Op.CHUNK:
            with suppress(BadRecord):
                fields = Fields(rest[9 + 16 :])
                size, _, compression = fields.uint(64), fields.skip(4), fields.text()
                packed = fields.content[fields.pos + 8 :]
                data = decompress(compression, bytes(packed), size)[0]
                for record in list(chunk_records(data, cut=True)):
                    yield from self._sound(record)
