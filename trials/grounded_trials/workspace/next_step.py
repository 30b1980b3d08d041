"""What a person does next: one answer for every command, the page and the text.

And what happened since a diagnosis: newer trials, adopted effects, other parameters. A verdict is
about the model and the trials of its day; what was adopted since is no longer missing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from grounded.diagnosis.error_report import gain
from grounded.diagnosis.report import Diagnosis, Made
from grounded.errors import GroundedError, NextCommand
from grounded.model import all_at_bounds
from grounded.search.standing import LOST, Standing
from grounded_trials.workspace.diagnosing import diagnosable, read_diagnosis
from grounded_trials.workspace.fitting import fitted_in_vain
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.intake.where_to_mend import in_time_now
from grounded_trials.workspace.proposing import standing_in, status_of, to_run

PROPOSE = NextCommand("propose")
DIAGNOSE = NextCommand("diagnose")
EXPORT = NextCommand("export", ("best", "--runner"))
REPORT = NextCommand("report", ("--html",))
TARGET = NextCommand("target", ("SHAPE",))
WRITTEN = 1e-3  # of what a target asks for: its digits in a file
SHORT = 0.1  # of a control step: a filter or delay that makes no difference
LEFT = 2  # states that are told of what is left
SAME = 1e-6  # of a value: what writing it in eight digits may take


def next_command(
    workspace: Folder, now: Standing, diagnosis: Diagnosis | None, usable: Sequence[str]
) -> NextCommand:
    """What a person does next, given where the search stands and what was diagnosed.

    Where that is the first plan and nobody has drawn a manoeuvre, that comes before it.

    Args:
        workspace: whose model may have changed since the diagnosis.
        now: where its search stands.
        diagnosis: the last one.
        usable: the trials that a diagnosis can use now, in order of arrival.
    """
    then = _follows(workspace, now, diagnosis, usable)
    return to_plan(workspace) if then == PROPOSE else then


def to_plan(workspace: Folder) -> NextCommand:
    """A plan; before the first one, to draw the manoeuvre where target.csv has none yet."""
    with suppress(GroundedError):  # a target that can't be read `propose` tells of
        return TARGET if undrawn(workspace) else PROPOSE
    return PROPOSE


def undrawn(workspace: Folder) -> bool:
    """Whether no candidate was made and target.csv is what `init --from` wrote in place of one.

    Zeros of the first state alone where the log could not be sampled yet, from a start at zero.
    """
    task = workspace.config.task
    if not task.target or workspace.candidate_ids():
        return False
    first, *others = np.asarray(workspace.task.target, float).T
    if first.any() or not all(np.isnan(column).all() for column in others):
        return bool(logged_target(workspace))
    return not task.start.get(workspace.base_model.state_names[0])


def _follows(
    workspace: Folder, now: Standing, diagnosis: Diagnosis | None, usable: Sequence[str]
) -> NextCommand:
    """See `next_command`, whatever target.csv is."""
    since = since_diagnosis(workspace, diagnosis, usable) if diagnosis else Since()
    follow = to_adopt(workspace, diagnosis) if diagnosis and not since.changed else None
    if follow and (not since.newer or _none_stood(now)):
        return follow  # wherever the search stands: a better model plans better
    if now.phase == "await-trial":
        return another_trial(workspace, now)
    if now.ending == "not allowed" and not now.trials:
        return TARGET  # what was asked of the model leaves [safety]; to propose it again helps none
    if diagnosis is None:
        logs = usable and not now.history  # what they show comes before the first candidate
        teach = usable and (logs or now.phase != "propose")
        then = None if now.doubt and not doubted(now, None, usable) else now.then
        return then or (DIAGNOSE if teach else PROPOSE)
    if now.phase == "propose":
        logs = follow is not None and not now.history
        return DIAGNOSE if logs or doubted(now, since, usable) else PROPOSE
    if since.changed or since.newer:
        return DIAGNOSE
    return another_trial(workspace, now) if diagnosis.no_cause else EXPORT


def doubted(now: Standing, since: Since | None, usable: Sequence[str]) -> bool:
    """Whether the search doubts its model, and a diagnosis of what came since may say why.

    Args:
        now: where the search stands.
        since: what the last diagnosis does not know; None without one.
        usable: what a diagnosis can use now. One run alone confirms nothing.
    """
    return bool(now.doubt) and (len(usable) if since is None else since.newer) >= LOST


def another_trial(workspace: Folder, now: Standing) -> NextCommand:
    """How to get one more trial: of what waits, of what comes next, or of the best again."""
    waiting = now.phase == "await-trial"
    if not waiting and (now.phase == "propose" or now.incumbent is None):
        return PROPOSE
    if waiting and now.outstanding is not None:
        return to_run(workspace, now.outstanding.id)
    assert now.incumbent is not None
    return to_run(workspace, now.incumbent.candidate.id, "best")


def after_log(workspace: Folder, verdict: str, now: Standing | None) -> NextCommand:
    """What follows a log: the next candidate; a diagnosis of data, or of a probe's run.

    Args:
        workspace: that has stored it.
        verdict: `Ingested.verdict`.
        now: where its search stands with it, which says what follows an end; None for data.
    """
    if now is None or verdict == "probe":
        return DIAGNOSE
    if _none_stood(now) and (found := read_diagnosis(workspace.reports)) is not None:
        return next_command(workspace, now, found, usable_ids(workspace))
    goes_on = now.phase in ("propose", "await-trial") and not now.doubt
    return PROPOSE if goes_on else status_of(workspace, now).then


def logged_target(workspace: Folder) -> str:
    """The log whose drive target.csv still is, as `init --from` wrote it; "" where it is another.

    It is one that ran no candidate, and the target is what its states did, row by row.
    """
    if not workspace.config.task.target:
        return ""
    task = workspace.task
    asked = np.isfinite(task.target).any(axis=0)
    for stored in workspace.whole_trials():
        trial, rows = stored.trial, len(task.target)
        if trial.candidate or trial.steps + 1 < rows or trial.dt != task.dt:
            continue
        off = np.abs(trial.states[:rows, asked] - task.target[:, asked])
        moved = np.ptp(task.target[:, asked], axis=0).max(initial=0.0)
        if moved > 0 and off.size and np.nanmax(off) < WRITTEN * moved:
            return trial.id or stored.stored.id
    return ""


def _none_stood(now: Standing) -> bool:
    """Whether every policy that was run crashed: a gentler one is the last resort."""
    return bool(now.history) and now.incumbent is None


def after_diagnosis(workspace: Folder, found: Diagnosis) -> NextCommand:
    """What follows a diagnosis: adopt what was claimed, run another trial, or see the whole."""
    if not found.no_cause:
        if (follow := to_adopt(workspace, found)) is not None:
            return follow
        if found.probe:
            return to_run(workspace, found.probe, found.probe)
        settled = found.kind in ("none", "unknown") or found.contested  # nothing to decide on
        if not settled or not workspace.config.task.target:
            return REPORT
    now = _standing_ahead(workspace)
    if found.no_cause:
        then = another_trial(workspace, now)
        return to_plan(workspace) if then == PROPOSE else then
    return next_command(workspace, now, found, usable_ids(workspace))


def nothing_to_do(found: Diagnosis, best: str) -> str:
    """That a search is over though something is left: what that is, and what would tell more.

    Args:
        found: of the model and the trials that there are; nothing that it claims helps.
        best: the candidate that the search ended with.
    """
    left = ", ".join(one.sentence() for one in found.leftover[:LEFT])
    return (
        f"None is needed to have the manoeuvre: the search has ended, with {best}. "
        + f"No known effect explains what is left: {left}. " * bool(left)
        + f"To learn more: {found.next_trial}"
    )


def _standing_ahead(workspace: Folder) -> Standing:
    """Where the search stands, one proposal ahead where that can be planned with this model."""
    try:
        return standing_in(workspace, ahead=True)
    except GroundedError:
        return standing_in(workspace)


def after_fit(workspace: Folder) -> NextCommand:
    """What follows a fit that predicts no better: what else the last diagnosis leaves to do.

    Where there is none of today's model and trials: to make one.
    """
    try:
        found = read_diagnosis(workspace.reports)
    except GroundedError:
        found = None
    if found is None:
        return DIAGNOSE
    now = _standing_ahead(workspace)
    since = since_diagnosis(workspace, found, usable_ids(workspace))
    if since.changed or since.newer:
        return DIAGNOSE
    return next_command(workspace, now, found, usable_ids(workspace))


def to_adopt(workspace: Folder, diagnosis: Diagnosis) -> NextCommand | None:
    """What to do about what a diagnosis found, None where there is nothing to do.

    Filters and delays of sensors come along where states are fed back: the physics was judged
    without them, and gains that were made without them swing a robot that has them.
    """
    from grounded_trials.workspace.adopting import declined

    new = diagnosis.open(workspace.config.model.effects, workspace.config.model.params)
    undone = {*declined(workspace)}  # whoever did that is not asked to do it again
    late = tuple(name for name in late_open(workspace, diagnosis) if name not in undone)
    claimed = diagnosis.kind in ("effect", "several") and not diagnosis.contested
    if not claimed or {*new} <= undone or _like_a_load(workspace, new):
        return NextCommand("adopt", late) if late else None
    if most := diagnosis.verdict.look_for:
        return _with_more(most, diagnosis.made or Made())
    params = workspace.base_model.params
    known = {n: e.value for n, e in diagnosis.parameters.items() if n in params}
    if all_at_bounds(params, {n: known[n] for n in diagnosis.verdict.parameters if n in known}):
        return DIAGNOSE  # once their bounds are wider, as it says: they ask for more than can be
    own = {f"parameter:{name}" for name in params}
    if own.issuperset(new):
        if not fitted_in_vain(workspace):
            return NextCommand("fit")  # the model's form is right: all of its numbers at once
        if gain(diagnosis.prediction_error, "crude", "with_effects") <= 0:
            return NextCommand("adopt", late) if late else None
    return NextCommand("adopt", (*new, *late))


def _like_a_load(workspace: Folder, effects: Sequence[str]) -> bool:
    """Whether they stand in the place of a load, for which the model wants a parameter."""
    if len(effects) < 2:  # and nothing is imported
        return False
    from grounded.effects.joint import like_a_load

    return like_a_load(workspace.planner.plan.model, effects)


def late_open(workspace: Folder, diagnosis: Diagnosis) -> tuple[str, ...]:
    """The filters and delays of sensors that a diagnosis found and the model that plans has not."""
    task = workspace.config.task
    if not (task.target and task.feedback):
        return ()
    known = {effect["name"] for effect in workspace.config.model.effects}
    known |= set(in_time_now(workspace, diagnosis.preflight))
    least = SHORT * task.dt
    found = diagnosis.late_sensors.items()
    return tuple(n for n, own in found if n not in known and max(own.values()) > least)


def _with_more(effects: int, made: Made) -> NextCommand:
    """The same diagnosis, of the same trials, with more effects at once."""
    asked: tuple[str, ...] = ()
    if made.compared:
        asked = ("--compare", ",".join(made.named), ",".join(made.compared))
    elif made.named:
        asked = ("--trials", ",".join(made.named))
    if made.without:
        asked += ("--without", ",".join(made.without))
    return NextCommand("diagnose", (*asked, "--max-effects", str(effects)))


@dataclass(frozen=True)
class Since:
    """The days between a diagnosis and now."""

    used: int = 0  # of the trials that can be used, those it was made from
    usable: int = 0
    newer: int = 0  # that can be used and came after it
    adopted: tuple[str, ...] = ()  # claimed effects that are part of the model now
    missing: tuple[str, ...] = ()  # claimed effects that are not, where some are
    changed: bool = False  # it was made with another model

    @property
    def sentence(self) -> str:
        """Why it is no longer the last word; "" where it is. What to run, `next_command` says."""
        parts = []
        if self.newer:
            parts.append(f"diagnosed with {self.used} of {self.usable} trials")
        if self.adopted:
            but = f", but not {', '.join(self.missing)}" * bool(self.missing)
            parts.append(f"adopted since: {', '.join(self.adopted)}{but}")
        elif self.changed:
            parts.append("the model was changed since")
        return "; ".join(parts)


def usable_ids(workspace: Folder) -> list[str]:
    """The trials that a diagnosis can use, in order of arrival.

    Raises:
        GroundedError: if a stored file is damaged.
    """
    return [trial.id for trial in diagnosable(workspace)]


def since_diagnosis(workspace: Folder, diagnosis: Diagnosis, usable: Sequence[str]) -> Since:
    """What a diagnosis does not know.

    Args:
        workspace: whose model it was about.
        diagnosis: as it was kept.
        usable: the trials that can be used now, in order of arrival.
    """
    model, made = workspace.config.model, diagnosis.made or Made()
    seen, params = set(made.trials), made.params
    last = max((k for k, name in enumerate(usable) if name in seen), default=-1)
    missing = diagnosis.open(model.effects, model.params)
    other = [name for name in diagnosis.effects if _other_value(diagnosis, name, model.params)]
    adopted = tuple(name for name in diagnosis.effects if name not in (*missing, *other))
    same = [dict(e) for e in model.effects] == [dict(e) for e in made.adopted]
    return Since(
        used=sum(name in seen for name in usable),
        usable=len(usable),
        newer=len(usable) - 1 - last if seen else 0,
        adopted=adopted,
        missing=missing if adopted else (),
        changed=not same or params not in (None, dict(model.params)),
    )


def _other_value(diagnosis: Diagnosis, name: str, params: Mapping[str, float]) -> bool:
    """Whether a claimed parameter has another value now than was claimed: it was not adopted."""
    family, _, own = name.partition(":")
    row, made = diagnosis.ranked(name), diagnosis.made or Made()
    if family != "parameter" or own not in params or own not in made.nominal or row is None:
        return False
    said = row.params["d"].moved(made.nominal[own])
    low, high = said.interval or (said.value - 2 * said.std, said.value + 2 * said.std)
    room = SAME * abs(said.value)
    return not low - room <= params[own] <= high + room
