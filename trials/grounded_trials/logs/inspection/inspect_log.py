"""Summarise an unknown log: topics, types, rates, and every number with its range.

The files are read once; for topics with very many messages, ranges come from every k-th message.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from grounded.errors import GroundedError
from grounded.findings import Finding, Quantity, Weight, found
from grounded.units import factor_between
from grounded_trials.formats.bad import Bad, BadPath
from grounded_trials.formats.mcap_records import About, Header, Messages, Metadata, Rows
from grounded_trials.formats.mcap_walk import DamagedFile, Part, Topic, by_topic
from grounded_trials.formats.message_path import MessagePath, is_topic, parse_path
from grounded_trials.formats.messages import (
    Decoded,
    Decoder,
    Floats,
    Ints,
    decoder_of,
    fields_of,
    names_in,
)
from grounded_trials.formats.path_walk import FIELD_LIMIT, evaluate, number_paths
from grounded_trials.formats.tables import AS_IT_SAYS, Layout
from grounded_trials.logs.log_files import log_records, read_apart
from grounded_trials.logs.samples import MIXED_S
from grounded_trials.logs.signal_report import SKEW_S
from grounded_trials.logs.signals import Clock
from grounded_trials.logs.stated_units import unit_in_name

NAMING = {  # types of messages that name joints, and their field
    "/JointState": "name",
    "/JointTrajectoryControllerState": "joint_names",
}
NOISE_SAMPLES = 10  # samples of a batch needed to estimate the noise
DECODED = 20_000  # decoded messages of a topic beyond which messages are skipped
GAP = 10.0  # intervals; longer gaps are reported


@dataclass(frozen=True)
class FieldReport:
    """A number in a topic's messages."""

    path: str
    low: float | None  # smallest and largest finite value; None if there is none
    high: float | None
    not_finite: int
    noise: float = 0.0  # standard deviation of the white noise
    held: float = 0.0  # share of nonzero samples that repeat the one before


@dataclass(frozen=True)
class TopicReport:
    """A topic: timing and contents of its messages."""

    topic: str
    type: str
    encoding: str
    messages: int
    rate_hz: float  # 1 / median interval of the log times; 0 for fewer than two messages
    jitter_s: float  # half the width that holds 90 % of the intervals
    largest_gap_s: float
    first_s: float | None  # after the log's first message; None without messages
    last_s: float | None
    stamped: bool  # messages have a header stamp
    skew_s: float | None  # median of header stamp minus log time
    fields: tuple[FieldReport, ...]
    problem: str = ""  # why its numbers can't be read


