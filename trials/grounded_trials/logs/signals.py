"""Read signals from logs: for each name the samples at its message path, in file order.

All signals are read in one pass over the files, and only the fields in the paths are decoded.
Whatever the encoding (cdr, ros1, protobuf, json), a message gives one number or none, and three
times: when it was logged, when it was published, and its header's stamp.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from grounded.checks import near, refused
from grounded.errors import GroundedError, NextCommand
from grounded.findings import Finding
from grounded_trials.formats.bad import Bad, BadMessage, BadPath, BadSchema
from grounded_trials.formats.mcap_records import About, Rows
from grounded_trials.formats.mcap_walk import Part, Topic, by_topic
from grounded_trials.formats.message_path import MessagePath, parse_path
from grounded_trials.formats.messages import Decoded, Decoder, Floats, Ints, decoder_of
from grounded_trials.formats.path_walk import evaluate
from grounded_trials.formats.tables import AS_IT_SAYS, Layout
from grounded_trials.logs.log_files import log_records, read_apart

Clock = Literal["header", "log", "publish"]
TOPICS_NAMED = 8  # topics of a log that are all named where one is missing


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
    unit: str = ""  # that the file says
    findings: tuple[Finding, ...] = ()  # on its file
    tidied: dict[tuple[str, bool], Any] = field(init=False, default_factory=dict)  # see `tidy`

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

    Raises:
        GroundedError: for a damaged file, a missing topic or field, a message with more than one
            value for a signal, or a clock that a topic does not have.
    """
    return read_apart(paths, _read_signals, specs, layout)


def _read_signals(
    files: tuple[Path, ...], specs: Mapping[str, SignalSpec], layout: Layout
) -> dict[str, Series]:
    collectors = [_Collector(name, spec) for name, spec in specs.items()]
    topics, wanted = set[str](), dict[Topic, tuple[Decoder, list[_Collector]]]()
    for path in files:
        for one in by_topic(log_records(path, layout), str(path)):
            if isinstance(one, About):
                for collector in collectors:
                    collector.unit = collector.unit or one.units.get(collector.path.text, "")
                    collector.findings += one.findings
            elif isinstance(one, Part) and one.topic in wanted:
                _collect(*wanted[one.topic], one, str(path))
            elif isinstance(one, Topic):
                topics.add(one.name)
                if wanting := [each for each in collectors if each.path.topic == one.name]:
                    try:
                        wanted[one] = decoder_of(one.channel, one.schema), wanting
                    except BadSchema as error:
                        raise wanting[0].misfit(one, str(path), error) from None
                for collector in wanting:
                    collector.type = one.type
    _refuse_missing([one for one in collectors if not one.type], sorted(topics), str(files[0]))
    return {collector.name: collector.series() for collector in collectors}


def _collect(decoder: Decoder, wanting: Sequence[_Collector], part: Part, file: str) -> None:
    """Pass the messages of a topic to those who want its numbers."""
    collector, seen, content = wanting[0], 0, part.content
    try:
        for some in decoder.parts(content):
            for collector in wanting:
                collector.collect(some)
            seen += len(some.log_times)
    except BadMessage as error:
        times = content.times if isinstance(content, Rows) else content.log_times
        at = float(times[seen + error.message]) * 1e-9
        raise collector.misfit(part.topic, file, error, at) from None
    except BadPath as error:
        raise collector.misfit(part.topic, file, error) from None


def _refuse_missing(missing: Sequence[_Collector], known: Sequence[str], file: str) -> None:
    """Name all signals of the first topic that the log does not have."""
    if not missing:
        return
    topic = missing[0].path.topic
    names = ", ".join(one.name for one in missing if one.path.topic == topic)
    few = 0 < len(known) <= TOPICS_NAMED  # the nearest name may be another's: /left for /port
    facts: dict[str, Any] = {"known": tuple(known)} if few else near(topic, known)
    facts |= {"kind": "topic", "of": Path(file).name, "where": names}
    raise refused("given.name", topic, then=NextCommand("inspect", (file,)), **facts)


class _Collector:
    """Gathers the samples of one signal."""

    def __init__(self, name: str, spec: SignalSpec) -> None:
        self.name, self.spec = name, spec
        self.path: MessagePath = parse_path(spec.path)
        self.parts: list[tuple[Ints, Floats, Ints]] = []
        self.messages = 0
        self.type = self.unit = ""
        self.findings: tuple[Finding, ...] = ()

    def misfit(self, topic: Topic, file: str, error: Bad, at: float | None = None) -> GroundedError:
        """Return the error for a topic that can't be read, or has no such number."""
        facts = {"topic": topic.name, "type": topic.type, "at": at, "path": self.path.text}
        return refused("file.signal", self.name, why=error.finding.what, file=file, **facts)

    def collect(self, part: Decoded) -> None:
        """Take the numbers of messages, and their times on the signal's clock."""
        self.messages += len(part.log_times)
        values = evaluate(part, self.path, stamps=self.spec.clock == "header")
        again = np.diff(values.rows) == 0
        if again.any():
            at = int(values.rows[np.argmax(again)])
            raise BadPath("path", expected="one value", at=f"{part.log_times[at] * 1e-9:.3f} s")
        times = logged = part.log_times[values.rows]
        if self.spec.clock == "header":
            if values.stamps is None and len(values.rows):
                raise BadPath("decode", what="header stamp")
            times = logged if values.stamps is None else values.stamps
        elif self.spec.clock == "publish":
            times = part.publish_times[values.rows]
            if (times < 0).any():
                at = int(values.rows[np.argmax(times < 0)])
                raise BadMessage(at, "decode", what="stamp", at="2262")
        self.parts.append((times, values.values, logged))

    def series(self) -> Series:
        """Return what was gathered."""
        if not any(len(values) for _, values, _ in self.parts):
            facts = {"path": self.path.text, "topic": self.path.topic, "messages": self.messages}
            raise refused("file.signal", self.name, **facts)
        t, values, logged = (np.concatenate(part) for part in zip(*self.parts, strict=True))
        told = self.messages, self.type, self.unit, self.findings
        return Series(self.spec, t, values, logged, *told)
