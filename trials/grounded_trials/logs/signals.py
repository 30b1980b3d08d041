"""Read signals from logs: for each name the samples at its message path, in file order.

All signals are read in one pass over the files, and only the fields in the paths are decoded.
Whatever the encoding (cdr, ros1, protobuf, json), a message gives one number or none, and three
times: when it was logged, when it was published, and its header's stamp.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from grounded.checks import near, refused
from grounded.errors import GroundedError, NextCommand
from grounded.findings import found
from grounded_trials.formats.bad import Bad, BadMessage, BadPath, BadSchema
from grounded_trials.formats.cdr import cdr_messages, ros1_messages
from grounded_trials.formats.mcap_records import Channel, Messages, Schema
from grounded_trials.formats.message_path import MessagePath, parse_path
from grounded_trials.formats.messages import (
    Dynamic,
    Floats,
    Ints,
    Node,
    Struct,
    Type,
    json_messages,
)
from grounded_trials.formats.path_walk import Bound, Values, bind, evaluate
from grounded_trials.formats.protobuf import message_class, protobuf_messages
from grounded_trials.formats.schemas import struct_of
from grounded_trials.formats.tables import AS_IT_SAYS, Layout
from grounded_trials.logs.log_files import log_records, read_apart

Clock = Literal["header", "log", "publish"]
TOPICS_NAMED = 8  # topics of a log that are all named where one is missing
JSON_PIECE = 2**20  # [bytes] of JSON parsed at once, at least one message


@dataclass(frozen=True)
class SignalSpec:
    """Where a signal is in a log, and how its samples become values.

    value = scale * number + offset, at stamp - delay_s. Between samples it is interpolated
    ("linear") or held ("hold"); None: linear for states, held for inputs. A gap of more than
    max_age_s is refused; None: the limit depends on the signal's rate, see `Samples.max_gap`.
    """

    path: str
    clock: Clock = "header"
    unwrap: bool = False
    scale: float = 1.0
    offset: float = 0.0
    delay_s: float = 0.0
    max_age_s: float | None = None
    resample: Literal["linear", "hold"] | None = None
    before: float | None = None  # an input's value until its first sample


@dataclass(frozen=True, eq=False)
class Series:
    """A signal's raw samples: numbers as logged, before scale and offset, in file order."""

    spec: SignalSpec
    t: Ints  # (N,) stamp on the spec's clock [ns]
    values: Floats  # (N,)
    log_times: Ints  # (N,) [ns]
    messages: int  # number of messages of its topic, with this number or not
    type: str  # of the topic's messages
    stamped: bool  # the messages have a header stamp, used as the clock or not

    @cached_property
    def skew_s(self) -> float | None:
        """By how much its stamps are behind (ahead) of the log's own times [s]; None for these."""
        if self.spec.clock == "log":
            return None
        return float(np.median(self.t - self.log_times)) * 1e-9


def read_signals(
    paths: str | Path | Sequence[str | Path],
    specs: Mapping[str, SignalSpec],
    layout: Layout = AS_IT_SAYS,
) -> dict[str, Series]:
    """Read signals from a log: a file, files in order, or the folder of a bag.

    Args:
        paths: a log of any format, several in order, or a folder with them.
        specs: what to read, by name.
        layout: the names and the rate of a table that does not say them.

    Raises:
        GroundedError: for a damaged file, a missing topic or field, a message with more than one
            value for a signal, or a clock that a topic does not have.
    """
    return read_apart(paths, _read_signals, specs, layout)


def _read_signals(
    files: tuple[Path, ...], specs: Mapping[str, SignalSpec], layout: Layout
) -> dict[str, Series]:
    collectors = {name: _Collector(name, spec) for name, spec in specs.items()}
    for path in files:
        log = _Log(str(path), list(collectors.values()))
        for record in log_records(path, layout):
            if isinstance(record, Schema):
                log.schemas[record.id] = record
            elif isinstance(record, Channel):
                log.channel(record)
            elif isinstance(record, Messages):
                log.messages(record)
        for collector in collectors.values():
            collector.topics |= set(log.topics)
    _refuse_missing(collectors, str(files[0]))
    return {name: collector.series() for name, collector in collectors.items()}


def _refuse_missing(collectors: Mapping[str, _Collector], file: str) -> None:
    """Name all signals of the first topic that the log does not have."""
    missing = {name: one for name, one in collectors.items() if not one.type}
    if not missing:
        return
    first = next(iter(missing.values()))
    topic, known = first.path.topic, sorted(first.topics)
    names = tuple(name for name, one in missing.items() if one.path.topic == topic)
    few = 0 < len(known) <= TOPICS_NAMED  # the nearest name may be another's: /left for /port
    others = {"known": tuple(known)} if few else near(topic, known)
    then = NextCommand("inspect", (file,))
    facts: dict[str, Any] = {"kind": "topic", "of": Path(file).name, "where": ", ".join(names)}
    raise refused("given.name", topic, **facts, then=then, **others)


