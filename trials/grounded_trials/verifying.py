"""Every byte that a workspace keeps, checked: trials by hash, candidates by their own checksums."""

from __future__ import annotations

from grounded.errors import GroundedError
from grounded_trials.mcap_log import read_candidate
from grounded_trials.workspace import Workspace


def damaged_files(workspace: Workspace) -> tuple[int, list[tuple[str, str]]]:
    """How many files were checked, and (file, reason) for each that is not what it was."""
    damaged = [(str(d.path), d.reason) for d in workspace.store.verify()]
    candidates = sorted((workspace.folder / "candidates").glob("*.mcap"))
    for path in candidates:
        try:
            read_candidate(path)
        except GroundedError as error:
            damaged.append((str(path), str(error)))
    return len(workspace.store.list()) + len(candidates), damaged
