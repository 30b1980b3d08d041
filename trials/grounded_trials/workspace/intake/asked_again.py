"""Runs that the search asked for and, by what was ingested since, no longer needs.

A loss is in doubt, and the best candidate is handed out to be run again. Before its log is there,
another run of the loser settles the doubt. The robot may have run the best one meanwhile, so its
log is taken all the same.
"""

from __future__ import annotations

from collections.abc import Collection

from grounded.search.standing import Standing, standing
from grounded_trials.workspace.folder import Folder

LATEST = 4  # latest hand-outs that are looked at


def asked_again(workspace: Folder) -> str:
    """Return the id of a candidate that was asked for, and handed out, but not run since; or ""."""
    for name, after in reversed(workspace.noted.hand_outs[-LATEST:]):
        number = int(after[1:].split("-")[0]) if after else 0
        later = [t for t in workspace.trials() if t.stored.number > number]
        if any(t.trial.candidate == name for t in later):
            continue
        waiting = _without(workspace, {t.stored.id for t in later}).outstanding
        if waiting is not None and waiting.id == name:
            return name
    return ""


def no_longer(workspace: Folder, trial: str, now: Standing) -> list[str]:
    """Return a note if a trial that was just stored settled a doubt without the run asked for.

    Args:
        workspace: the workspace.
        trial: id of that trial.
        now: the standing with it.
    """
    tried = next((t for t in now.history if any(one.id == trial for one in t.trials)), None)
    if tried is None or len(tried.trials) < 2:
        return []
    before = _without(workspace, {trial})
    waited, doubt = before.outstanding, next((t for t in before.history if t.in_doubt), None)
    if waited is None or doubt is None or tried.candidate.id == waited.id:
        return []
    if now.outstanding is not None and now.outstanding.id == waited.id:
        return []
    name = waited.id
    return [
        f"{name} need not be run once more: by this run, the loss of {doubt.candidate.id} is in "
        f"doubt no longer. If the robot has run {name} meanwhile, that log still counts"
    ]


def _without(workspace: Folder, ids: Collection[str]) -> Standing:
    """Return the standing of the search without some trials."""
    trials = [t for t in workspace.task_trials() if t.id not in ids]
    options, model = workspace.config.search, workspace.planner.fingerprint
    return standing(workspace.task, workspace.read().candidates, trials, options, model)
