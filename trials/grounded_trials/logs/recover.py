"""Recover a damaged log: write what can be saved to a new file, and report what was lost.

The file is read record by record. A chunk with a wrong checksum is dropped entirely, since its
wrong numbers can't be located; the message indexes after it show what it contained. Of a chunk cut
off by the end of the file, the messages before the cut are kept. Where the chain of records is
broken, the next place is sought from which it is intact. Schemas and channels are taken from
anywhere in the file, including the summary.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, Any

from grounded.checks import wrong
from grounded.errors import GroundedError
from grounded.findings import Finding, found
from grounded.result import UNSAID, Document
from grounded_trials.formats.mcap_records import (
    Attachment,
    Channel,
    Header,
    Messages,
    Metadata,
    Record,
    Schema,
)
from grounded_trials.formats.mcap_walk import mapped
from grounded_trials.formats.mcap_writer import McapWriter
from grounded_trials.logs.log_files import empty, open_log
from grounded_trials.logs.salvage import Salvage
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
        for batch in waiting:
            self.messages(batch, final=True)
        self.start().finish()
