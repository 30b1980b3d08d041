"""What can be saved of a damaged log, written as a good one; and what was lost.

The file is walked record by record. A chunk whose checksum fails is dropped whole, since nobody
knows which of its numbers are wrong; the message indexes that follow it tell what it held. A chunk
that the end of the file cuts through gives the messages that lie wholly before the cut. Where the
chain of records itself is broken, the next place is looked for from which it holds again. Schemas
and channels are taken from wherever they still stand, the summary included.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from grounded.errors import GroundedError
from grounded_trials.log_files import open_log
from grounded_trials.mcap_records import (
    Attachment,
    Channel,
    Header,
    Messages,
    Metadata,
    Record,
    Schema,
)
from grounded_trials.mcap_writer import LIBRARY, CopyWriter
from grounded_trials.recover_salvage import Salvage
from grounded_trials.store import sync_folder


@dataclass(frozen=True)
class Recovery:
    """What was saved, what was not, and what of it no checksum vouches for."""

    source: Path
    target: Path
    messages: Mapping[str, int]  # saved, by topic
    lost_messages: Mapping[str, int]  # known to be lost, by topic
    losses: tuple[str, ...]  # sentences; empty: the file was not damaged
    unverified: int  # saved messages without a checksum that fits

    @property
    def complete(self) -> bool:
        """Whether nothing was lost and everything saved is known to be right."""
        return not self.losses


def recover_log(source: str | Path, target: str | Path) -> Recovery:
    """Writes what can be saved of a log to a new file.

    Args:
        source: the damaged file; it is not changed.
        target: the file to write; it must not exist.

    Raises:
        GroundedError: if nothing can be saved, `source` can't be read, or `target` not be written.
    """
    source, target = Path(source), Path(target)
    if target.exists():
        raise GroundedError(f"{target} exists already; name a file that does not")
    with open_log(source) as stream:
        salvage = Salvage(stream, str(source))
        try:
            with target.open("xb") as out:
                copy = _Copy(out)
                for record in salvage.records():
                    copy.add(record)
                copy.finish()
            sync_folder(target.parent)
        except OSError as error:
            target.unlink(missing_ok=True)
            raise GroundedError(f"{target} can't be written: {error.strerror}") from None
    if not copy.anything:
        target.unlink()
        why = salvage.losses[0] if salvage.losses else "it is a log without messages"
        raise GroundedError(f"{source}: nothing can be saved; {why}")
    losses = list(salvage.losses)
    if copy.homeless:
        losses.append(f"{copy.homeless} messages belong to channels whose definition is lost")
    lost = Counter({copy.topic(c): n for c, n in salvage.lost_messages.items()})
    return Recovery(source, target, copy.counts, lost, tuple(losses), salvage.unverified)


class _Copy:
    """The file that is being written; messages wait until their channel is known."""

    def __init__(self, out: IO[bytes]) -> None:
        self.out = out
        self.writer: CopyWriter | None = None
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.numbers: dict[int, int] = {}
        self.waiting: list[Messages] = []
        self.counts: Counter[str] = Counter()
        self.homeless = 0
        self.anything = False

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
            self.start().metadata(record)
            self.anything = True
        elif isinstance(record, Attachment):
            self.start().attachment(record)
            self.anything = True

    def start(self, header: Header | None = None) -> CopyWriter:
        """The writer, opened at the first record."""
        if self.writer is None:
            header = header or Header("", "")
            compressed = not header.library.startswith(LIBRARY)
            self.writer = CopyWriter(self.out, header, compressed=compressed)
        return self.writer

    def messages(self, batch: Messages, *, final: bool) -> None:
        """Writes the messages of known channels, keeps or counts the others."""
        for identity in np.unique(batch.channels).tolist():
            own = batch.take(batch.channels == identity)
            channel = self.channels.get(identity)
            schema = self.schemas.get(channel.schema_id) if channel else None
            if channel is None or (schema is None and channel.schema_id):
                if final:
                    self.homeless += len(own)
                else:
                    self.waiting.append(own)
                continue
            if identity not in self.numbers:
                self.numbers[identity] = self.start().channel(channel, schema)
            self.start().messages(own, self.numbers[identity])
            self.counts[channel.topic] += len(own)
            self.anything = True

    def topic(self, channel: int) -> str:
        """The name of a channel's topic, if it is known."""
        known = self.channels.get(channel)
        return known.topic if known else f"channel {channel}"

    def finish(self) -> None:
        """Writes what waited, and ends the file."""
        waiting, self.waiting = self.waiting, []
        for batch in waiting:
            self.messages(batch, final=True)
        self.start().finish()
