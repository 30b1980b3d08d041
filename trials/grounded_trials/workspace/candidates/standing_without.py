"""The standing of the search as it would be without some trials."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING

from grounded.errors import NextCommand
from grounded.findings import Finding, found
from grounded.search.standing import Standing, standing
from grounded_trials.wording import rendered
from grounded_trials.workspace.folder import Folder

if TYPE_CHECKING:
    from grounded.search.candidate import Tried

LATEST = 4  # latest hand-outs that are looked at


def standing_without(workspace: Folder, ids: Collection[str]) -> Standing:
    """Return the standing of the search without some trials."""
    trials = [t for t in workspace.task_trials() if t.id not in ids]
    task, options, planner = workspace.task, workspace.config.search, workspace.planner
    candidates = workspace.read().candidates
    return standing(task, candidates, trials, options, planner.fingerprint, planner)


def odd_run(
    workspace: Folder, now: Standing, identity: str, *, aside: bool = False
) -> tuple[Finding, ...]:
    """Return that a doubted run counts, and how to undo that.

    Args:
        workspace: the workspace with the trials.
        now: the standing of the search including the run.
        identity: the run's id, such as t0011.
        aside: whether it is to be set aside unless the user goes on with it.
    """
    after = _of(now, identity)
    if after is None:
        return ()
    then = NextCommand("discard", (identity,))
    undo, name = rendered(then, workspace.address), after.candidate.id
    one = found("search.counts", identity, then=then, candidate=name, undo=undo, aside=int(aside))
    return (one,)


def _of(now: Standing, identity: str) -> Tried | None:
    """Return the candidate that a run is averaged into."""
    runs = ((tried, [trial.id for trial in tried.trials]) for tried in now.history)
    return next((tried for tried, ids in runs if identity in ids), None)


def asked_again(workspace: Folder) -> str:
    """Return the id of a candidate that was asked for, and handed out, but not run since; or ""."""
    for name, after in reversed(workspace.noted.hand_outs[-LATEST:]):
        number = int(after[1:].split("-")[0]) if after else 0
        later = [t for t in workspace.trials() if t.stored.number > number]
        if any(t.trial.candidate == name for t in later):
            continue
        waiting = standing_without(workspace, {t.stored.id for t in later}).outstanding
        if waiting is not None and waiting.id == name:
            return name
    return ""
