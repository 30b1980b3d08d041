"""export: write a candidate for other programs, see `exported_files`, and find void exports."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from grounded import onboard
from grounded.checks import known as among
from grounded.checks import one_of, refused
from grounded.errors import GroundedError
from grounded.findings import Finding
from grounded.result import Result
from grounded.search.standing import Ending, Phase, Standing
from grounded_trials.store.store import write_atomically
from grounded_trials.workspace.candidates.exported_files import (
    about_of,
    encoders,
    is_export,
    units_of,
)
from grounded_trials.workspace.candidates.handover import (
    Check,
    checked_candidate,
    intact,
)
from grounded_trials.workspace.candidates.search_state import (
    candidate_named,
    known_end,
    standing_in,
)
from grounded_trials.workspace.folder import Folder

RUNNER = "grounded_runner.py"


@dataclass(frozen=True, repr=False)
class Exported(Result):
    """An exported candidate and its file."""

    candidate: str
    file: Path
    format: str
    runner: Path | None = None  # the program that runs it, if requested
    findings: tuple[Finding, ...] = ()  # on the candidate
    overridden: tuple[Finding, ...] = ()  # reasons against it, overridden by `anyway`
    named: tuple[str, ...] = ()  # options of `ingest` for its log if another one is outstanding
    ended: bool = False  # whether it is the best candidate of a search that has ended

    @property
    def notes(self) -> tuple[str, ...]:
        """The findings in words."""
        return tuple(one.sentence for one in self.findings)

    def summary(self) -> str:
        """Return the candidate and its file."""
        return f"{self.candidate}: {self.file}"

    def to_json(self) -> dict[str, Any]:
        """Return the document of `export --json`."""
        document: dict[str, Any] = {
            "file": str(self.file),
            "candidate": self.candidate,
            "format": self.format,
        }
        document |= {"search_ended": self.ended}
        return document | ({"runner": str(self.runner)} if self.runner else {})


def export_candidate(
    workspace: Folder,
    identity: str,
    form: str | None = None,
    path: Path | None = None,
    *,
    runner: bool = False,
    anyway: bool = False,
) -> Exported:
    """Write a candidate to a file, see `Workspace.export`.

    Without `form` the ending of `path` decides the format; without one it is npz with `runner`,
    else json.
    """
    known = encoders()
    form = form or format_of(path, tuple(known), "npz" if runner else "json")
    path = path or Path(f"{identity}.{form}")
    among("format", [form], known)
    if runner:
        one_of("format of the runner", form, ["npz"])
    now = standing_in(workspace) if identity == "best" else None
    identity = candidate_named(workspace, identity, now)
    handed = checked_candidate(workspace, identity, anyway=anyway, other_task=True, now=now)
    about = about_of(identity, handed.meta)
    if form == "npz":
        try:
            onboard.check_limits(identity, handed.candidate.policy)
        except ValueError as error:
            raise refused("plan.unsafe", identity, why=str(error)) from None
    write_atomically(path, known[form](handed.candidate.policy, units_of(workspace), about))
    program = path.with_name(RUNNER) if runner else None
    if program is not None:
        write_atomically(program, Path(onboard.__file__).read_bytes())
    waiting = handed.check.standing.outstanding
    how = () if waiting and waiting.id == identity else ("--candidate", identity)
    ended = _has_ended(workspace, identity, handed.check.standing)
    return Exported(identity, path, form, program, handed.findings, handed.overridden, how, ended)


def _has_ended(workspace: Folder, identity: str, now: Standing) -> bool:
    """Return whether the search is known to have ended with this candidate; nothing is planned."""
    if now.incumbent is None or now.incumbent.candidate.id != identity:
        return False
    if now.phase is Phase.PROPOSE:
        with suppress(GroundedError):  # another candidate's file is damaged
            now = known_end(workspace, workspace.read(), now) or now
    return now.ending is not Ending.NONE


def format_of(path: Path | None, formats: Sequence[str], default: str) -> str:
    """Return the format that a file's ending names; `default` without an ending.

    Raises:
        GroundedError: for any other ending.
    """
    ending = path.suffix.lstrip(".").lower() if path else ""
    if ending in formats:
        return ending
    if ending:
        one_of(f"the ending of {path}", ending, formats)
    return default


def void_exports(workspace: Folder, but: str = "") -> tuple[Path, ...]:
    """Return exported files in the workspace's folder whose candidate must not be run any more.

    Only files that are byte for byte what `export` or `next` wrote count, of candidates that no
    trial ran.

    Args:
        workspace: the workspace, in whose folder `next` writes.
        but: the candidate that was just handed over, which is skipped.
    """
    ran = {stored.trial.candidate for stored in workspace.whole_trials()}
    names = [name for name in workspace.candidate_ids() if name not in {but, *ran}]
    found = []
    for path in (workspace.folder / f"{name}.{form}" for name in names for form in encoders()):
        if path.is_file() and is_export(workspace, path.stem, path):
            made, meta = intact(workspace.candidate_bytes(path.stem), path.stem)
            if tuple(Check(workspace, made, meta, False, None).reasons()):
                found.append(path)
    return tuple(found)
