"""verify: is everything that is kept what it was?"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from grounded.errors import GroundedError
from grounded.result import Result
from grounded_trials.plain_file import read_file
from grounded_trials.store.documents import read_document
from grounded_trials.store.own_files import FILE_LIMIT
from grounded_trials.workspace.diagnosing import read_diagnosis
from grounded_trials.workspace.folder import Folder, Lost
from grounded_trials.workspace.handover import intact
from grounded_trials.workspace.identity import Noted, noted, sha256


@dataclass(frozen=True, repr=False)
class Verified(Result):
    """How many files were checked, and those that are not what they were, or are gone."""

    checked: int
    damaged: tuple[Lost, ...]

    def summary(self) -> str:
        """How many are good, how many not."""
        return f"{self.checked} files, {len(self.damaged)} damaged"

    def to_json(self) -> dict[str, Any]:
        """The document of `verify --json`."""
        return {"checked": self.checked, "damaged": [vars(one) for one in self.damaged]}


def verify_in(workspace: Folder) -> Verified:
    """Checks every file of a workspace that a result rests on."""
    broken = [*workspace.store.verify()]
    known = noted(workspace.notes.read(broken))
    broken += known.gone(workspace.store)
    damaged = [Lost(str(one.path), one.reason) for one in broken]
    checked = len(workspace.store.list()) + len(workspace.notes.store.list())
    for path, check in (*_candidates(workspace, known), *_documents(workspace)):
        checked += 1
        try:
            check()
        except GroundedError as error:
            damaged.append(Lost(str(path), str(error)))
    return Verified(checked, tuple(damaged))


def _candidates(workspace: Folder, known: Noted) -> Iterator[tuple[Path, Callable[[], None]]]:
    """Each candidate that there is or was, and how it is checked."""
    folder = workspace.folder / "candidates"
    names = {path.stem for path in folder.glob("*.mcap")} | set(known.handed)
    for name in sorted(names):
        path = workspace.candidate_path(name)

        def check(name: str = name, path: Path = path) -> None:
            handed = known.handed.get(name)
            if not path.exists() and _carried(workspace, handed or set()):
                return
            data = read_file(path, FILE_LIMIT)
            intact(data, name)
            if handed and sha256(data) not in handed:
                raise GroundedError(
                    f"{path} is not what was handed out as {name}: it was rewritten"
                )

        yield path, check


def _carried(workspace: Folder, handed: set[str]) -> bool:
    """Whether a trial carries a candidate whose file is gone."""
    trials = workspace.read(strict=False).trials
    return any(one.ran in handed for one in trials)


def _documents(workspace: Folder) -> Iterator[tuple[Path, Callable[[], Any]]]:
    """The documents of reports/ that there are, and how they are checked."""
    if (path := workspace.reports / "diagnosis.json").exists():
        yield path, lambda: read_diagnosis(workspace.reports)
    for name in ("optimum.json", "adoptions.json", "fit.json"):
        if (place := workspace.reports / name).exists():
            yield place, partial(read_document, place)
