"""Reads the findings of a report from a workspace, even if some of its files are damaged.

A damaged or missing trial is left out and listed in `lost`; the rest is still shown. Only the task
(grounded.toml, model.py, target.csv) must be intact.
"""

from __future__ import annotations

from collections.abc import Collection
from contextlib import suppress
from dataclasses import replace

import numpy as np

from grounded.diagnosis.parts import Diagnosis
from grounded.errors import GroundedError
from grounded.frozen import Array
from grounded.search.planner import Planner
from grounded.search.standing import Standing
from grounded.solve.bias import residuals
from grounded.task import Task
from grounded.trial import Trial
from grounded_trials.report.findings import Findings, Log, Run
from grounded_trials.report.forecast import anchored
from grounded_trials.store.store import Lost
from grounded_trials.workspace.adoption import Better, adopted_rows, better_model
from grounded_trials.workspace.candidates.search_state import standing_in, undecided
from grounded_trials.workspace.folder import Contents, Folder
from grounded_trials.workspace.last_diagnosis import (
    read_diagnosis,
    since_diagnosis,
)
from grounded_trials.workspace.next_step import Situation

RUNAWAY = 1e15  # in any unit: larger values mean that a run diverged


def gather(workspace: Folder) -> Findings:
    """Read the findings of a report.

    Raises:
        GroundedError: if the task can't be built.
    """
    task, contents = workspace.task, workspace.read(strict=False)
    known, lost = {c.id for c in contents.candidates}, list(contents.lost)
    fitting = [t.trial for t in contents.trials if workspace.fits(t.trial)]
    own = [t for t in fitting if t.candidate in known]
    data = [t for t in fitting if not t.candidate]
    now = _standing(workspace, contents)

    # the last diagnosis, and the model with what it found
    diagnosis: Diagnosis | None = None
    better: Better | None = None
    try:
        diagnosis = read_diagnosis(workspace.reports)
    except GroundedError as error:
        lost.append(Lost("diagnosis.json", str(error)))
    try:
        named = diagnosis is not None and not diagnosis.no_cause
        better = better_model(workspace, diagnosis if named else None)
    except GroundedError as error:
        lost.append(Lost("the model as diagnosed", str(error)))
    since = since_diagnosis(workspace, diagnosis)
    return Findings(
        name=workspace.folder.resolve().name,
        task=task,
        nominal={name: p.value for name, p in workspace.origin.model.params.items()},
        effects=tuple(workspace.config.model.effects),
        method=_method(workspace),
        standing=now,
        runs=tuple(_runs(task, now, own, better, lost)),
        logs=tuple(Log(t, _residual(Planner(task, task), t)) for t in map(_drawable, data)),
        lost=tuple(lost),
        diagnosis=diagnosis,
        then=Situation(workspace, now).then,
        better=better,
        since=since,
        adopted=adopted_rows(workspace),
        estimated=_estimated(task, contents, {t.id for t in fitting}),
        folder=workspace.address,
    )


def _estimated(task: Task, contents: Contents, drawn: Collection[str]) -> tuple[str, ...]:
    """Return the states that a smoother filled in, in one of the trials that are drawn or more."""
    told = [t.meta.get("estimated", "").split(",") for t in contents.trials if t.trial.id in drawn]
    found = {name for names in told for name in names}
    return tuple(name for name in task.model.state_names if name in found)


def _standing(workspace: Folder, contents: Contents) -> Standing:
    """Return the standing, planned ahead if possible, to know whether the search has ended."""
    ahead, now = not workspace.config.search.refit, None
    with suppress(GroundedError):  # of damaged files
        now = standing_in(workspace, ahead=ahead, contents=contents)
        return undecided(workspace, now)
    return now or standing_in(workspace, contents=contents)


def _runs(
    task: Task, now: Standing, trials: list[Trial], better: Better | None, lost: list[Lost]
) -> list[Run]:
    by_id = {tried.candidate.id: tried for tried in now.history}
    runs = []
    for trial in trials:
        tried = by_id[trial.candidate]
        if trial.steps > task.horizon:
            reason = f"not drawn: it has {trial.steps} steps, the task has {task.horizon}"
            lost.append(Lost(trial.id, reason))
            continue
        utility, trial = task.utility(trial), _drawable(trial)
        residual = _residual(Planner(task, task), trial)
        explained = None if better is None else _residual(better.planner, trial)
        runs.append(Run(trial, tried.candidate, tried.accepted, utility, residual, explained))
    return runs


def _drawable(trial: Trial) -> Trial:
    """Replace values beyond `RUNAWAY`, which can't be drawn, by NaN."""
    if max(np.abs(trial.states).max(initial=0.0), np.abs(trial.inputs).max(initial=0.0)) < RUNAWAY:
        return trial
    states = np.where(np.abs(trial.states) < RUNAWAY, trial.states, np.nan)
    inputs = np.where(np.abs(trial.inputs) < RUNAWAY, trial.inputs, np.nan)
    return replace(trial, states=states, inputs=inputs)


def _residual(planner: Planner, trial: Trial) -> Array:
    """Return one-step residuals of the planning model, (T, n), NaN after the last finite step."""
    whole, n = trial.finite_steps, planner.task.model.n
    residual = np.full((trial.steps, n), np.nan)
    if whole > 0:
        part = anchored(planner, trial.until(whole))
        residual[:whole] = residuals(planner.plan, part)[:, :n]
    return residual


def _method(workspace: Folder) -> str:
    options = workspace.config.search
    words: list[str] = [options.method]
    if options.method == "ddp":
        words.append(f"{options.step} steps")
    if options.refit:
        words.append("parameters refitted")
    words.append(f"{options.repeats} trial{'s' * (options.repeats > 1)} a candidate")
    return ", ".join(words)
