"""What a diagnosis says: frozen values, one dict for JSON, sentences an engineer understands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from grounded.diagnosis.lookalike import Likeness

Kind = Literal["effect", "several", "none", "unknown"]


@dataclass(frozen=True)
class Estimate:
    """A value, its standard deviation, its 95 % interval, its unit."""

    value: float
    std: float
    low: float
    high: float
    unit: str

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "value": self.value,
            "std": self.std,
            "interval": [self.low, self.high],
            "unit": self.unit,
        }


@dataclass(frozen=True)
class Ranked:
    """One explanation: its values, evidence [nats] over the model alone, the gap that it leaves."""

    effect: str
    params: Mapping[str, Estimate]
    fixed: Mapping[str, float]
    evidence: float
    gap_after: float | None = None
    shrinkage: float | None = None
    claimed: bool = False

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "effect": self.effect,
            "params": {name: e.to_dict() for name, e in self.params.items()},
            "fixed": dict(self.fixed),
            "evidence": self.evidence,
            "gap_after": self.gap_after,
            "shrinkage": self.shrinkage,
            "claimed": self.claimed,
        }


@dataclass(frozen=True)
class Remainder:
    """A leftover that no known effect explains."""

    channel: str
    size: float
    unit: str
    gain: float
    region: Mapping[str, Any] | None

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        region = None if self.region is None else dict(self.region)
        return {
            "channel": self.channel,
            "size": self.size,
            "unit": self.unit,
            "evidence": self.gain,
            "region": region,
        }

    def sentence(self) -> str:
        """One clause."""
        where = "" if self.region is None else f", mostly where {self.region['when']}"
        return f"{self.channel} is off by {number(self.size)} {self.unit} rms{where}"


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """All that `grounded diagnose --json` shows (CONTRACT.md)."""

    kind: Kind
    effects: tuple[str, ...]
    sentence: str
    channels: tuple[Mapping[str, Any], ...]
    times: tuple[Mapping[str, Any], ...]
    regions: tuple[Mapping[str, Any], ...]
    ranking: tuple[Ranked, ...]
    indistinguishable: tuple[tuple[str, ...], ...]
    gap: Mapping[str, Any]
    leftover: tuple[Remainder, ...]
    next_trial: str
    unknowable: tuple[str, ...] = ()
    noise: Mapping[str, Any] = field(default_factory=dict)
    whole_run: Mapping[str, Any] = field(default_factory=dict)
    parameters: Mapping[str, Estimate] = field(
        default_factory=dict
    )  # calibrated beside the effects
    split: Mapping[str, Any] = field(default_factory=dict)  # of the error, by horizon
    whiteness: Mapping[str, float] = field(default_factory=dict)  # p-value of what is left
    utility_prediction: Mapping[str, Any] | None = None  # where the subject was a task
    lookalikes: tuple[Likeness, ...] = ()  # that hardly differ from a claimed effect
    trials: int = 0
    steps: int = 0
    candidates: int = 0

    def values(self, effect: str) -> dict[str, float]:
        """An effect's quantities, constants included, as `grounded.effects.wrap` wants them."""
        for ranked in self.ranking:
            if ranked.effect == effect:
                return {**ranked.fixed, **{n: e.value for n, e in ranked.params.items()}}
        return {}

    def to_dict(self) -> dict[str, Any]:
        """Plain lists, dicts and numbers, ready for JSON."""
        return {
            "verdict": {
                "kind": self.kind,
                "effects": list(self.effects),
                "sentence": self.sentence,
            },
            "where": {
                "channels": [dict(c) for c in self.channels],
                "times": [dict(t) for t in self.times],
                "regions": [dict(r) for r in self.regions],
                "split": dict(self.split),
                "whiteness": dict(self.whiteness),
            },
            "ranking": [r.to_dict() for r in self.ranking],
            "indistinguishable": [list(group) for group in self.indistinguishable],
            "lookalikes": [dict(one.to_dict()) for one in self.lookalikes],
            "gap": dict(self.gap),
            "utility_prediction": self.utility_prediction and dict(self.utility_prediction),
            "whole_run": dict(self.whole_run),
            "leftover": [left.to_dict() for left in self.leftover],
            "next_trial": self.next_trial,
            "unknowable": list(self.unknowable),
            "noise": dict(self.noise),
            "parameters": {name: e.to_dict() for name, e in self.parameters.items()},
            "trials": self.trials,
            "steps": self.steps,
            "candidates": self.candidates,
        }


def number(value: float) -> str:
    """Three digits."""
    return f"{value:.3g}"


def quantity(estimate: Estimate) -> str:
    """A value with its unit; pure numbers as they are."""
    unit = "" if estimate.unit == "1" else f" {estimate.unit}"
    return f"{number(estimate.value)}{unit}"
