"""From a workspace to the findings of a report, whatever state its files are in.

A trial that is damaged or gone is left out and named: the rest is shown all the same. Only the task
itself (grounded.toml, model.py, target.csv) must be whole, for without it nothing has a meaning.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from grounded.errors import GroundedError
from grounded.frozen import Array
from grounded.search.planner import Planner
from grounded.search.standing import Candidate, Standing, standing, utility_noise
from grounded.solve.bias import residuals
from grounded.task import Task
from grounded.trial import Trial, interpolate_gaps
from grounded_trials.report.findings import Findings, Log, Lost, Run
from grounded_trials.store.trial_file import read_trial
from grounded_trials.workspace.adopting import Better, better_model
from grounded_trials.workspace.diagnosing import LEAST_STEPS
from grounded_trials.workspace.diagnosis_file import Diagnosis, read_diagnosis
from grounded_trials.workspace.folder import Workspace, candidate_of
from grounded_trials.workspace.next_step import Since, next_command, since_diagnosis

RUNAWAY = 1e15  # in any unit: the number of a run that diverged


def gather(workspace: Workspace) -> Findings:
    """Reads all that a report shows.

    Raises:
        GroundedError: if the task can't be built.
    """
    task = workspace.task
    trials, policies, lost = _trials(workspace)
    candidates = _candidates(workspace, trials, policies, lost)
    own = [t for t in trials if _fits(task, t) and t.candidate in {c.id for c in candidates}]
    data = [_drawable(t) for t in trials if _fits(task, t) and not t.candidate]
    now = _settled(workspace, candidates, own, _standing(workspace, candidates, own))
    diagnosis = _diagnosis(workspace, lost)
    better = _better(workspace, diagnosis, lost)
    usable = [t.id for t in trials if _fits(task, t) and t.known_steps >= LEAST_STEPS]
    return Findings(
        name=workspace.folder.resolve().name,
        task=task,
        nominal={name: p.value for name, p in workspace.base_model.params.items()},
        effects=tuple(str(e["name"]) for e in workspace.config.model.effects),
        method=_method(workspace),
        standing=now,
        runs=tuple(_runs(task, now, own, better, lost)),
        logs=tuple(Log(t, _residual(Planner(task, task), t)) for t in data),
        others=len(trials) - len(own) - len(data),
        lost=tuple(lost),
        diagnosis=diagnosis,
        optimum=_optimum(workspace.reports),
        noise=utility_noise(now.history)[0],
        next_command=next_command(workspace, now, diagnosis, usable),
        better=better,
        since=since_diagnosis(workspace, diagnosis, usable) if diagnosis else Since(),
    )


def _trials(workspace: Workspace) -> tuple[list[Trial], dict[str, bytes], list[Lost]]:
    """The readable trials, the policies that they carry, and what is damaged or gone."""
    trials: list[Trial] = []
    policies: dict[str, bytes] = {}
    lost: list[Lost] = []
    numbers = []
    for stored in workspace.store.list():
        numbers.append(stored.number)
        try:
            trial, _, policy = read_trial(workspace.store.read(stored), stored.path.name)
        except GroundedError as error:
            lost.append(Lost(stored.path.name, str(error)))
            continue
        trials.append(interpolate_gaps(replace(trial, id=stored.id)).trial)
        if policy is not None:
            policies.setdefault(trial.candidate, policy)
    for number in sorted(set(range(1, max(numbers, default=0))) - set(numbers)):
        name = f"{workspace.store.prefix}{number:04d}"
        lost.append(Lost(name, f"trials/ has no file of the number {name}: it was removed"))
    return trials, policies, lost


def _candidates(
    workspace: Workspace, trials: list[Trial], policies: dict[str, bytes], lost: list[Lost]
) -> list[Candidate]:
    """The search's candidates of this task, from their files or from trials that ran them."""
    files = {path.stem for path in (workspace.folder / "candidates").glob("c[0-9]*.mcap")}
    found = []
    named = {t.candidate for t in trials if t.candidate}
    for identity in sorted(name for name in files | named if re.fullmatch(r"c\d+", name)):
        path = workspace.candidate_path(identity)
        sources = [path.read_bytes()] if path.is_file() else []
        sources += [policies[identity]] if identity in policies else []
        reason = "its file is gone and no trial carries it"
        for data in sources:
            try:
                candidate, meta = candidate_of(data, f"candidates/{identity}.mcap")
            except GroundedError as error:
                reason = str(error)
                continue
            if meta.get("kind") == "search" and meta.get("task") == workspace.task.hash:
                found.append(candidate)
            break
        else:
            lost.append(Lost(f"{identity}.mcap", reason))
    return found


