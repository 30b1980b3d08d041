"""Where the runs of a robot began, and how far these starts scatter about [task] start.

People, or a rig, place the robot before each run. How exactly is a property of the placing, not of
one manoeuvre: so a run counts whatever its task was, with its start relative to the [task] start it
was planned for, and so does one that was discarded, since it too was placed.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from grounded.errors import GroundedError
from grounded.frozen import Array
from grounded.result import Document
from grounded.search.candidate import Candidate
from grounded.search.starts import worth_of_start
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.identity import StoredTrial, candidate_of

FEWEST = 2  # runs from which a scatter is estimated
UNLIKE = 3.0  # times the others' rms: a discarded run that began farther off is left out
TRIED = 20  # latest starts from which a candidate is predicted
LATEST = 50  # runs that are looked at; the way of placing a robot may change


@dataclass(frozen=True)
class Placing:
    """How far runs began off [task] start.

    Args:
        off: start states less the [task] start of each run (N, n).
        rms: how far they usually begin off (n,), without discarded runs that began far from all
            others; NaN where too few runs are known.
        runs: how many runs each of these rests on, (n,).
    """

    off: Array
    rms: Array
    runs: Array


@dataclass(frozen=True, eq=False)
class FromStarts(Document):
    """What a candidate is predicted to be worth from where the latest runs began.

    Args:
        utility_change: mean change of its utility against one from [task] start exactly.
        std: standard deviation of single runs due to the start alone.
        runs: how many runs that rests on.
    """

    utility_change: float
    std: float
    runs: int


def from_starts(workspace: Folder, made: Candidate) -> FromStarts | None:
    """Predict a candidate from where the latest runs of the robot began.

    Returns:
        None if too few runs are known, or if the model fails from one of those starts.
    """
    starts = placing(workspace).off[-TRIED:]
    if len(starts) <= FEWEST:
        return None
    worth = [worth_of_start(workspace.planner, made.policy, off) for off in starts]
    if not np.isfinite(worth).all():
        return None
    return FromStarts(float(np.mean(worth)), float(np.std(worth, ddof=1)), len(worth))


def placing(workspace: Folder, but: str = "") -> Placing:
    """Return how far the latest runs of a workspace's robot began off their [task] start.

    Args:
        workspace: the workspace with the trials, also those that are set aside.
        but: id of a run that is left out, since it is judged by the others.
    """
    n, runs = workspace.base_model.n, [(one, False) for one in workspace.trials()]
    runs += [(one, True) for one in workspace.aside_trials()]
    runs.sort(key=lambda run: run[0].stored.number)
    found = [(off, aside) for one, aside in runs for off in _off(workspace, one, but)][-LATEST:]
    off = np.array([run[0] for run in found]).reshape(len(found), n)

    # one that was discarded and began elsewhere, or was misread, says nothing about the others
    used = np.ones(off.shape, bool)
    for k in np.flatnonzero([aside for _, aside in found]):
        others = np.delete(off, k, axis=0)
        enough = len(others) >= FEWEST
        used[k] = enough & (np.abs(off[k]) <= UNLIKE * np.sqrt((others**2).sum(0) / len(off)))
    columns = [off[used[:, i], i] for i in range(n)]
    rms = [float(np.sqrt((x**2).mean())) if len(x) >= FEWEST else np.nan for x in columns]
    return Placing(off[used.all(axis=1)], np.array(rms), np.array([len(x) for x in columns]))


def _off(workspace: Folder, one: StoredTrial, but: str) -> Iterator[Array]:
    """Yield how far a run began off the start that its candidate was planned for; nothing of data.

    Where [task] start was moved since to where the robot does begin, it is how far the run began
    off the new one. Runs of a model with other states are left out.
    """
    trial, model = one.trial, workspace.base_model
    same = trial.state_names == model.state_names
    if not (trial.candidate and same and one.stored.id != but and np.isfinite(trial.began).all()):
        return
    if one.meta.get("task") == workspace.task.hash:
        yield model.difference(trial.began, workspace.task.start)
        return
    with suppress(GroundedError):  # a candidate that is gone or damaged
        name = trial.candidate.split("~")[0]
        data = one.policy or workspace.candidate_bytes(name)
        planned = candidate_of(data, name)[0].predicted_states[0]
        then, now = (model.difference(trial.began, x) for x in (planned, workspace.task.start))
        yield np.where(np.abs(now) < np.abs(then), now, then)
