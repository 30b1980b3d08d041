"""Set trials aside; after a run the search says what is next, usually to run it again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

from grounded.errors import GroundedError, NextCommand
from grounded.findings import Finding
from grounded.result import UNSAID, Document
from grounded_trials.workspace.candidates.proposing import status_of
from grounded_trials.workspace.candidates.search_state import standing_in
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.identity import unknown_trial

STATUS = NextCommand("status")


@dataclass(frozen=True, eq=False, repr=False)
class SetAside(Document):
    """The result of `discard` and `restore`: the named trials, and all that are set aside."""

    trials: tuple[str, ...]
    unchanged: tuple[str, ...]  # those of `trials` that were in this state before
    discarded: Mapping[str, str]  # t0004 -> why
    findings: tuple[Finding, ...] = ()
    then: NextCommand = field(metadata=UNSAID, default=STATUS)

    def summary(self) -> str:
        """Return all trials that are set aside."""
        return f"set aside: {', '.join(self.discarded) or 'none'}"


def set_aside(workspace: Folder, note: str, trials: Sequence[str], why: str) -> SetAside:
    """Record that trials were discarded or restored."""
    for name in trials:
        if not workspace.store.matching(name.lower()):
            raise unknown_trial(workspace, name)
    named = dict.fromkeys(name.lower() for name in trials)
    found = [workspace.store.find(name) for name in named]
    same = []  # no change: discarded again for no other reason, or restored but never discarded
    digests = [stored.digest for stored in workspace.store.list()]
    for one in found:
        before = workspace.noted.why_aside(one)
        if before is None if note == "restore" else before is not None and why in ("", before):
            same.append(one.id)
            continue
        copied = digests.count(one.digest) > 1 and one.digest not in workspace.noted.aside
        trial = one.path.stem if copied else one.digest
        workspace.notes.add({"note": note, "trial": trial, "why": why})
    workspace.forget_trials()
    return SetAside(tuple(one.id for one in found), tuple(same), workspace.discarded())


def restore_in(workspace: Folder, *trials: str) -> SetAside:
    """Undo `discard` for some trials."""
    return set_aside(workspace, "restore", trials, "")


def discard_in(workspace: Folder, *trials: str, why: str = "") -> SetAside:
    """Exclude trials from search, fit, diagnosis and report; nothing is deleted.

    Args:
        workspace: the workspace.
        trials: short names such as t0004.
        why: the reason, stored with the note.
    """
    done = set_aside(workspace, "discard", trials, why)
    with suppress(GroundedError):  # of files that are damaged: `status` names them
        return replace(done, then=status_of(workspace, standing_in(workspace)).then)
    return done
