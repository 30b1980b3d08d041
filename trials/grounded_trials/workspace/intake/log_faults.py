"""Tell columns that are not what their names say: other units, signs, places or clocks.

The next plan is based on the log, so the operator has to know before the next run. Which account
tells how the log came about is judged by `grounded.accounts.judge`; here each gets its remedy: in
[log], in the program that wrote the trial, or on the robot.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import replace
from typing import Any

from grounded.accounts.commands import clocks_apart
from grounded.accounts.judge import contradicted, judge
from grounded.accounts.reported import names_of, reported
from grounded.accounts.sent import follows, latest
from grounded.accounts.table import Account, Told
from grounded.findings import Finding, found
from grounded.share import STEPS
from grounded.trial import Trial
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.intake import COLUMNS
from grounded_trials.workspace.last_diagnosis import diagnosable
from grounded_trials.workspace.readings import paths_of, read_by


def log_faults(workspace: Folder, trial: Trial, *, own: bool = False) -> tuple[Finding, ...]:
    """Return all faults found in the columns of a trial, with gaps bridged, in its first steps.

    `own` was written by grounded, and not read through [log].
    """
    trial = trial.until(STEPS)
    known = trial.until(trial.known_steps)
    faults = column_faults(workspace, known)
    faults += _clocks_apart(workspace, trial)
    return tuple(_mended(workspace, known, one, own=own) for one in faults)


def column_faults(workspace: Folder, known: Trial) -> list[Finding]:
    """Return the faults of columns: units, signs, places, dead sensors."""
    model = workspace.base_model
    if known.steps < 2:
        return []
    verdict = judge(model, [replace(known, id="")], range(model.n))
    return [one for told in verdict.told for one in _told(workspace, known, told)]


def _told(workspace: Folder, known: Trial, told: Told) -> Iterator[Finding]:
    """Yield an account as faults of the log, or of the robot."""
    first, *others = reported(workspace.base_model, told)
    if told.account.kind == "exchange" and (why := not_the_logs(workspace, known, told.account)):
        inputs = min(told.account.touched) >= workspace.base_model.n
        yield found("run.exchanged", *first.about, parts="wires" if inputs else "sensors", **why)
        return
    yield from (first, *others)


def _mended(workspace: Folder, known: Trial, one: Finding, *, own: bool) -> Finding:
    """Return a fault with what to do about it in this workspace."""
    task, facts = workspace.task, dict[str, Any]()
    if known.id:
        facts = {"trials": (known.id,), "source": "trial" if own else "log"}
    if own and one.code in COLUMNS:
        units = {**task.model.states, **task.model.inputs}
        writes = tuple(dict.fromkeys(units[name] for name in one.about))
        return one.also(tables=(), writes=writes, **facts)
    return one.also(**facts)


def not_the_logs(
    workspace: Folder, trial: Trial, fault: Account, *, commands: bool = False
) -> dict[str, Any]:
    """Return what shows that a sign or an exchange is not the log's; empty if it may be.

    Which term needs it tells where it lies: the log, if both the commands of its candidate and the
    motion are right without it; the program, if the robot moved as logged; the robot, if the
    program sent as logged. Other trials that [log] read in the same way may show none. Either the
    `commands` need the fault, or the motion does.
    """
    model, known = workspace.base_model, trial.until(trial.known_steps)
    right = without(workspace, trial, fault)
    shown: dict[str, Any] = {"proven": tuple(right)} if right else {}
    if commands and contradicted(model, known, range(model.n), fault):
        shown["moved"] = "as the log says"
    return shown or ({"ran": trial.candidate} if _as_sent(workspace, trial, fault) else {})


def without(workspace: Folder, trial: Trial, fault: Account) -> list[str]:
    """Return the other trials that were read in the same way and contradict a fault."""
    model, mapping = workspace.base_model, workspace.log_mapping
    names = names_of(model, sorted(fault.touched))
    metas = {one.stored.id: one.meta for one in workspace.whole_trials()}
    metas |= {one.stored.id: one.meta for one in workspace.aside_trials()}
    now = read_by(mapping) if mapping else {}
    read = {name: paths_of(meta, names) for name, meta in metas.items()}
    own = read.get(trial.id, paths_of(now, names))
    return [
        one.id
        for one in diagnosable(workspace)
        if one.id != trial.id
        and read.get(one.id) == own
        and contradicted(model, one, range(model.n), fault)
    ]


def _as_sent(workspace: Folder, trial: Trial, fault: Account) -> bool:
    """Return whether a run's commands are its candidate's, and would not be without a fault."""
    if trial.candidate not in workspace.candidate_ids():
        return False
    policy, late = workspace.candidate(trial.candidate)[0].policy, latest(workspace.task)
    run = trial.until(policy.horizon)
    logged, mended = (follows(policy, one, late) for one in (run, fault.mended(run)))
    return logged is not None and logged.alike and not (mended is not None and mended.alike)


def _clocks_apart(workspace: Folder, trial: Trial) -> list[Finding]:
    """Return a fault if measured states respond to commands before they are sent."""
    model, estimates = workspace.base_model, workspace.config.estimate
    measured: Collection[str] = model.state_names
    if estimates.values:
        from grounded_trials.workspace.intake.opening.estimating import read_estimate

        measured = read_estimate(estimates, model).measured
    shown = [i for i, name in enumerate(model.state_names) if name in measured]
    early = clocks_apart(model, trial, shown)
    return [early] if early else []
