"""Compare the standing of the search with what it would be without some trials.

A run that was ingested despite a warning may change which candidate is the best, most visibly if it
contradicts the candidate's other runs: the search compares means. A run may also settle a doubt: a
loss is in doubt, and the best candidate is handed out to be run again. Before its log is there,
another run of the loser settles the doubt. The robot may have run the best one meanwhile, so its
log is taken all the same.
"""

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

FAR = 5.0  # standard deviations of a candidate's other runs by which a run counts as odd
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
    """Return that a doubted run counts, and how it changed its candidate's utility.

    Args:
        workspace: the workspace with the trials.
        now: the standing of the search including the run.
        identity: the run's id, such as t0011.
        aside: whether it is to be set aside unless the user goes on with it.
    """
    after = _of(now, identity)
    if after is None:
        return ()
    name, then = after.candidate.id, NextCommand("discard", (identity,))
    undo = rendered(then, workspace.address)
    counts = found(
        "search.counts", identity, then=then, candidate=name, undo=undo, aside=int(aside)
    )
    if aside or len(after.utilities) < 3 or now.incumbent is None:
        return (counts,)
    was = standing_without(workspace, {identity})
    before = next((t for t in was.history if t.candidate.id == name), None)
    if before is None or len(before.utilities) < 2 or not before.deviation > 0:
        return (counts,)
    n, run = len(before.utilities), after.utilities[[t.id for t in after.trials].index(identity)]
    if not abs(run - before.utility) > FAR * before.deviation * (1 + 1 / n) ** 0.5:
        return (counts,)
    best = now.incumbent.candidate.id
    dethroned = was.incumbent is not None and was.incumbent.candidate.id == name != best
    changed = {"was": before.utility, "now": after.utility, "run": run, "runs": n}
    return (counts.knowing({**changed, "best": best if dethroned else None}),)


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


def no_longer(workspace: Folder, trial: str, now: Standing) -> list[Finding]:
    """Return that a trial that was just stored settled a doubt without the run asked for.

    Args:
        workspace: the workspace.
        trial: id of that trial.
        now: the standing with it.
    """
    tried = _of(now, trial)
    if tried is None or len(tried.trials) < 2:
        return []
    before = standing_without(workspace, {trial})
    waited, doubt = before.outstanding, next((t for t in before.history if t.in_doubt), None)
    if waited is None or doubt is None or tried.candidate.id == waited.id:
        return []
    if now.outstanding is not None and now.outstanding.id == waited.id:
        return []
    name, loser = waited.id, doubt.candidate.id
    return [found("search.settled", name, candidate=name, loser=loser)]
