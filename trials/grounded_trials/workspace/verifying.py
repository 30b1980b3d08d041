"""verify: every byte that a workspace keeps, trials by hash, candidates by their own checksums."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from grounded.errors import GroundedError
from grounded.result import Result
from grounded_trials.store.candidate_file import read_candidate
from grounded_trials.workspace.folder import Folder, Lost


@dataclass(frozen=True, repr=False)
class Verified(Result):
    """How many files were checked, and those that are not what they were."""

    checked: int
    damaged: tuple[Lost, ...]

    def summary(self) -> str:
        """How many are good, how many not."""
        return f"{self.checked} files, {len(self.damaged)} damaged"

    def to_json(self) -> dict[str, Any]:
        """The document of `verify --json`."""
        return {"checked": self.checked, "damaged": [vars(one) for one in self.damaged]}


def verify_in(workspace: Folder) -> Verified:
    """Reads every stored trial and every candidate.

    Raises:
        GroundedError: if a folder can't be read.
    """
    damaged = [Lost(str(one.path), one.reason) for one in workspace.store.verify()]
    candidates = sorted((workspace.folder / "candidates").glob("*.mcap"))
    for path in candidates:
        try:
            read_candidate(path)
        except GroundedError as error:
            damaged.append(Lost(str(path), str(error)))
    return Verified(len(workspace.store.list()) + len(candidates), tuple(damaged))
