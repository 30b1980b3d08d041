"""Errors for names that are no trial or no candidate of a workspace."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from grounded.errors import GroundedError, NextCommand, list_of
from grounded_trials.wording import ranges

if TYPE_CHECKING:
    from grounded_trials.workspace.folder import Folder

_SHORT = re.compile(r"[ct]?0*(\d{1,9})", re.IGNORECASE)  # t2, T0002 or 2


def unknown_trial(workspace: Folder, name: str) -> GroundedError:
    """Return the error for a name that is no stored trial, or that of one that is set aside.

    Args:
        workspace: the workspace.
        name: the name that was given.
    """
    known = [stored.id for stored in workspace.store.list()]
    given, aside = name.lower(), workspace.discarded()
    if given in aside:
        why = f" ({aside[given]})" * bool(aside[given])
        return GroundedError(f"{given} is set aside{why}", NextCommand("restore", (given,)))
    if given not in known and given in workspace.candidate_ids():
        ran = [t.stored.id for t in workspace.whole_trials() if t.trial.candidate == given]
        runs = f"it was run as {ranges(ran)}" if ran else "no trial ran it"
        return GroundedError(f"{name} is a candidate, expected a trial: {runs}")
    here = _there_is(given, "t", known) or "none was ingested yet"
    return GroundedError(f"there is no trial '{name}': {here}")


def unknown_candidate(workspace: Folder, name: str) -> GroundedError:
    """Return the error for a name that is no candidate.

    Args:
        workspace: the workspace.
        name: the name that was given.
    """
    known, given = workspace.candidate_ids(), name.lower()
    trials = [stored.id for stored in workspace.store.list()]
    if given in trials:
        ran = [t.trial.candidate for t in workspace.whole_trials() if t.stored.id == given]
        what = f"it ran {ran[0]}" if ran and ran[0] else "it ran none"
        return GroundedError(f"{name} is a trial, expected a candidate: {what}")
    here = _there_is(given, "c", known) or "none was proposed yet"
    return GroundedError(f"there is no candidate '{name}': {here}")


def unusable_trial(workspace: Folder, name: str, usable: Sequence[str]) -> GroundedError:
    """Return the error for a trial that is unknown, or that fit and diagnose can't use.

    Args:
        workspace: the workspace.
        name: the name that was given.
        usable: the trials that can be used.
    """
    given = name.lower()
    stored = [one.id for one in workspace.store.list()]
    if given in usable or given not in stored or given in workspace.discarded():
        return unknown_trial(workspace, name)
    return GroundedError(
        f"{given} can't be used: it is too short, or has other states, inputs or dt than this "
        f"task; trials to use: {ranges(usable)}"
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
        raise GroundedError(f"trials must be a list of names, such as ['{names}'], got '{names}'")
    given = list_of(names, str, "trials")
    if not usable:
        raise GroundedError(
            "there is no trial to learn from: ingest runs of candidates, or other logs with --data"
        )
    for name in given:
        if name.lower() not in usable:
            raise unusable_trial(workspace, name, usable)
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
    for stored in workspace.store.list():
        if stored.id == given:
            raise GroundedError(
                f"{log} is a stored trial, expected the file of a log"
                + f": its own is {stored.path}" * (verb != "ingest")
            )
    if given in workspace.candidate_ids():
        raise GroundedError(f"{log} is a candidate, expected the file of a log")


def _there_is(given: str, letter: str, known: Sequence[str]) -> str:
    """Return the name that was meant, as a question, else all names; "" if there are none."""
    short = _SHORT.fullmatch(given)
    meant = f"{letter}{int(short[1]):04d}" if short else ""
    if meant in known:
        return f"did you mean '{meant}'?"
    if len(known) == 1:
        return f"the only one is {known[0]}"
    return f"there are {ranges(known)}" if known else ""