@dataclass(frozen=True)
class LogReport:
    """A log: its files, its length, its topics, and whether it is damaged."""

    files: tuple[Path, ...]
    library: str  # that wrote it
    start_ns: int
    duration_s: float
    messages: int
    topics: tuple[TopicReport, ...]
    damage: Finding | None = None  # where reading it ended early, and why
    meta: Mapping[str, str] = field(default_factory=dict)  # metadata, if grounded wrote the file
    joints: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # names that topics give
    layout: Layout = AS_IT_SAYS  # what was said of its table
    about: tuple[About, ...] = ()  # what its files say of their tables

    def unit(self, path: str) -> str:
        """Return the unit of a number that a table's first row or the name states, "" for none."""
        heads = self.about[0].units if self.about else {}
        return heads.get(path) or unit_in_name(path)

    def factor(self, path: str, wanted: str) -> float:
        """Return the factor from the unit that it states to another; 1 if it states none."""
        found = factor_between(said, wanted) if (said := self.unit(path)) else None
        return 1.0 if found is None else found

    @property
    def numbers(self) -> list[FieldReport]:
        """The numbers of all topics."""
        return [field for topic in self.topics for field in topic.fields]

    @property
    def simulated(self) -> bool:
        """Whether header stamps are on another clock than the log, as in a simulation."""
        return any(t.skew_s is not None and abs(t.skew_s) > MIXED_S for t in self.topics)

    def topic_of(self, path: str) -> TopicReport | None:
        """Return the topic that a path begins with, None if the log has none."""
        begins = [t for t in self.topics if path.strip('"').startswith(t.topic)]
        return max(begins, key=lambda topic: len(topic.topic), default=None)

    def number(self, path: str) -> FieldReport | None:
        """Return the number at a path, None if it is not in the log."""
        return self._by_path.get(path)

    @cached_property
    def _by_path(self) -> dict[str, FieldReport]:
        return {one.path: one for one in self.numbers}

    def clock(self, topic: TopicReport | None) -> Clock:
        """Return the clock by which a topic's numbers are read."""
        return "header" if topic is not None and topic.stamped and not self.simulated else "log"

    @property
    def moving(self) -> list[str]:
        """Paths of the numbers that take more than one value."""
        return [field.path for field in self.numbers if field.low != field.high]

    @cached_property
    def findings(self) -> tuple[Finding, ...]:
        """What is odd about the log, besides its damage."""
        odd = [one for about in self.about for one in about.findings]
        for topic in self.topics:
            name, warn = topic.topic, Weight.WARN
            if topic.problem:
                odd.append(found("file.unreadable", name, why=topic.problem, weight=warn))
            gap = topic.largest_gap_s if topic.messages > 1 and topic.rate_hz else 0.0
            gap *= gap * topic.rate_hz > GAP
            if topic.messages < 2 or gap:
                longest = Quantity(gap, "s")
                odd.append(found("file.odd_values", name, messages=topic.messages, gap=longest))
            if topic.skew_s is not None and abs(topic.skew_s) > SKEW_S:
                odd.append(found("file.clocks", name, "log", apart=abs(topic.skew_s), weight=warn))
            if len(topic.fields) >= FIELD_LIMIT:
                odd.append(found("file.odd_values", name, first=FIELD_LIMIT))
            if bad := [field.path for field in topic.fields if field.not_finite]:
                odd.append(found("file.odd_values", bad[0], lost="some"))
        return tuple(odd)

    @property
    def remarks(self) -> tuple[str, ...]:
        """Its damage and the findings as sentences."""
        return tuple(one.sentence for one in (self.damage, *self.findings) if one)


def inspect_log(paths: str | Path | Sequence[str | Path], layout: Layout = AS_IT_SAYS) -> LogReport:
    """Summarise a log; at damage the reading ends, and the damage is reported.

    Raises:
        GroundedError: if a file can't be read, or is not a log.
    """
    return replace(read_apart(paths, _inspected, layout), layout=layout)


def _inspected(files: tuple[Path, ...], layout: Layout) -> LogReport:
    library: str | None = None
    topics, meta, about = dict[str, _Topic](), dict[str, str](), list[About]()
    damage: Finding | None = None
    for path in files:
        try:
            for one in by_topic(log_records(path, layout), str(path)):
                if isinstance(one, Header):
                    library = one.library if library is None else library
                elif isinstance(one, Topic):  # it goes on from file to file
                    topics.setdefault(one.name, _Topic(one))
                elif isinstance(one, Part):
                    topics[one.topic.name].add(one.content)
                elif isinstance(one, About):
                    about.append(one)
                elif isinstance(one, Metadata) and one.name == "grounded":
                    meta = one.data
        except DamagedFile as error:
            if library is None:
                raise
            damage = error.finding
            break
    times = [t for topic in topics.values() for t in topic.log_times]
    joined = np.concatenate(times) if times else np.zeros(1, dtype=np.int64)
    start, end = int(joined.min()), int(joined.max())
    return LogReport(
        files=files,
        library=library or "",
        start_ns=start,
        duration_s=(end - start) * 1e-9,
        messages=sum(topic.count for topic in topics.values()),
        topics=tuple(topic.report(start) for topic in topics.values()),
        damage=damage,
        meta=meta if len(files) == 1 else {},
        joints={n: next(iter(t.joints)) for n, t in topics.items() if len(t.joints) == 1},
        about=tuple(about),
    )


