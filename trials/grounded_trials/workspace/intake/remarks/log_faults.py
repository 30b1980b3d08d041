"""Tell columns that are not what their names say: other units, signs, places or clocks.

The next plan is based on the log, so the operator has to know before the next run. Which account
tells how the log came about is judged by `grounded.accounts.judge`; here each is reported with its
correction, in [log] or in the program that wrote the trial, or on the robot.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from grounded.model import Model
from grounded.result import listed
from grounded.share import STEPS
from grounded.task import Task
from grounded.trial import Trial
from grounded_trials.wording import ranges
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.read_before import paths_of, read_by

if TYPE_CHECKING:
    from grounded.accounts.judge import Told
    from grounded.accounts.table import Account

# multiples of [safety]: an angle beyond TURNS as radians, but inside WIDER as degrees, is suspect
TURNS, WIDER = 5.0, 2.0
COVER = 0.9  # share of the largest command in a log that [limits] in its unit must reach


@dataclass(frozen=True)
class Fault:
    """A fault of a log and its correction.

    Args:
        said: the fault, in a clause or two.
        mend: what to change in [log], an imperative; "" if `said` includes it.
        program: what the program that writes trials should do instead; "" if `said` includes it.
        robot: why the robot is at fault and not the log, and what to undo on it: sentences.
        kind: that of the account: unit, sign, exchange, dead, offset, axes, pace or clock.
        inputs: the inputs that are in another unit.
        factor: how many times too large these are, below 1 too small.
        names: all columns that are at fault, but exchanged ones.
    """

    said: str
    mend: str = ""
    program: str = ""
    inputs: tuple[str, ...] = ()
    factor: float = 1.0
    robot: str = ""
    kind: str = ""
    names: tuple[str, ...] = ()

    def told(self, trial: Trial, *, own: bool) -> str:
        """Return the warning; `own` is for a trial that was written by grounded, not a log."""
        if self.robot:
            again = f", `discard {trial.id}`" * bool(trial.id)
            again += f" and {f'run {trial.candidate}' if trial.candidate else 'record it'} again"
            return f"{self.said}. {self.robot}{again}"
        if own:
            should = f": it should {self.program}" * bool(self.program)
            again = f", `discard {trial.id}`" * bool(trial.id)
            again += f" and run {trial.candidate} again" * bool(trial.candidate)
            return f"{self.said}. Fix the program that writes the trials{should}{again}"
        if not self.mend:
            return self.said
        again = f"then discard {trial.id} and ingest the log again" if trial.id else ""
        end = "" if self.said.endswith("?") else "."
        return f"{self.said}{end} {self.mend}, {again or 'and ingest it again'}"


def log_faults(workspace: Folder, trial: Trial) -> tuple[Fault, ...]:
    """Return all faults found in the columns of a trial.

    Args:
        workspace: the workspace with the model and [safety].
        trial: the trial, with gaps bridged; of a long one its first steps are looked at.
    """
    trial = trial.until(STEPS)
    known = trial.until(trial.known_steps)
    found = column_faults(workspace, known)
    if not any(told.kind == "unit" for told in found):
        found += _beyond_safety(workspace.task, trial)
    found += _clocks_apart(workspace, trial)
    return tuple(_with_limits(workspace.task, known, one) for one in found)


def column_faults(workspace: Folder, known: Trial) -> list[Fault]:
    """Return the faults of columns: units, signs, places, dead sensors.

    Args:
        workspace: the workspace with the model.
        known: the trial up to its last known step.
    """
    from grounded.accounts.judge import judge
    from grounded.accounts.words import is_folded, table

    model = workspace.base_model
    verdict = judge(model, [replace(known, id="")], range(model.n)) if known.steps > 1 else None
    if verdict is None:
        return []
    found = [_fault(workspace, known, told) for told in verdict.told]
    lost = [
        Fault(
            f"{model.state_names[i]} {is_folded(model, i)}",
            f"Multiply the scale in {table(model, i)} by {np.pi / 180:.8g} (a missing scale is 1)",
            f"write {model.states[model.state_names[i]]}",
            kind="unit",
        )
        for i in verdict.folded
    ]
    return [*lost, *found]


def _fault(workspace: Folder, known: Trial, told: Told) -> Fault:
    """Return one account as a fault, of the log or of the robot."""
    from grounded.accounts.words import clause, mend, names_of, remedy, table

    model, account = workspace.base_model, told.account
    if account.kind == "exchange" and (robot := _on_the_robot(workspace, known, account)):
        return Fault(clause(model, told, robot=True), robot=robot, kind="exchange")
    if account.kind in ("dead", "offset") or (told.certain and told.by_motion is None):
        names = names_of(model, account.columns)
        each = [remedy(model, told, k, "") for k in account.columns]
        said = "; ".join(f"{name} {text}" for name, (text, _) in zip(names, each, strict=True))
        logs = zip(account.columns, (log for _, log in each), strict=True)
        how = "; ".join(f"Set {log} in {table(model, k)}" for k, log in logs if log)
        if account.kind == "unit":
            how = mend(model, told)
        elif account.kind == "dead":
            said, how = f"{said}: is its sensor on?", "If it is, look for its column in [log]"
    else:
        said, how = clause(model, told, log=False), mend(model, told)
    sent = tuple(n for n in names_of(model, account.columns) if n in model.inputs)
    should = f"write {_units(model, names_of(model, account.columns))}" * (account.kind == "unit")
    every = tuple(names_of(model, account.columns))
    return Fault(said, how, should, sent, abs(account.factor), kind=account.kind, names=every)


def _with_limits(task: Task, known: Trial, fault: Fault) -> Fault:
    """Add the values to write for [limits] that are in the same wrong unit as a log's inputs.

    [limits] in the wrong unit reach as far as the wrong log. If the inputs are too small, they do
    not reach as far as the corrected log.
    """
    right = []
    for name in fault.inputs:
        j = known.input_names.index(name)
        ends, sent = (task.low[j], task.high[j]), np.abs(known.inputs[:, j]).max(initial=0.0)
        most, needed = max(map(abs, ends)), COVER * sent / min(fault.factor, 1.0)
        if np.isfinite(most) and (most >= needed) == (fault.factor > 1):
            low, high = (f"{end / fault.factor:.4g}" for end in ends)
            right.append(f"{name} = [{low}, {high}]")
    if not right:
        return fault
    unit = "reach as far as the log" if fault.factor > 1 else "do not reach as far as that log"
    return replace(fault, mend=f"{fault.mend}; [limits] {unit}: write {', '.join(right)} there")


def _on_the_robot(workspace: Folder, trial: Trial, fault: Account) -> str:
    """Return why an exchange is not the log's, and what to undo on the robot; "" if it may be.

    It is not if other trials that [log] read in the same way show none, or if the commands are
    those of the candidate only as they are logged: the program then had the same columns.
    """
    inputs = min(fault.touched) >= workspace.base_model.n
    parts = ("wires", "sends or logs") if inputs else ("sensors", "reads or logs")
    where = "the robot's {}, or what its program {},".format(*parts)
    if right := without(workspace, trial, fault):
        show = "shows" if len(right) == 1 else "show"
        return f"{ranges(right)}, read in the same way, {show} no exchange. Swap {where} back"
    if not _as_sent(workspace, trial, fault):
        return ""
    return (
        f"As logged, its commands are those of {trial.candidate}, so [log] is right. Swap {where} "
        "back, or exchange them in the model if the robot is as it should be"
    )


def without(workspace: Folder, trial: Trial, fault: Account) -> list[str]:
    """Return the other trials that were read in the same way and contradict an exchange."""
    from grounded.accounts.judge import contradicted
    from grounded.accounts.words import names_of
    from grounded_trials.workspace.last_diagnosis import diagnosable

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
    """Return whether a run's commands are its candidate's, and would not be without an exchange."""
    from grounded.search.returned.who_drove import follows, latest

    if trial.candidate not in workspace.candidate_ids():
        return False
    policy, late = workspace.candidate(trial.candidate)[0].policy, latest(workspace.task)
    run = trial.until(policy.horizon)
    logged, mended = (follows(policy, one, late) for one in (run, fault.mended(run)))
    return logged is not None and logged.alike and not (mended is not None and mended.alike)


def _beyond_safety(task: Task, trial: Trial) -> list[Fault]:
    """Return faults for angles far beyond [safety] that would be inside if they were degrees."""
    assert task.safety_low is not None and task.safety_high is not None
    found = []
    for i, (name, unit) in enumerate(task.model.states.items()):
        x, low, high = trial.states[:, i], task.safety_low[i], task.safety_high[i]
        most = float(np.abs(x[np.isfinite(x)]).max(initial=0.0))
        allowed = max(abs(low), abs(high))
        inside = np.deg2rad(most) <= WIDER * allowed
        if unit == "rad" and np.isfinite(allowed) and most > TURNS * allowed and inside:
            found.append(
                Fault(
                    f"{name} goes to {most:.3g} rad, but [safety] is [{low:g}, {high:g}]: is it in "
                    f"degrees? Then it would be {np.deg2rad(most):.3g} rad",
                    f"Set scale = {np.pi / 180:.8g} in [log.state.{name}] if so",
                    "write rad",
                    kind="unit",
                )
            )
    return found


def _clocks_apart(workspace: Folder, trial: Trial) -> list[Fault]:
    """Return a fault if measured states respond to commands before they are sent."""
    from grounded.accounts.commands import answers_early

    model, estimates = workspace.base_model, workspace.config.estimate
    measured: Collection[str] = model.state_names
    if estimates.names():
        from grounded_trials.workspace.intake.opening.estimating import read_estimate

        measured = read_estimate(estimates, model).measured
    shown = [i for i, name in enumerate(model.state_names) if name in measured]
    if (early := answers_early(model, trial, shown)) is None:
        return []
    mend = early.mend([model.state_names[i] for i in shown])
    return [Fault(early.said(model), mend, "stamp both by one clock", kind="clock")]


def _units(model: Model, names: Sequence[str]) -> str:
    """Return the model's units of some columns."""
    every = {**model.states, **model.inputs}
    return listed(dict.fromkeys(every[name] for name in names))