class _Log:
    """One file while it is read: its schemas, and which channel feeds which signals."""

    def __init__(self, name: str, collectors: list[_Collector]) -> None:
        self.name, self.collectors = name, collectors
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.topics: dict[str, str] = {}
        self.wanted: dict[int, tuple[Decoder, list[_Collector]]] = {}

    def channel(self, channel: Channel) -> None:
        if channel.id in self.channels:
            return
        self.channels[channel.id] = channel
        schema = self.schemas.get(channel.schema_id)
        self.topics[channel.topic] = schema.name if schema else channel.encoding
        wanting = [c for c in self.collectors if c.path.topic == channel.topic]
        if wanting:
            collector = wanting[0]
            try:
                decoder = decoder_of(channel, schema)
                for collector in wanting:
                    collector.bind(decoder)
            except (BadSchema, BadPath) as error:
                raise self._misfit(channel, collector, error) from None
            self.wanted[channel.id] = (decoder, wanting)

    def messages(self, batch: Messages) -> None:
        present = batch.channel_ids()
        unknown = [c for c in present if c not in self.channels]
        if unknown:
            then = NextCommand("recover", (self.name,))
            raise GroundedError(
                found("file.damaged", self.name, where=f"channel {unknown[0]}", then=then)
            )
        for identity, (decoder, wanting) in self.wanted.items():
            if identity not in present:
                continue
            for part in decoder.parts(batch.of(identity)):
                self._collect(decoder, wanting, part, self.channels[identity])

    def _collect(
        self, decoder: Decoder, wanting: list[_Collector], own: Messages, channel: Channel
    ) -> None:
        collector = wanting[0]
        try:
            root = decoder.root(own.buffer, own.starts, own.ends)
            for collector in wanting:
                collector.collect(root, decoder, own)
        except BadMessage as error:
            at = float(own.log_times[error.message]) * 1e-9
            raise self._misfit(channel, collector, error, at) from None
        except BadPath as error:
            raise self._misfit(channel, collector, error) from None

    def _misfit(
        self, channel: Channel, collector: _Collector, error: Bad, at: float | None = None
    ) -> GroundedError:
        facts: dict[str, Any] = {
            "topic": channel.topic,
            "type": self.topics[channel.topic],
            "why": error.finding.what,
            "at": at,
        }
        facts |= {"file": self.name, "path": collector.path.text}
        return GroundedError(found("file.signal", collector.name, **facts))


@dataclass(frozen=True, eq=False)
class Decoder:
    """Decodes a channel's messages into the nodes that message paths are evaluated on."""

    topic: str
    name: str  # of the message type
    type: Type
    root: Callable[[bytes, Ints, Ints], Node] = field(repr=False)

    def parts(self, batch: Messages) -> Iterator[Messages]:
        """Split a batch into pieces to decode at once, since parsed messages take much memory."""
        parsed = isinstance(self.type, Dynamic) or getattr(self.type, "definition", None)
        if not parsed or not len(batch):
            yield batch
            return
        piece = np.cumsum(batch.ends - batch.starts) // JSON_PIECE
        for number in np.unique(piece):
            yield batch.take(piece == number)


_READERS: dict[str, Callable[[bytes, Struct, Ints, Ints], Node]] = {
    "cdr": cdr_messages,
    "ros1": ros1_messages,
    "protobuf": protobuf_messages,
}


def decoder_of(channel: Channel, schema: Schema | None) -> Decoder:
    """Return the decoder of a channel.

    Raises:
        BadSchema: if its encoding is not one of cdr, ros1, protobuf, json, or its schema is bad.
    """
    encoding, name = channel.encoding, schema.name if schema else ""
    if encoding == "json":
        return Decoder(channel.topic, name or "json", Dynamic(), json_messages)
    if encoding not in _READERS:
        raise BadSchema("decode", what="encoding", at=encoding)
    if schema is None:
        raise BadSchema("decode", what="schema", at=encoding)
    type, read = struct_of(schema), _READERS[encoding]
    if encoding == "protobuf":
        message_class(schema.data, schema.name)
    return Decoder(channel.topic, name, type, lambda b, s, e: read(b, type, s, e))


class _Collector:
    """Gathers the samples of one signal."""

    def __init__(self, name: str, spec: SignalSpec) -> None:
        self.name, self.spec = name, spec
        self.path: MessagePath = parse_path(spec.path)
        self.bound: dict[int, Bound] = {}
        self.parts: list[tuple[Ints, Floats, Ints]] = []
        self.messages = 0
        self.type, self.stamped = "", False
        self.topics: set[str] = set()

    def bind(self, decoder: Decoder) -> None:
        bound = bind(self.path, decoder.type)
        self.bound[id(decoder)] = bound
        self.type, self.stamped = decoder.name, bound.stamp is not None
        dynamic = isinstance(decoder.type, Dynamic)
        if self.spec.clock == "header" and not self.stamped and not dynamic:
            raise BadPath("decode", what="header stamp")

    def collect(self, root: Node, decoder: Decoder, batch: Messages) -> None:
        self.messages += len(batch)
        values = evaluate(root, self.bound[id(decoder)], self.spec.clock == "header")
        if len(values.rows) > 1 and (np.diff(values.rows) == 0).any():
            at = int(values.rows[np.argmax(np.diff(values.rows) == 0)])
            raise BadPath("path", expected="one value", at=f"{batch.log_times[at] * 1e-9:.3f} s")
        self.parts.append((self._times(batch, values), values.values, batch.log_times[values.rows]))

    def _times(self, batch: Messages, values: Values) -> Ints:
        if self.spec.clock == "log":
            return batch.log_times[values.rows]
        if self.spec.clock == "publish":
            times = batch.publish_times[values.rows]
            if (times < 0).any():
                raise BadMessage(
                    values.rows[np.argmax(times < 0)], "decode", what="stamp", at="2262"
                )
            return times
        if values.stamps is None:
            raise BadPath("decode", what="header stamp")
        return values.stamps

    def series(self) -> Series:
        columns = [np.concatenate(part) for part in zip(*self.parts, strict=True)]
        if not columns or not len(columns[0]):
            facts: dict[str, Any] = {
                "path": self.path.text,
                "topic": self.path.topic,
                "messages": self.messages,
            }
            raise GroundedError(found("file.signal", self.name, **facts))
        t, values, log_times = columns
        return Series(self.spec, t, values, log_times, self.messages, self.type, self.stamped)
