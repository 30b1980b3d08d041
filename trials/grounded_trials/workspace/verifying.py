"""verify: check whether stored files were changed, damaged or removed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from grounded.checks import refused
from grounded.errors import GroundedError
from grounded.findings import Finding
from grounded.result import Document
from grounded_trials.plain_file import read_file
from grounded_trials.store.documents import read_document
from grounded_trials.store.own_files import FILE_LIMIT
from grounded_trials.store.store import Lost
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.identity import Noted, candidate_of, noted, sha256


@dataclass(frozen=True, eq=False, repr=False)
class Verified(Document):
    """How many files were checked, and which are changed, damaged or missing."""

    checked: int
    damaged: tuple[Lost, ...]
    findings: tuple[Finding, ...] = ()

    def summary(self) -> str:
        """Return how many files were checked and how many are damaged."""
        return f"{self.checked} files, {len(self.damaged)} damaged"


def verify_in(workspace: Folder) -> Verified:
    """Check all stored files for changes, damage, deletion and replacement.

    Trials and notes are checked against their hashes and for completeness; candidates against their
    checksums, what was handed out, and their predictions; the rest by checksums.
    """
    broken = [*workspace.store.verify()]
    known = noted(workspace.notes.read(broken))
    broken += known.gone(workspace.store)
    checked = len(workspace.store.list()) + len(workspace.notes.store.list())
    there = {path.stem for path in (workspace.folder / "candidates").glob("*.mcap")}
    stored = {one.id for one in workspace.store.list()} | {Path(one.file).name for one in broken}
    check: Callable[[Path], Any] = partial(_check_candidate, workspace, known, stored)
    checks = [(workspace.candidate_path(n), check) for n in sorted(there | set(known.handed))]
    documents = (workspace.reports / name for name in ("diagnosis.json", "adoptions.json"))
    checks += [(path, read_document) for path in documents if path.exists()]
    for path, check in checks:
        checked += 1
        try:
            check(path)
        except GroundedError as error:
            broken.append(Lost(str(path), str(error)))
    return Verified(checked, tuple(broken))


def _check_candidate(workspace: Folder, known: Noted, stored: set[str], path: Path) -> None:
    """Check the file of a candidate that exists or existed."""
    handed = known.handed.get(path.stem, set())
    carried = (one.ran in handed for one in workspace.whole_trials())
    if not path.exists() and any(carried):  # a trial contains the file
        return
    data = read_file(path, FILE_LIMIT, follow=False)
    if lost := sorted({*candidate_of(data, path.stem)[0].seen} - stored):
        raise refused("file.changed", path, what="gone", lost=tuple(lost))
    if handed and sha256(data) not in handed:
        raise refused("file.changed", path, what="candidate")