def _fits(task: Task, trial: Trial) -> bool:
    names = (task.model.state_names, task.model.input_names)
    return (trial.state_names, trial.input_names) == names and abs(trial.dt - task.dt) < 1e-9


def _standing(workspace: Workspace, candidates: list[Candidate], trials: list[Trial]) -> Standing:
    from grounded.search.improve import model_fingerprint

    task, options = workspace.task, workspace.config.search
    return standing(task, candidates, trials, options, model_fingerprint(workspace.planner.plan))


def _settled(
    workspace: Workspace, candidates: list[Candidate], trials: list[Trial], now: Standing
) -> Standing:
    """The standing, ended where the model sees nothing more to gain: only planning can tell."""
    from grounded.search.improve import propose

    options = workspace.config.search
    if now.phase != "propose" or now.incumbent is None or options.refit:
        return now
    try:
        planner = workspace.planner
        return propose(workspace.task, candidates, trials, options, planner=planner).standing
    except GroundedError:
        return now


def _better(workspace: Workspace, diagnosis: Diagnosis | None, lost: list[Lost]) -> Better | None:
    try:
        return better_model(workspace, diagnosis)
    except GroundedError as error:
        lost.append(Lost("the model as diagnosed", str(error)))
        return None


def _runs(
    task: Task, now: Standing, trials: list[Trial], better: Better | None, lost: list[Lost]
) -> list[Run]:
    by_id = {tried.candidate.id: tried for tried in now.history}
    runs = []
    for trial in trials:
        tried = by_id[trial.candidate]
        if trial.steps > task.horizon:
            reason = f"it has {trial.steps} steps, the task has {task.horizon}: not drawn"
            lost.append(Lost(trial.id, reason))
            continue
        utility, trial = task.utility(trial), _drawable(trial)
        residual = _residual(Planner(task, task), trial)
        explained = None if better is None else _residual(better.planner, trial)
        runs.append(Run(trial, tried.candidate, tried.accepted, utility, residual, explained))
    return runs


def _drawable(trial: Trial) -> Trial:
    """A trial whose runaway numbers are NaN, as lost samples are: they can't be drawn."""
    if max(np.abs(trial.states).max(initial=0.0), np.abs(trial.inputs).max(initial=0.0)) < RUNAWAY:
        return trial
    states, inputs = (
        np.where(np.abs(v) < RUNAWAY, v, np.nan) for v in (trial.states, trial.inputs)
    )
    return replace(trial, states=states, inputs=inputs)


def _residual(planner: Planner, trial: Trial) -> Array:
    """One-step residuals of the planning model, (T, n), NaN after the last finite step."""
    whole, n = trial.finite_steps, planner.task.model.n
    residual = np.full((trial.steps, n), np.nan)
    if whole > 0:
        part = replace(trial, states=trial.states[: whole + 1], inputs=trial.inputs[:whole])
        residual[:whole] = residuals(planner.plan, planner.lift(part))[:, :n]
    return residual


def _diagnosis(workspace: Workspace, lost: list[Lost]) -> Diagnosis | None:
    try:
        return read_diagnosis(workspace.reports)
    except GroundedError as error:
        lost.append(Lost("diagnosis.json", str(error)))
        return None


def _optimum(reports: Path) -> float | None:
    """reports/optimum.json, {"utility": U}: written by studies that know the real system."""
    try:
        value = float(json.loads((reports / "optimum.json").read_text())["utility"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return value if math.isfinite(value) else None


def _method(workspace: Workspace) -> str:
    options = workspace.config.search
    words: list[str] = [options.method]
    if options.method == "ddp":
        words.append(f"{options.step} steps")
    if options.refit:
        words.append("parameters refitted")
    words.append(f"{options.repeats} trial{'s' * (options.repeats > 1)} a candidate")
    return ", ".join(words)