@dataclass
class _Topic:
    """One topic so far."""

    of: Topic
    count: int = 0
    looked: int = 0
    problem: str = ""
    log_times: list[Ints] = field(default_factory=list)
    skews: list[Ints] = field(default_factory=list)
    decoder: Decoder | None = None
    paths: dict[str, MessagePath] = field(default_factory=dict)
    values: dict[str, list[Floats]] = field(default_factory=dict)  # at each, batch by batch
    joints: set[tuple[str, ...]] = field(default_factory=set)

    def add(self, batch: Messages | Rows) -> None:
        """Take messages, or the rows of a table, into account."""
        times = batch.times if isinstance(batch, Rows) else batch.log_times
        self.count += len(times)
        self.log_times.append(times)
        if self.problem or not len(times):
            return
        if isinstance(batch, Messages):
            chosen = np.zeros(len(times), dtype=np.bool_)
            chosen[:: 1 + self.looked // DECODED] = True
            self.looked += int(chosen.sum())
            batch = batch.take(chosen)
        try:
            self.decoder = self.decoder or decoder_of(self.of.channel, self.of.schema)
            for part in self.decoder.parts(batch):
                self._look(self.decoder.name, part)
        except Bad as error:
            self.problem = str(error)

    def _look(self, kind: str, part: Decoded) -> None:
        if not self.paths:
            topic = self.of.name if is_topic(self.of.name) else f'"{self.of.name}"'
            for rest in dict.fromkeys(rest for one in part.samples for rest in number_paths(one)):
                with suppress(GroundedError):  # a name that no path can contain
                    path = parse_path(topic + rest)
                    self.paths[path.text] = path

        # The joints that the first and last of the messages name.
        listed = next((name for end, name in NAMING.items() if kind.endswith(end)), "")
        some = [one for one in part.samples if listed in names_in(one)]
        self.joints |= {tuple(map(str, names)) for names in fields_of(some, listed)}
        for i, (text, path) in enumerate(self.paths.items()):
            try:
                values = evaluate(part, path, stamps=i == 0)
            except BadPath:  # of another kind in another JSON message
                continue
            self.values.setdefault(text, []).append(values.values)
            if values.stamps is not None and len(values.stamps):
                self.skews.append(values.stamps - part.log_times[values.rows])

    def report(self, start: int) -> TopicReport:
        t = np.concatenate(self.log_times) if self.log_times else np.zeros(0, dtype=np.int64)
        gaps = np.diff(np.sort(t)) * 1e-9
        low, median, high = np.percentile(gaps, [5, 50, 95]) if len(gaps) else (0.0, 0.0, 0.0)
        skews = np.concatenate(self.skews) if self.skews else None
        numbers = ((path, self.values.get(path, [])) for path in self.paths)
        return TopicReport(
            topic=self.of.name,
            type=self.of.schema.name if self.of.schema else "",
            encoding=self.of.channel.encoding,
            messages=self.count,
            rate_hz=1 / float(median) if median > 0 else 0.0,
            jitter_s=float(high - low) / 2,
            largest_gap_s=float(gaps.max(initial=0.0)),
            first_s=float(t.min() - start) * 1e-9 if len(t) else None,
            last_s=float(t.max() - start) * 1e-9 if len(t) else None,
            stamped=skews is not None,
            skew_s=None if skews is None else float(np.median(skews)) * 1e-9,
            fields=tuple(_field(path, some) for path, some in numbers if any(map(len, some))),
            problem=self.problem,
        )


def _field(path: str, parts: Sequence[Floats]) -> FieldReport:
    """Return what there is to say of a number's values, given batch by batch.

    Its noise is a robust standard deviation of white noise, from second differences.
    """
    some = [values[np.isfinite(values)] for values in parts]
    finite, count = np.concatenate(some), sum(map(len, parts))
    bends = (np.median(np.abs(np.diff(v, 2))) for v in some if len(v) >= NOISE_SAMPLES)
    repeated = sum(int(((np.diff(v) == 0) & (v[1:] != 0)).sum()) for v in parts)
    return FieldReport(
        path=path,
        low=float(finite.min()) if len(finite) else None,
        high=float(finite.max()) if len(finite) else None,
        not_finite=count - len(finite),
        noise=float(np.median([*bends] or [0.0]) / (0.6745 * np.sqrt(6))),
        held=repeated / max(count - 1, 1),
    )
