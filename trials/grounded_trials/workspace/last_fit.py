"""The trials that a fit or a diagnosis is made from, and the last fit, reports/fit.json."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from grounded.errors import GroundedError
from grounded.fit import Fit
from grounded.result import Document
from grounded.share import Share, share_of
from grounded.trial import Trial
from grounded_trials.store.documents import read_as, write_document
from grounded_trials.store.store import made_folder
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.identity import named_trials
from grounded_trials.workspace.last_diagnosis import diagnosable

FILE = "fit.json"  # in reports/


def ids_of(trials: Sequence[Trial]) -> tuple[str, ...]:
    """Return the short names of trials."""
    return tuple(trial.id for trial in trials)


def chosen(workspace: Folder, names: Sequence[str] = ()) -> Share:
    """Return the trials to fit or to diagnose, or a share of them.

    States that were filled in by a smoother are no evidence: NaN again.

    Args:
        workspace: the workspace.
        names: short names of the trials; empty: all usable ones.

    Raises:
        GroundedError: if there is none, or one of those named can't be used.
    """
    used = diagnosable(workspace)
    names = named_trials(workspace, names, ids_of(used))
    share = share_of([trial for trial in used if not names or trial.id in names])
    guessed = {t.stored.id: t.meta.get("estimated", "").split(",") for t in workspace.trials()}
    measured: list[Trial] = []
    for trial in share.trials:
        states = trial.states.copy()
        states[:, [name in guessed[trial.id] for name in trial.state_names]] = math.nan
        measured.append(replace(trial, states=states))
    return replace(share, trials=measured)


@dataclass(frozen=True, eq=False, repr=False)
class LastFit(Document):
    """What the last fit of all parameters was made from, and what it found."""

    trials: tuple[str, ...] = ()
    model: str = ""  # fingerprint
    helps: bool = True  # whether it predicts better
    known: Mapping[str, tuple[float, ...]] = field(default_factory=dict)  # values with their std


def write_fit(workspace: Folder, used: Sequence[Trial], found: Fit) -> None:
    """Write what a fit was made from, whether it predicts better, and its values with their std."""
    known = {n: (e.value, e.std) for n, e in found.params.items() if math.isfinite(e.value + e.std)}
    last = LastFit(ids_of(used), workspace.planner.fingerprint, found.helps, known)
    write_document(made_folder(workspace.reports) / FILE, last.to_json())


def last_fit(workspace: Folder) -> LastFit:
    """Return the last fit of all parameters; an empty one without it, or if it can't be read."""
    try:
        return read_as(workspace.reports / FILE, LastFit) or LastFit()
    except GroundedError:
        return LastFit()


def fitted_in_vain(workspace: Folder, trials: Sequence[str] = ()) -> bool:
    """Return whether the current model was already fitted to the same trials without a gain.

    Args:
        workspace: the workspace.
        trials: short names; empty: all usable trials.
    """
    last = last_fit(workspace)
    if last.helps or last.model != workspace.planner.fingerprint:
        return False
    try:
        return last.trials == ids_of(chosen(workspace, trials).trials)
    except GroundedError:  # then fit again
        return False
