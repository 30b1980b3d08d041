"""What is in an unknown log: topics, types, rates, and every number with its range.

One pass over the file. A topic with very many messages has its ranges from every k-th of them.

The numbers inside a message type, as the paths that lead to them.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from grounded.errors import GroundedError
from grounded_trials.formats.mcap_records import Channel, Header, Messages, Metadata, Schema
from grounded_trials.formats.mcap_walk import DamagedFile, read_records
from grounded_trials.formats.message_path import is_name, is_topic, parse_path
from grounded_trials.formats.messages import (
    Array,
    BadMessage,
    BadPath,
    BadSchema,
    Dynamic,
    Floats,
    Ints,
    Number,
    Struct,
    Type,
)
from grounded_trials.formats.path_walk import Bound, bind, evaluate, is_time
from grounded_trials.logs.inspect_report import (
    FieldReport,
    LogReport,
    TopicReport,
    find_twins,
    kind_of,
)
from grounded_trials.logs.log_files import log_files, open_log
from grounded_trials.logs.signals import Decoder, decoder_of

NOISE_SAMPLES = 10  # in a batch, to tell a signal's noise
DECODED = 20_000  # messages of a topic whose numbers are looked at


def inspect_log(paths: str | Path | Sequence[str | Path]) -> LogReport:
    """Looks through a log; damage ends the look, and is reported.

    Args:
        paths: an MCAP file, several that follow each other, or the folder of a bag.

    Raises:
        GroundedError: if a file can't be read, or is not MCAP at all.
    """
    files = log_files(paths)
    look = _Look()
    for path in files:
        with open_log(path) as stream:
            look.new_file()
            try:
                for record in read_records(stream, str(path)):
                    look.add(record)
            except DamagedFile as error:
                if not look.headers:
                    raise
                look.damage = str(error)
                break
    return look.report(files)


class _Look:
    """What has been seen so far; topics go on from file to file, channels do not."""

    def __init__(self) -> None:
        self.headers: list[Header] = []
        self.topics: dict[str, _Topic] = {}
        self.damage = ""
        self.meta: dict[str, str] = {}
        self.new_file()

    def new_file(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, _Topic] = {}

    def add(self, record: object) -> None:
        if isinstance(record, Header):
            self.headers.append(record)
        elif isinstance(record, Schema):
            self.schemas[record.id] = record
        elif isinstance(record, Channel):
            known = self.topics.get(record.topic)
            if known is None:
                known = _Topic(record, self.schemas.get(record.schema_id))
                self.topics[record.topic] = known
            self.channels[record.id] = known
        elif isinstance(record, Metadata) and record.name == "grounded":
            self.meta = record.data
        elif isinstance(record, Messages):
            for identity in np.unique(record.channels).tolist():
                if identity in self.channels:
                    self.channels[identity].add(record.take(record.channels == identity))

    def report(self, files: tuple[Path, ...]) -> LogReport:
        times = [t for topic in self.topics.values() for t in topic.log_times]
        joined = np.concatenate(times) if times else np.zeros(1, dtype=np.int64)
        start, end = int(joined.min()), int(joined.max())
        return LogReport(
            files=files,
            library=self.headers[0].library if self.headers else "",
            start_ns=start,
            duration_s=(end - start) * 1e-9,
            messages=sum(topic.count for topic in self.topics.values()),
            topics=tuple(topic.report(start) for topic in self.topics.values()),
            twins=find_twins(self._samples()),
            damage=self.damage,
            meta=self.meta if len(files) == 1 else {},
        )

    def _samples(self) -> dict[str, tuple[Ints, Floats]]:
        found = {}
        for topic in self.topics.values():
            for path, r in topic.ranges.items():
                if r.samples:
                    t, y = (np.concatenate(part) for part in zip(*r.samples, strict=True))
                    found[path] = (t, y)
        return found


@dataclass
class _Range:
    """The values of one path so far."""

    bound: Bound
    low: float = np.inf
    high: float = -np.inf
    count: int = 0
    not_finite: int = 0
    samples: list[tuple[Ints, Floats]] | None = None  # kept where twins may be found
    noises: list[float] = field(default_factory=list)

    def add(self, values: Floats, log_times: Ints) -> None:
        if self.samples is not None:
            self.samples.append((log_times, values))
        finite = values[np.isfinite(values)]
        self.count += len(values)
        self.not_finite += len(values) - len(finite)
        if len(finite) >= NOISE_SAMPLES:
            self.noises.append(_noise(finite))
        if len(finite):
            self.low = min(self.low, float(finite.min()))
            self.high = max(self.high, float(finite.max()))


@dataclass
class _Topic:
    """One topic so far."""

    channel: Channel
    schema: Schema | None
    count: int = 0
    looked: int = 0
    problem: str = ""
    log_times: list[Ints] = field(default_factory=list)
    skews: list[Ints] = field(default_factory=list)
    decoder: Decoder | None = None
    ranges: dict[str, _Range] = field(default_factory=dict)

    def add(self, batch: Messages) -> None:
        self.count += len(batch)
        self.log_times.append(batch.log_times)
        if self.problem or not len(batch):
            return
        stride = 1 + self.looked // DECODED
        chosen = np.zeros(len(batch), dtype=np.bool_)
        chosen[::stride] = True
        self.looked += int(chosen.sum())
        try:
            self._look(batch.take(chosen))
        except (BadSchema, BadMessage, BadPath) as error:
            self.problem = str(error)

    def _look(self, batch: Messages) -> None:
        if self.decoder is None:
            self.decoder = decoder_of(self.channel, self.schema)
            self._find_paths(batch)
        root = self.decoder.root(batch.buffer, batch.starts, batch.ends)
        for i, found in enumerate(self.ranges.values()):
            try:
                values = evaluate(root, found.bound, stamps=i == 0)
            except BadPath:  # behind a wstring, or a text in one JSON message
                continue
            found.add(values.values, batch.log_times[values.rows])
            if values.stamps is not None:
                self.skews.append(values.stamps - batch.log_times[values.rows])

    def _find_paths(self, batch: Messages) -> None:
        assert self.decoder is not None
        sample = None
        if isinstance(self.decoder.type, Dynamic):
            try:
                sample = json.loads(batch.buffer[batch.starts[0] : batch.ends[0]])
            except (ValueError, RecursionError) as error:
                raise BadMessage(0, f"it is not JSON: {error}") from None
        topic = self.channel.topic if is_topic(self.channel.topic) else f'"{self.channel.topic}"'
        for rest in number_paths(self.decoder.type, sample):
            try:
                path = parse_path(topic + rest)
                found = _Range(bind(path, self.decoder.type))
                found.samples = [] if kind_of(path.text) else None
                self.ranges[path.text] = found
            except (GroundedError, BadPath):
                continue

    def report(self, start: int) -> TopicReport:
        t = np.concatenate(self.log_times) if self.log_times else np.zeros(0, dtype=np.int64)
        gaps = np.diff(np.sort(t)) * 1e-9
        low, high = np.percentile(gaps, [5, 95]) if len(gaps) else (0.0, 0.0)
        median = float(np.median(gaps)) if len(gaps) else 0.0
        skews = np.concatenate(self.skews) if self.skews else None
        stamped = any(found.bound.stamp is not None for found in self.ranges.values())
        return TopicReport(
            topic=self.channel.topic,
            type=self.schema.name if self.schema else "",
            encoding=self.channel.encoding,
            messages=self.count,
            rate_hz=1 / median if median > 0 else 0.0,
            jitter_s=float(high - low) / 2,
            largest_gap_s=float(gaps.max(initial=0.0)),
            first_s=float(t.min() - start) * 1e-9 if len(t) else None,
            last_s=float(t.max() - start) * 1e-9 if len(t) else None,
            stamped=stamped or bool(skews is not None and len(skews)),
            skew_s=float(np.median(skews)) * 1e-9 if skews is not None and len(skews) else None,
            fields=tuple(_field(path, r) for path, r in self.ranges.items() if r.count),
            problem=self.problem,
        )


def _field(path: str, found: _Range) -> FieldReport:
    none = found.low > found.high
    return FieldReport(
        path=path,
        low=None if none else found.low,
        high=None if none else found.high,
        not_finite=found.not_finite,
        noise=float(np.median(found.noises)) if found.noises else 0.0,
    )


def _noise(values: Floats) -> float:
    """Deviation of white noise on a smooth signal, from its second differences; outliers aside."""
    return float(np.median(np.abs(np.diff(values, 2))) / (0.6745 * np.sqrt(6)))


FIELD_LIMIT = 200  # paths of one topic
ITEM_LIMIT = 12  # items of a list that are named one by one
DEPTH_LIMIT = 12
VISIT_LIMIT = 20_000  # parts of a type that are looked at; a hostile one has no end
QUATERNION = ("x", "y", "z", "w")


def number_paths(type: Type, sample: Any = None) -> list[str]:
    """Paths (without the topic) to the numbers of a type, quaternions also as angles.

    Args:
        type: of the messages.
        sample: one parsed message, where only it tells the type (JSON).
    """
    found: list[str] = []
    patience = iter(range(VISIT_LIMIT))
    walk = _of_value(sample, 0) if isinstance(type, Dynamic) else _of_type(type, 0, patience)
    for path in walk:
        found.append(path)
        if len(found) >= FIELD_LIMIT:
            break
    return found


def _of_type(type: Type, depth: int, patience: Iterator[int]) -> Iterator[str]:
    if depth > DEPTH_LIMIT or next(patience, None) is None:
        return
    if isinstance(type, Number):
        yield ""
    elif isinstance(type, Array):
        count = ITEM_LIMIT if type.count is None else type.count
        if count <= ITEM_LIMIT:
            for i in range(count if isinstance(type.item, Number) else 1):
                for rest in _of_type(type.item, depth + 1, patience):
                    yield f"[{i}]{rest}"
    elif isinstance(type, Struct) and not is_time(type):
        if tuple(type.by_name) == QUATERNION:
            yield from (f".@rpy.{angle}" for angle in ("roll", "pitch", "yaw"))
        for field in type.fields:
            for rest in _of_type(field.type, depth + 1, patience):
                yield f".{_spell(field.name)}{rest}"


def _of_value(value: Any, depth: int) -> Iterator[str]:
    if depth > DEPTH_LIMIT:
        return
    if isinstance(value, int | float):
        yield ""
    elif isinstance(value, list):
        for i, item in enumerate(value[:ITEM_LIMIT]):
            for rest in _of_value(item, depth + 1):
                yield f"[{i}]{rest}"
    elif isinstance(value, dict):
        if set(value) == set(QUATERNION):
            yield from (f".@rpy.{angle}" for angle in ("roll", "pitch", "yaw"))
        for name, inner in value.items():
            if name and '"' not in name:
                for rest in _of_value(inner, depth + 1):
                    yield f".{_spell(name)}{rest}"


def _spell(name: str) -> str:
    return name if is_name(name) else f'"{name}"'
