"""The result of `ingest` for one log: its trial, the verdict on the candidate, warnings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from grounded.errors import NextCommand
from grounded.result import Result
from grounded_trials.logs.signal_report import SignalReport
from grounded_trials.workspace.next_step import PROPOSE
from grounded_trials.workspace.off_target import OffTarget


@dataclass(frozen=True, eq=False, repr=False)
class Ingested(Result):
    """One ingested log."""

    trial: str  # its short name, t0007
    sha256: str
    known: bool  # it had been stored before
    candidate: str  # "" for data
    utility: float | None  # None for data; -inf for a run that failed
    accepted: bool | None  # None for data, or if not decided yet
    warnings: tuple[str, ...]
    signals: tuple[SignalReport, ...]  # for a foreign log
    verdict: str = ""  # a word of `wording.verdict`, run again, probe; "" for data
    crashed: tuple[str, ...] = ()  # the candidate's trials that ended early, if it crashed
    notes: tuple[str, ...] = ()  # where in a longer log the run was found
    off_target: tuple[OffTarget, ...] = ()  # errors of the run, in units
    faults: tuple[str, ...] = ()  # those warnings that say that columns of the log are wrong
    then: NextCommand = PROPOSE

    def summary(self) -> str:
        """Return the trial, what it ran and the verdict."""
        return f"{self.trial}: {f'{self.candidate}, {self.verdict}' if self.candidate else 'data'}"

    def to_json(self) -> dict[str, Any]:
        """Return its entry in `ingest --json`; for a failed run utility is null, `failed` true."""
        return {
            "trial": self.trial,
            "sha256": self.sha256,
            "known": self.known,
            "candidate": self.candidate or None,
            "utility": self.utility,
            "failed": self.utility == float("-inf"),
            "accepted": self.accepted,
            "verdict": self.verdict or None,
            "crashed": list(self.crashed),
            "off_target": [one.to_json() for one in self.off_target],
            "warnings": list(self.warnings),
            "faults": list(self.faults),
            "notes": list(self.notes),
            "signals": [vars(signal) for signal in self.signals],
        }
