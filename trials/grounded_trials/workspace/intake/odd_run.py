"""Say what a run counts for that was ingested with `--candidate` despite a warning.

The search compares the means of candidates' runs. A run that does not belong to a candidate may
change which one is the best, most visibly if it contradicts the candidate's other runs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from grounded.errors import NextCommand
from grounded_trials.wording import rendered
from grounded_trials.workspace.folder import Folder

if TYPE_CHECKING:
    from grounded.search.candidate import Tried
    from grounded.search.standing import Standing

FAR = 5.0  # standard deviations of a candidate's other runs by which a run counts as odd


def odd_run(workspace: Folder, now: Standing, identity: str) -> tuple[str, ...]:
    """Return a note on a doubted run: that it counts, or how it changed its candidate's utility.

    Args:
        workspace: the workspace with the trials.
        now: the standing of the search including the run.
        identity: the run's id, such as t0011.
    """
    from grounded.search.standing import standing

    after = _of(now, identity)
    if after is None:
        return ()
    undo = rendered(NextCommand("discard", (identity,)), workspace.address)
    counts = (
        f"it counts as a run of {after.candidate.id} all the same, because --candidate says so. To "
        f"undo this: `{undo}`",
    )
    if len(after.utilities) < 3 or now.incumbent is None:
        return counts
    others = [trial for trial in workspace.task_trials() if trial.id != identity]
    candidates = workspace.read().candidates
    model = workspace.planner.fingerprint
    was = standing(workspace.task, candidates, others, workspace.config.search, model)
    before = next((t for t in was.history if t.candidate.id == after.candidate.id), None)
    if before is None or len(before.utilities) < 2 or not before.deviation > 0:
        return counts
    n, run = len(before.utilities), after.utilities[[t.id for t in after.trials].index(identity)]
    if not abs(run - before.utility) > FAR * before.deviation * (1 + 1 / n) ** 0.5:
        return counts
    name, best = before.candidate.id, now.incumbent.candidate.id
    dethroned = was.incumbent is not None and was.incumbent.candidate.id == name != best
    return (
        f"the utility of {name} changes from {before.utility:.4g} to {after.utility:.4g}"
        f"{f', and {best} is the best now' * dethroned}: that of this run, {run:.4g}, is far from "
        f"its other {n}, which scatter by {before.deviation:.2g}. To undo this: `{undo}`",
    )


def _of(now: Standing, identity: str) -> Tried | None:
    """Return the candidate that a run is averaged into."""
    runs = ((tried, [trial.id for trial in tried.trials]) for tried in now.history)
    return next((tried for tried, ids in runs if identity in ids), None)
