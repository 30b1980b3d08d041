"""Finding: one fault of a sensor or command, with the values needed to correct it.

`Preflight` holds all findings with the corrected trials; `UnusableTrials` is raised if they can't
be corrected.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from grounded.errors import GroundedError, NextCommand
from grounded.findings import finding as told
from grounded.result import Document
from grounded.trial import Trial

SENSOR_DELAY = "sensor_delay:"  # before the states, in the name of an effect


@dataclass(frozen=True, eq=False)
class Finding(Document):
    """A fault of one signal, and whether the trials were corrected for it.

    Kinds are delay, lag, smoothed, scale, sign, degrees, wrapped, offset, stuck, held, dropout,
    mismatch (with others), unresolved (too fast for the model's time step) and time step (of the
    integrator, which is too long for the model).
    """

    signal: str  # a state or an input, or several joined by "+"
    said: told.Finding | None = field(default=None, metadata={"brief": True})  # what is wrong
    kind: str = ""
    delay_s: float = 0.0
    std_s: float = field(default=float("nan"), metadata={"brief": True})  # of the delay [s]
    scale: float = 1.0  # measured value over true value
    share: float = field(default=float("nan"), metadata={"brief": True})  # of samples affected
    corrected: bool = False  # before the physics was identified
    keys: Mapping[str, Any] = field(default_factory=dict)  # of [log] that correct logs as well
    # its remedy says what to change, where no key of [log] corrects it
    mend: told.Finding | None = field(default=None, metadata={"brief": True})
    source: str = field(default="", metadata={"brief": True})  # position of a computed velocity

    @property
    def finding(self) -> str:
        """One clause that continues a sentence after the signal's name."""
        return self.said.clause if self.said is not None and self.said.printable else ""

    @property
    def log(self) -> str:
        """The keys of its [log] table as text, "" for none."""
        return ", ".join(
            f"{key} = {'true' if value is True else f'{value:.8g}'}"
            for key, value in self.keys.items()
        )

    @property
    def advice(self) -> str:
        """What to change where no key of [log] corrects it, "" for nothing."""
        return self.mend.remedy if self.mend is not None and self.mend.printable else ""

    def to_json(self) -> dict[str, Any]:
        """Return the fields by JSON key, with what they say in words."""
        words = {"log": self.log, "advice": self.advice}
        some = {key: text for key, text in words.items() if text}
        return {**super().to_json(), "finding": self.finding, **some}


def in_the_log(findings: Iterable[Finding]) -> list[Finding]:
    """Return the corrected findings of degrees and signs: the logs themselves are still wrong."""
    return [one for one in findings if one.corrected and one.kind in ("degrees", "sign")]


def late_effects(findings: Iterable[Finding]) -> dict[str, dict[str, float]]:
    """Return the sensor filters and delays that were found and corrected, as effects by name.

    The physics was identified without them, but a feedback controller sees the delayed signals.
    """
    found = dict[str, dict[str, float]]()
    for one in findings:
        if one.corrected and one.kind == "lag" and one.delay_s > 0 and not one.keys:
            found[f"sensor_lag:{one.signal}"] = {"tau": one.delay_s}
        elif one.corrected and one.kind == "delay" and one.delay_s > 0:
            name = f"{SENSOR_DELAY}{one.signal}"
            found[name] = {"d": found.get(name, {"d": 0.0})["d"] + one.delay_s}
    return found


def late_as_positions(
    findings: Iterable[Finding], delays: Mapping[str, float], known: Container[str]
) -> Iterator[Finding]:
    """Yield a finding for each velocity that is computed from a position whose sensor is late.

    It is late by as much, too: what the sensors show of it is only how far behind its position it
    is. Delays that the physics shows [s] are by effect, `sensor_delay:x`; `known` are those that
    the model has already.
    """
    for one in findings:
        late = {
            name: delay
            for name, delay in delays.items()
            if one.source in (states := name.removeprefix(SENSOR_DELAY).split("+"))
            if one.signal not in states
        }
        if late and sum(late.values()) > 0 and f"{SENSOR_DELAY}{one.signal}" not in known:
            d, position = sum(late.values()), one.source
            said = told.found("sensor.late", one.signal, more=d, position=position)
            yield Finding(one.signal, said, "delay", d, corrected=True, source=position)


@dataclass(frozen=True, eq=False)
class Preflight:
    """The findings of all checks, and the corrected trials."""

    findings: tuple[Finding, ...]
    trials: tuple[Trial, ...]
    in_step: frozenset[str] = frozenset()  # states whose sensors are seen to be synchronous
    refuted: frozenset[str] = frozenset()  # effects ruled out because two sensors agree

    @property
    def filters(self) -> dict[str, float]:
        """Time constants of filtering sensors by state [s]."""
        return {f.signal: f.delay_s for f in self.findings if f.corrected and f.kind == "lag"}

    @property
    def left_out(self) -> frozenset[str]:
        """States whose sensors add nothing to others."""
        return frozenset(f.signal for f in self.findings if f.kind == "smoothed")

    @property
    def settled(self) -> frozenset[str]:
        """Names of the sensor effects that are already corrected or ruled out."""
        mended = {f.signal for f in self.findings if f.corrected and f.kind in ("delay", "lag")}
        return self.refuted | frozenset(
            f"{family}:{name}"
            for name in self.in_step | mended
            for family in ("sensor_delay", "sensor_lag")
        )


class UnusableTrials(GroundedError):
    """Raised for trials that must be corrected; `findings` say why, and in which.

    Args:
        trials: all of them.
        odd: indices of those affected.
        findings: what is wrong with them.
    """

    def __init__(
        self, trials: Sequence[Trial], odd: Sequence[int], *findings: told.Finding
    ) -> None:
        which = tuple(trials[k].id or f"trial number {k + 1}" for k in odd)
        named = trials[odd[0]].id != ""
        *others, last = findings
        last = last.also(which=which if named or len(trials) > 1 else ())
        if named:
            last = last.also(source="log", trials=which)
        self.findings = (*others, last)
        text = ". ".join(one.sentence for one in self.findings)
        super().__init__(text, NextCommand("discard", which) if named else None)
        self.finding = self.findings[0]
