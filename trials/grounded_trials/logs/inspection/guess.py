"""Guess: the probable signal of a state or input in a log, with its evidence."""

from __future__ import annotations

from dataclasses import dataclass, replace

from grounded.findings import Finding
from grounded_trials.logs.inspection.inspect_log import FieldReport


@dataclass(frozen=True)
class Guess:
    """The probable signal of a state or input in the log."""

    name: str
    path: str  # "" if nothing fits
    clock: str
    sure: bool
    others: tuple[str, ...]  # alternatives, best first
    field: FieldReport | None = None
    reasons: tuple[Finding, ...] = ()  # evidence
    scale: float = 1.0  # factor on its values: degrees, or a sign

    @property
    def is_angle(self) -> bool:
        """Whether its values come from an orientation and wrap."""
        return self.path.endswith(tuple(f"@rpy.{angle}" for angle in ("roll", "pitch", "yaw")))

    @property
    def extent(self) -> tuple[float, float] | None:
        """Its lowest and highest value in the log, in the model's unit; None if unknown."""
        if self.field is None or self.field.low is None or self.field.high is None:
            return None
        low, high = sorted((self.field.low * self.scale, self.field.high * self.scale))
        return low, high

    def because(self, *why: Finding, sure: bool | None = None) -> Guess:
        """Return it with more evidence, and sure or not if stated."""
        known = (*self.reasons, *(one for one in why if one not in self.reasons))
        return replace(self, reasons=known, sure=self.sure if sure is None else sure)
