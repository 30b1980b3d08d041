"""verify: check whether stored files were changed, damaged or removed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
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
from grounded_trials.workspace.last_diagnosis import read_diagnosis

Check = tuple[Path, Callable[[], Any]]


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
    gone = {Path(one.file).name for one in broken}
    for path, check in (*_candidates(workspace, known, gone), *_documents(workspace)):
        checked += 1
        try:
            check()
        except GroundedError as error:
            broken.append(Lost(str(path), str(error)))
    return Verified(checked, tuple(broken))


def _candidates(workspace: Folder, known: Noted, gone: set[str]) -> Iterator[Check]:
    """Yield the path of each candidate that exists or existed, with a function that checks it.

    Args:
        workspace: the workspace.
        known: its notes.
        gone: trials that are reported as missing already.
    """
    stored = {one.id for one in workspace.store.list()} | gone

    def check(path: Path) -> None:
        handed = known.handed.get(path.stem, set())
        carried = (one.ran in handed for one in workspace.read(strict=False).trials)
        if not path.exists() and any(carried):  # a trial contains the file
            return
        data = read_file(path, FILE_LIMIT, follow=False)
        lost = sorted({*candidate_of(data, path.stem)[0].seen} - stored)
        if lost:
            raise refused("file.changed", path, what="gone", lost=tuple(lost))
        if handed and sha256(data) not in handed:
            raise refused("file.changed", path, what="candidate")

    there = {path.stem for path in (workspace.folder / "candidates").glob("*.mcap")}
    for path in map(workspace.candidate_path, sorted(there | set(known.handed))):
        yield path, partial(check, path)


def _documents(workspace: Folder) -> Iterator[Check]:
    """Yield the path of each document in reports/, with a function that checks it."""
    if (path := workspace.reports / "diagnosis.json").exists():
        yield path, lambda: read_diagnosis(workspace.reports)
    if (kept := workspace.reports / "adoptions.json").exists():
        yield kept, partial(read_document, kept)
