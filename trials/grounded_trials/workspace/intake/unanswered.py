"""Repeat, in `status`, why the last trial should be discarded, until something is done about it.

`ingest` asks it once. The user has decided once the trial is discarded, or restored, or once a
candidate was handed out after it.
"""

from __future__ import annotations

from grounded.errors import NextCommand
from grounded.trial import interpolate_gaps
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.identity import StoredTrial
from grounded_trials.workspace.intake.begun import begun_elsewhere
from grounded_trials.workspace.intake.ended_early import ended_early
from grounded_trials.workspace.intake.gone_wrong import gone_wrong
from grounded_trials.workspace.intake.log_faults import log_faults
from grounded_trials.workspace.intake.skipped_steps import steps_skipped


def unanswered(workspace: Folder) -> tuple[tuple[str, ...], NextCommand | None]:
    """Return why the last trial should be discarded, a sentence each, and the command for it.

    Args:
        workspace: the workspace with the trials.

    Returns:
        (), None if nothing is wrong with it, if it ran another policy of a candidate's name, or if
        the user has decided.
    """
    last = next((one for one in reversed(workspace.trials()) if workspace.fits(one.trial)), None)
    if last is None or "~" in last.trial.candidate or _decided(workspace, last):
        return (), None
    trial, own = last.trial, "source" not in last.meta
    told = [one.told(trial, own=own) for one in log_faults(workspace, trial)]
    told += filter(None, [steps_skipped(workspace, last.measured)])
    begun = begun_elsewhere(workspace, last.measured)
    told += [begun.told] if begun and begun.again else []
    if not told:
        from grounded_trials.workspace.proposing import standing_in

        history = standing_in(workspace).history
        tried = next((t for t in history if t.candidate.id == trial.candidate), None)
        wrong = gone_wrong(workspace, interpolate_gaps(trial).trial, tried, history)
        early = ended_early(workspace, last.measured)
        told = [one.said for one in (wrong, early) if one and one.aside][:1]
    name = last.stored.id
    then = NextCommand("discard", (name,)) if told else None
    return tuple(f"{name}: {one}" for one in told), then


def _decided(workspace: Folder, last: StoredTrial) -> bool:
    """Return whether a trial was restored, or a candidate handed out after it."""
    noted, stored = workspace.noted, last.stored
    after = max((int(name[1:].split("-")[0]) for name in noted.last if name), default=0)
    return after >= stored.number or bool({stored.path.stem, stored.digest} & noted.kept)
