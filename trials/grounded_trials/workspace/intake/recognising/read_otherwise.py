"""Check whether a log contains a candidate's run if it is read differently.

Tried are: another rate, another unit, two signals in each other's columns, and an offset.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from grounded.policy import Policy
from grounded.result import listed
from grounded.search.candidate import Candidate
from grounded.search.returned.as_predicted import apart, like_predicted, multiplied
from grounded.search.returned.other_scale import (
    EXACT,
    NEARLY,
    THOUSAND,
    any_factor,
    any_offset,
    full_scales,
    of_full_scale,
    unit_named,
    units_tried,
)
from grounded.search.returned.who_drove import FINE, Following, follows, latest
from grounded.task import Task
from grounded.trial import Trial
from grounded_trials.logs.signals import Series
from grounded_trials.wording import ranges, with_unit
from grounded_trials.workspace.intake.locating.missed_steps import begins_late
from grounded_trials.workspace.intake.locating.run_start import TRIED, Recording, recording
from grounded_trials.workspace.user_files.config import FILE

if TYPE_CHECKING:
    from grounded.accounts.table import Account

PAIRS = 28  # largest number of pairs of states, and of inputs, that are tried exchanged
WORSE = 2.0  # factor by which a log must follow a policy worse than with two columns exchanged
CLEARLY = 0.5  # [nats] by which an exchange must bring a log nearer to the prediction than a unit
PACES = (2.0, 0.5)  # rates of a recording that are tried

Proven = Callable[["Account"], Sequence[str]]  # trials, read by the same [log], without a fault


def pace_of(log: Recording, task: Task, own: Candidate) -> float | None:
    """Return how many seconds of a candidate's run one second of the log's stamps is; None if one.

    Args:
        log: a log in which no run of the candidate was found.
        task: the task with the control step.
        own: the candidate.
    """
    for pace in PACES:
        paced = {name: _paced(one, pace) for name, one in log.logged.items()}
        run = _run_in(recording(paced, task, log.complete), own.policy)
        if run and like_predicted(own, run):  # slow commands fit many policies
            return pace
    return None


def unit_of(log: Recording, task: Task, own: Candidate) -> tuple[tuple[str, ...], float]:
    """Return signals and a factor with which the log contains a run of a candidate; (), 1 for none.

    Args:
        log: a log in which no run of the candidate was found.
        task: the task with the control step.
        own: the candidate.
    """
    policy, best, least = own.policy, (tuple[str, ...](), 1.0), np.inf
    tried = set[tuple[tuple[str, ...], float]]()
    scales = list(full_scales(task, log.whole.inputs))
    for group, by in (*scales, *units_tried(task.model)):
        names = tuple(name for name in group if name in log.logged)
        if not names or (names, by) in tried:
            continue
        tried.add((names, by))
        scaled = {n: replace(log.logged[n], values=log.logged[n].values * by) for n in names}
        run = _run_in(recording({**log.logged, **scaled}, task, log.complete), policy)
        fit = run and follows(policy, run.until(policy.horizon), 0)
        if not run or not fit or not fit.error < NEARLY:
            continue
        if (away := apart(own, run) - apart(own, multiplied(run, names, 1 / by))) > 0:
            continue  # farther from the prediction than as it is logged
        if (group, by) in scales and fit.error < EXACT:
            return names, by
        if (left := away + np.log(fit.error + FINE)) < least:
            best, least = (names, by), left
    if best[0]:
        return best
    for begins in log.openings[:TRIED]:
        if trial := log.trial_from(begins):
            names, by = any_factor(task, own, trial)
            if names:
                return names, by
    return (), 1.0


@dataclass(frozen=True)
class Misled:
    """A fault of a log that hides its run, and how to correct it."""

    said: str
    rerun: bool = False  # no setting reads this log: another one is needed, of the run or a new one


def misled(
    log: Recording | None,
    task: Task,
    own: Candidate,
    swapped: Callable[[], Misled | None] | None = None,
) -> Misled | None:
    """Return another fault of a log that hides its run, or None.

    Args:
        log: a log in which no run of the candidate was found.
        task: the task.
        own: the candidate.
        swapped: what `exchanged_in` returns, if it is known or may be asked for again.
    """
    if log is None:
        return None
    if late := begins_late(log, own.policy):
        return Misled(
            f"its first row is {late:.3g} s after {own.id} began: record from before the run, and "
            "cut nothing off; without its beginning the run can't be judged. If nothing was cut "
            "off, the program's clock began before the run",
            rerun=True,
        )
    if swap := swapped() if swapped else exchanged_in(log, task, own):
        return swap
    off = _off_zero(task, offset_in(log, task, own))
    return Misled(off) if off else None


def exchanged_in(
    log: Recording, task: Task, own: Candidate, proven: Proven = lambda fault: ()
) -> Misled | None:
    """Return that a log is a candidate's run with two columns exchanged, or None.

    Args:
        log: a log in which no run of the candidate was found.
        task: the task.
        own: the candidate.
        proven: which stored trials, read by the same [log], contradict an exchange.
    """
    found = _exchange(log, task, own)
    return _in_other_column(log, task, own, found, proven) if found else None


def crossed(
    log: Recording | None,
    task: Task,
    own: Candidate,
    other: Candidate,
    proven: Proven = lambda fault: (),
) -> Misled | None:
    """Return that a log is a run with two columns exchanged, not another candidate's; or None.

    Candidates that are nearly the same send nearly the same on exchanged columns, too. With the
    columns put back the commands are those of the one that ran, and the motion is as predicted.

    Args:
        log: a log whose commands, as logged, are like those of `other`.
        task: the task.
        own: the candidate that should have run; its run is sought first.
        other: the candidate that seems to have run, perhaps with exchanged columns as well.
        proven: as in `exchanged_in`.
    """
    run = _run_in(log, other.policy)
    plain = run and follows(other.policy, run.until(other.policy.horizon), 0)
    if log is None or not run or not plain:
        return None
    found = [(one, exchange) for one in (own, other) if (exchange := _exchange(log, task, one))]
    if not found:
        return None
    whose, best = min(found, key=lambda each: each[1].error)
    if plain.error < WORSE * (best.error + FINE) or best.far > apart(other, run):
        return None
    return _in_other_column(log, task, whose, best, proven)


def _in_other_column(
    log: Recording, task: Task, own: Candidate, found: Exchange, proven: Proven
) -> Misled:
    """Return what shows that two columns are exchanged: in the log, or by the robot's program.

    If the model predicts the motion with the columns as they are read, the log is right, and the
    program passed them to the policy, or on to the motors, in each other's place. (With both [log]
    and the wires exchanged a log looks the same, unless [log] read earlier trials well.)
    """
    from grounded.accounts.judge import contradicted
    from grounded.accounts.table import Account

    (a, b), model = found.pair, task.model
    of = "state" if a in model.state_names else "input"
    tables = f"[log.{of}.{a}] and [log.{of}.{b}]"
    every = (*model.state_names, *model.input_names)
    names = model.state_names if of == "state" else model.input_names
    fault = Account("exchange", pairs=((every.index(a), every.index(b)),))
    run, right = log.trial_from(found.begins), proven(fault)
    show = f"{ranges(right)}, read in the same way, show{'s' * (len(right) == 1)} no exchange"
    if run is None or not contradicted(model, run.until(run.known_steps), range(model.n), fault):
        mend = f"Exchange the paths in {tables}, or the column headers in the log"
        if right:
            mend = f"{show}, so [log] is right: exchange the two in this log, and in what wrote it"
        return Misled(
            f"{a} and {b} seem to be in each other's column: only with them exchanged are its "
            f"commands those of {own.id}. {mend}"
        )
    said = (
        f"only with {a} and {b} exchanged are its commands those of {own.id}, but the robot moved "
        "as the log says"
    )
    said += f", and {show}" * bool(right)
    if of == "state":
        how = (
            f"so the log is right, and its program passes {a} and {b} to `runner.action` in each "
            f"other's place: the order is {', '.join(names)}. Mend that"
        )
    elif right:
        how = (
            f"so the log is right, and its program sends {a} as {b}, and the reverse. Swap its "
            "outputs back"
        )
    else:
        how = (
            f"so its program sends {a} as {b}, and the reverse (swap its outputs back); or both "
            f"[log] and the robot have them exchanged (exchange the paths in {tables}, and swap "
            "its wires back). Mend that"
        )
    return Misled(f"{said}: {how} and run {own.id} again", rerun=True)


def zero_in(
    log: Recording, task: Task, own: Candidate, trial: Trial, plain: Following | None
) -> str:
    """Return how a run's log is off from what its program measured, and how to correct it; or "".

    Args:
        log: the log of the run.
        task: the task.
        own: the candidate, whose run it is, as far as its commands tell.
        trial: the run.
        plain: the comparison of its commands.
    """
    logged = [name for name in task.model.state_names if name in log.logged]
    return _off_zero(task, any_offset(task, own, trial, logged, plain))


def _off_zero(task: Task, off: tuple[str, float] | None) -> str:
    if off is None:
        return ""
    name, by = off
    much = with_unit(f"{abs(by):.3g}", task.model.states[name])
    return (
        f"{name} seems to be {much} too {'large' if by > 0 else 'small'}: does its zero differ "
        f"from that of the program? Add {-by:.3g} to the offset in [log.state.{name}] (a missing "
        "offset is 0); if the log is right, the robot's program measures it wrong"
    )


def rather_exchanged(
    log: Recording, task: Task, own: Candidate, names: Sequence[str], by: float
) -> bool:
    """Return whether two exchanged columns explain a log better than another unit of some."""
    found = _exchange(log, task, own)
    if found is None or (as_logged := log.trial_from(found.begins)) is None:
        return False
    return found.far < apart(own, multiplied(as_logged, names, by)) - CLEARLY


@dataclass(frozen=True)
class Exchange:
    """Two columns with which exchanged a log contains a candidate's run."""

    pair: tuple[str, str]
    begins: float  # where the run begins then [s]
    far: float  # how far it is from its prediction [nats]
    error: float  # mean difference of its commands, relative to an input's size


