"""Proposal: what to run next, or why there is nothing to run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from grounded.result import Result, document
from grounded.search.candidate import Candidate
from grounded.search.standing import Standing


@dataclass(frozen=True, eq=False, repr=False)
class Proposal(Result):
    """What to run next, or why there is nothing: `candidate` is None if the search has ended."""

    standing: Standing
    candidate: Candidate | None
    is_new: bool  # whether the candidate was made by this call
    notes: tuple[str, ...] = ()
    refused: Candidate | None = None  # a candidate that was refused for the reasons in `notes`

    def summary(self) -> str:
        """Return the summary of the candidate, or of the standing if there is none."""
        return self.candidate.summary() if self.candidate else self.standing.summary()

    def to_json(self) -> dict[str, Any]:
        """Return the document of `grounded propose --json`; the command fills in `file`."""
        now, made = self.standing, self.candidate
        known = document(
            candidate=made and made.id,
            file=None,
            iteration=made.iteration if made else now.iteration,
            alpha=made and made.alpha,
            damping=made.damping if made and made.base else None,
            predicted_utility=made and made.predicted_utility,
            phase="await-trial" if made else now.phase,
            sentence=now.sentence,
            notes=self.notes,
        )
        best = document(best_utility=now.incumbent and now.incumbent.utility, new=self.is_new)
        return known | best if made else known
