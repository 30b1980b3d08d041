"""Errors for names that are no trial or no candidate of a workspace."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from grounded.checks import list_of, refused, wrong
from grounded.errors import GroundedError, NextCommand
from grounded.findings import found
from grounded_trials.wording import ranges

if TYPE_CHECKING:
    from grounded_trials.workspace.folder import Folder

_SHORT = re.compile(r"[ct]?0*(\d{1,9})", re.IGNORECASE)  # t2, T0002 or 2


def unknown_trial(workspace: Folder, name: str) -> GroundedError:
    """Return the error for a name that is no stored trial, or that of one that is set aside."""
    return _unknown(workspace, name, "trial")


def unknown_candidate(workspace: Folder, name: str) -> GroundedError:
    """Return the error for a name that is no candidate."""
    return _unknown(workspace, name, "candidate")


def _unknown(workspace: Folder, name: str, kind: str) -> GroundedError:
    """Return the error for a name of the other kind, one that is set aside, or one of nothing.

    Args:
        workspace: the workspace.
        name: the name that was given.
        kind: "trial" or "candidate", which was expected.
    """
    given, aside = name.lower(), workspace.discarded()
    trials, candidates = [one.id for one in workspace.store.list()], workspace.candidate_ids()
    if kind == "trial" and given in aside:
        then = NextCommand("restore", (given,))
        return GroundedError(found("search.aside", given, then=then, why=aside[given]))
    known, other = (trials, candidates) if kind == "trial" else (candidates, trials)
    beside = None
    if given in other and given not in known:
        pairs = ((t.trial.candidate, t.stored.id) for t in workspace.whole_trials())
        own = [b if kind == "trial" else a for a, b in pairs if given in (a, b)]
        beside = ranges([one for one in own if one]) or "none"
    short = _SHORT.fullmatch(given)
    meant = f"{kind[0]}{int(short[1]):04d}" if short else ""
    return GroundedError(
        found(
            "search.unknown",
            name,
            kind=kind,
            beside=beside,
            meant=meant if meant in known and not beside else None,
            known=None if beside or meant in known else ranges(known) or "none yet",
        )
    )


def named_trials(workspace: Folder, names: Sequence[str], usable: Sequence[str]) -> tuple[str, ...]:
    """Return the trials that fit and diagnose are to use, in lower case; empty: all usable ones.

    Args:
        workspace: the workspace.
        names: the names that were given.
        usable: the trials that can be used.

    Raises:
        GroundedError: if nothing can be used, or a name is no usable trial.
    """
    if isinstance(names, str):
        raise wrong("trials", names, must="names", like=f"['{names}']")
    given = list_of(names, str, "trials")
    if not usable:
        raise refused("search.no_trial")
    stored = {one.id for one in workspace.store.list()} - {*workspace.discarded()}
    for name in given:
        if name.lower() in stored.difference(usable):
            raise refused(
                "search.unknown", name.lower(), kind="trial", unusable=True, known=ranges(usable)
            )
        if name.lower() not in usable:
            raise unknown_trial(workspace, name)
    return tuple(name.lower() for name in given)


def refuse_ids(workspace: Folder, log: str | Path, verb: str) -> None:
    """Raise an error if a trial or candidate was named in place of the file of a log.

    Args:
        workspace: the workspace.
        log: what was given; a file or folder of that name is accepted.
        verb: the command, such as "inspect".
    """
    given = str(log).lower()
    if not _SHORT.fullmatch(given) or Path(log).exists():
        return
    paths = {one.id: str(one.path) for one in workspace.store.list()}
    if given in paths or given in workspace.candidate_ids():
        path = None if verb == "ingest" else paths.get(given)
        raise refused("file.no_log", str(log), path=path)