def _exchange(log: Recording, task: Task, own: Candidate) -> Exchange | None:
    """Return the exchange of two columns that reveals a candidate's run, or None."""
    if (as_it_is := log.trial_from(log.first)) is None:
        return None
    policy, best, least = own.policy, None, np.inf
    as_logged = follows(policy, as_it_is.until(policy.horizon), 0)
    inputs = list(combinations(task.model.input_names, 2))[:PAIRS]
    states = [name for name in task.model.state_names if name in log.logged]
    if policy.gain is None or not policy.gain.any():
        states = []  # none has an effect on the commands
    for a, b in (*inputs, *list(combinations(states, 2))[:PAIRS]):
        one, other = log.logged[a], log.logged[b]
        back = {a: replace(other, spec=one.spec), b: replace(one, spec=other.spec)}
        if (mended := recording({**log.logged, **back}, task, log.complete)) is None:
            continue
        begun = mended.start_of(policy, only_alike=True)
        run = mended.trial_from(begun.seconds) if begun and begun.alike else None
        fit = run and follows(policy, run.until(policy.horizon), 0)
        if not begun or not run or not fit or not fit.error < NEARLY:
            continue
        if as_logged and as_logged.error < WORSE * fit.error:
            continue
        there, far = log.trial_from(begun.seconds), apart(own, run)
        if there is not None and far > apart(own, there):
            continue  # farther from the prediction than as it is logged
        if (left := far + np.log(fit.error + FINE)) < least:
            best, least = Exchange((a, b), begun.seconds, far, fit.error), left
    return best


