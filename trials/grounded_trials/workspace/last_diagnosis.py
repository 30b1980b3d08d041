"""The last diagnosis of a workspace, in reports/, and the trials that the next can use.

A diagnosis uses the stored trials up to the first missing input or unbounded number; gaps in single
states stay gaps. The file may come from another version or an untrusted source, so no text in it is
trusted.

`Since` describes what changed after a diagnosis: newer trials, adopted effects, other parameters. A
verdict refers to the model and the trials of its time; effects adopted since are no longer missing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from grounded.errors import GroundedError, NextCommand
from grounded.findings import Finding, found
from grounded.search.planner import model_fingerprint
from grounded_trials.store.documents import read_as, write_document
from grounded_trials.store.store import made_folder
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.identity import named_trials, sha256
from grounded_trials.workspace.user_files.config import listed

if TYPE_CHECKING:
    from grounded.diagnosis.parts import Diagnosis
    from grounded.share import Share
    from grounded.trial import Trial

FILE = "diagnosis.json"  # in reports/
LEAST_STEPS = 2


def write_diagnosis(folder: Path, found: Diagnosis) -> None:
    """Write a diagnosis to a reports folder, which is made if it is missing."""
    write_document(made_folder(folder) / FILE, found.to_json())


def read_diagnosis(folder: Path) -> Diagnosis | None:
    """Read the diagnosis in a reports folder; return None if there is none."""
    if not (folder / FILE).exists():
        return None
    from grounded.diagnosis.parts import Diagnosis  # slow, and seldom needed

    then = NextCommand("diagnose")
    return read_as(folder / FILE, Diagnosis, mend="diagnosis", then=then)


def readable_diagnosis(folder: Path) -> Diagnosis | None:
    """Read the diagnosis in a reports folder; a damaged one counts as none."""
    try:
        return read_diagnosis(folder)
    except GroundedError:
        return None


# trials


def diagnosable(workspace: Folder) -> list[Trial]:
    """Return the trials in order of arrival, each up to the first missing or unbounded number.

    A sensor dropout only costs its own samples, not the rest of the trial.
    """
    cut = [trial.until(trial.known_steps) for trial in workspace.task_trials(measured=True)]
    return [trial for trial in cut if trial.steps >= LEAST_STEPS]


def usable_ids(workspace: Folder) -> list[str]:
    """Return the ids of the undamaged trials that a diagnosis can use, in order of arrival."""
    logs = [one.measured for one in workspace.whole_trials()]
    return [log.id for log in logs if workspace.fits(log) and log.known_steps >= LEAST_STEPS]


def chosen(workspace: Folder, names: Sequence[str] = ()) -> Share:
    """Return the named trials, or all usable ones, to fit or to diagnose; or a share of them.

    States that were filled in by a smoother are no evidence: NaN again.
    """
    from grounded.share import share_of

    used = diagnosable(workspace)
    names = named_trials(workspace, names, [trial.id for trial in used])
    share = share_of([trial for trial in used if not names or trial.id in names])
    guessed = {t.stored.id: t.meta.get("estimated", "").split(",") for t in workspace.trials()}
    measured: list[Trial] = []
    for trial in share.trials:
        states = trial.states.copy()
        states[:, [name in guessed[trial.id] for name in trial.state_names]] = math.nan
        measured.append(replace(trial, states=states))
    return replace(share, trials=measured)


def left_out(workspace: Folder) -> list[Finding]:
    """Return which trials nothing can use, since [task] dt or the model was changed."""
    others = [one.stored.id for one in workspace.trials() if not workspace.fits(one.trial)]
    return [found("search.left_out", *others)] if others else []


# what changed since a diagnosis


@dataclass(frozen=True)
class Since:
    """What changed since a diagnosis was made."""

    used: int = 0  # usable trials that the diagnosis was made from
    usable: int = 0  # trials that a diagnosis can use now
    newer: int = 0  # usable trials that arrived after the diagnosis
    adopted: tuple[str, ...] = ()  # effects that are part of the model now, claimed ones first
    missing: tuple[str, ...] = ()  # claimed effects that are not, if others are
    changed: bool = False  # the diagnosis was made with another model
    further: bool = False  # it left more to be found than it was allowed to claim

    @property
    def settled(self) -> bool:
        """Whether another diagnosis would only repeat this one.

        It is of all trials, and the model is the one that it had, or has all that it claimed and
        there was nothing more to look for.
        """
        adopted = self.used > 0 and bool(self.adopted) and not self.missing and not self.further
        return not self.newer and (adopted or not self.changed)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Why the diagnosis is outdated; () if it is not."""
        only = self.changed and not self.adopted
        if not (self.newer or self.adopted or only):
            return ()
        one = found(
            "search.outdated",
            used=self.used if self.newer else None,
            usable=self.usable,
            adopted=self.adopted,
            missing=self.missing,
            changed=int(only),
        )
        return (one,)

    @property
    def sentence(self) -> str:
        """Why the diagnosis is outdated, in words; "" if it is not."""
        return "; ".join(one.sentence for one in self.findings)


def model_print(workspace: Folder) -> str:
    """Return a fingerprint of the planning model and of its [limits], wherever runs start."""
    task = workspace.planner.plan
    apart = replace(task, start=np.zeros(task.model.n), past=np.zeros(task.model.m))
    ends = repr((task.low.tolist(), task.high.tolist())).encode()
    return sha256(model_fingerprint(apart).encode() + ends)[:16]


def since_diagnosis(workspace: Folder, diagnosis: Diagnosis | None) -> Since:
    """Return what changed in a workspace since a diagnosis was made; nothing without one."""
    if diagnosis is None:
        return Since()
    model, made, usable = workspace.config.model, diagnosis.made, usable_ids(workspace)
    last = max((k for k, name in enumerate(usable) if name in made.trials), default=-1)

    # the effects of the model now, of those that it claims and of others
    now = listed(model.effects)
    missing = diagnosis.open(now, model.params)
    adopted = [name for name in diagnosis.effects if name not in missing]
    known = {*made.effects, *diagnosis.effects}
    adopted += [name for name in model.effects if name not in known]
    same = now == [*map(dict, made.adopted)]
    same = same and made.params in (None, dict(model.params))
    return Since(
        used=sum(name in made.trials for name in usable),
        usable=len(usable),
        newer=len(usable) - 1 - last if made.trials else 0,
        adopted=tuple(adopted),
        missing=missing if adopted else (),
        changed=not same or made.model not in ("", model_print(workspace)),
        further=diagnosis.verdict.again,
    )


def newer_alone(diagnosis: Diagnosis) -> NextCommand:
    """Return the diagnosis of the newer of the two groups that a diagnosis compared."""
    made = diagnosis.made
    newer = max(made.named, made.compared, key=lambda group: max(group, default=""))
    return NextCommand("diagnose", ("--trials", ",".join(newer)))