def offset_in(log: Recording, task: Task, own: Candidate) -> tuple[str, float] | None:
    """Return a state and its constant error, without which the log contains a candidate's run.

    Args:
        log: a log in which no run of the candidate was found.
        task: the task with the control step.
        own: the candidate.
    """
    for begins in (log.first, *log.openings[:TRIED]):
        if trial := log.trial_from(begins):
            names = [name for name in task.model.state_names if name in log.logged]
            plain = follows(own.policy, trial.until(task.horizon), latest(task))
            if found := any_offset(task, own, trial, names, plain):
                return found
    return None


def _run_in(log: Recording | None, policy: Policy) -> Trial | None:
    """Return the run of a policy in a log, or None if there is none."""
    found = log.start_of(policy, only_alike=True) if log else None
    return log.trial_from(found.seconds) if log and found and found.alike else None


def _paced(series: Series, pace: float) -> Series:
    """Scale the time between samples by `pace`."""
    t, log = (
        at[:1] + np.round((at - at[:1]) * pace).astype(at.dtype)
        for at in (series.t, series.log_times)
    )
    return replace(series, t=t, log_times=log)


def times_too(by: float) -> str:
    """Return that numbers which have to be multiplied by `by` are too small, or too large."""
    size = f"{max(abs(by), 1 / abs(by)):.4g} times too {'large' if abs(by) < 1 else 'small'}"
    return size + " and of the other sign" * (by < 0)


def units_told(task: Task, names: Sequence[str], by: float, mapped: bool) -> str:
    """Describe a wrong unit or sign in a log and how to correct it.

    Args:
        task: with the units of the signals, and the limits of the inputs.
        names: the signals.
        by: the factor that corrects them.
        mapped: whether the log is read through a [log] table.
    """
    which, states = listed(names), task.model.states
    tables = listed(f"[log.{'state' if n in states else 'input'}.{n}]" for n in names)
    if by == -1:
        mend = f"multiply the scale in {tables} of {FILE} by -1 (a missing scale is 1)"
        alone = f"write {which} times -1 and run it again, or ingest it with --data"
        return f"with {which} of the other sign: {mend if mapped else alone}"
    size, unit = times_too(by), unit_named(task.model, names, by) or of_full_scale(task, names, by)
    mend = f"multiply the scale in {tables} of {FILE} by {by:.6g} (a missing scale is 1)"
    if not unit and by not in THOUSAND:
        mend += "; if the log is right, the robot's program measures it wrong"
    if not mapped:
        mend = f"write {which} times {by:.6g} and run it again, or ingest it with --data"
    return f"with {which} {size}{f' (in {unit})' if unit else ''}: {mend}"
