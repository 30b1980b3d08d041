"""Check whether a log contains a candidate's run if it is read differently.

Tried are: another rate, another unit, two signals in each other's columns, and an offset.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from grounded.policy import Policy
from grounded.result import listed
from grounded.search.candidate import Candidate
from grounded.search.returned.as_predicted import apart, like_predicted, multiplied
from grounded.search.returned.other_scale import (
    NEARLY,
    THOUSAND,
    any_factor,
    any_offset,
    full_scales,
    of_full_scale,
    unit_by_factor,
    units_tried,
)
from grounded.search.returned.who_drove import Following, follows, latest
from grounded.task import Task
from grounded.trial import Trial
from grounded_trials.logs.signals import Series
from grounded_trials.wording import ranges, with_unit
from grounded_trials.workspace.intake.locating.missed_steps import begins_late
from grounded_trials.workspace.intake.locating.run_start import TRIED, Recording, recording
from grounded_trials.workspace.intake.recognising.stories import Kind, Story, scored
from grounded_trials.workspace.user_files.config import FILE

if TYPE_CHECKING:
    from grounded.accounts.table import Account

PAIRS = 28  # largest number of pairs of states, and of inputs, that are tried exchanged
PACES = (2.0, 0.5)  # rates of a recording that are tried
ANY, EXCHANGED = 1.0, 0.5  # [nats] that a factor costs which is no unit, and an exchange

Proven = Callable[["Account"], Sequence[str]]  # trials, read by the same [log], without a fault


def otherwise(log: Recording, task: Task, own: Candidate, proven: Proven) -> Iterator[Story]:
    """Yield the stories by which a log that is read otherwise contains a run of a candidate.

    Args:
        log: a log in which no run of the candidate was found.
        task: the task with the control step.
        own: the candidate.
        proven: which stored trials, read by the same [log], contradict an exchange.
    """
    yield from _at_other_rates(log, task, own)
    yield from _in_other_units(log, task, own)
    if not log.whole.inputs.any():
        return
    if swap := exchanged_in(log, task, own, proven):
        yield swap
    if late := begun_late(log, own):
        yield late
    for begins in (log.first, *log.openings[:TRIED]):
        if (trial := log.trial_from(begins)) and (off := offset_in(log, task, own, trial)):
            yield off
            return


def _at_other_rates(log: Recording, task: Task, own: Candidate) -> Iterator[Story]:
    """Yield the rates of a recording at which it is a run: a second of stamps is another time."""
    for pace in PACES:
        paced = {name: _paced(one, pace) for name, one in log.logged.items()}
        run = _run_in(recording(paced, task, log.complete), own.policy)
        fit = run and follows(own.policy, run.until(own.policy.horizon), 0)
        if run and fit and like_predicted(own, run):  # slow commands fit many policies
            said = (
                f"a second of its stamps is {pace:g} s of the run (a recording played at another "
                f"rate?): multiply the stamps by {pace:g} and ingest it again"
            )
            yield scored(Kind.PACE, said, own, run, fit.error)


def _in_other_units(log: Recording, task: Task, own: Candidate) -> Iterator[Story]:
    """Yield the signals and factors with which a log contains a run."""
    found, tried = False, set[tuple[tuple[str, ...], float]]()
    for group, by in (*full_scales(task, log.whole.inputs), *units_tried(task.model)):
        names = tuple(name for name in group if name in log.logged)
        if not names or (names, by) in tried:
            continue
        tried.add((names, by))
        scaled = {n: replace(log.logged[n], values=log.logged[n].values * by) for n in names}
        run = _run_in(recording({**log.logged, **scaled}, task, log.complete), own.policy)
        fit = run and follows(own.policy, run.until(own.policy.horizon), 0)
        if run and fit and fit.error < NEARLY and _nearer(own, run, multiplied(run, names, 1 / by)):
            found = True
            yield scored(Kind.UNIT, "", own, run, fit.error, names=names, by=by)
    for begins in log.openings[:TRIED] if not found else ():
        if trial := log.trial_from(begins):
            names, by = any_factor(task, own, trial)
            if names:
                yield in_unit(task, own, trial, names, by)
                return


def in_unit(task: Task, own: Candidate, trial: Trial, names: tuple[str, ...], by: float) -> Story:
    """Return the story that columns of a trial have to be multiplied by a factor."""
    run, model = multiplied(trial, names, by), task.model
    fit = follows(own.policy, run.until(task.horizon), latest(task))
    known = by in (*THOUSAND, -1.0) or unit_by_factor(model, names, by)
    price = 0.0 if known or of_full_scale(task, names, by) else ANY
    error = fit.error if fit else 1.0
    return scored(Kind.UNIT, "", own, run, error, price=price, names=names, by=by)


def _nearer(own: Candidate, run: Trial, as_logged: Trial | None) -> bool:
    """Return whether a log without a fault is not farther from the prediction than as logged."""
    return as_logged is None or apart(own, run) <= apart(own, as_logged)


def begun_late(log: Recording, own: Candidate) -> Story | None:
    """Return that a log begins after its run did, or None."""
    step, error = begins_late(log, own.policy)
    run = log.trial_from(log.first)
    if not step or run is None:
        return None
    said = (
        f"its first row is {step * log.dt:.3g} s after {own.id} began: record from before the run, "
        "and cut nothing off; without its beginning the run can't be judged. If nothing was cut "
        "off, the program's clock began before the run"
    )
    rest = replace(own, predicted_states=own.predicted_states[step:])
    return scored(Kind.LOG, said, rest, run, error, rerun=True)


def exchanged_in(
    log: Recording, task: Task, own: Candidate, proven: Proven = lambda fault: ()
) -> Story | None:
    """Return that a log is a candidate's run with two columns exchanged, or None.

    Args:
        log: a log in which no run of the candidate was found.
        task: the task.
        own: the candidate.
        proven: which stored trials, read by the same [log], contradict an exchange.
    """
    policy, found = own.policy, list[tuple[Story, float]]()
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
        if _nearer(own, run, log.trial_from(begun.seconds)):
            story = scored(Kind.LOG, "", own, run, fit.error, price=EXCHANGED, names=(a, b))
            found.append((story, begun.seconds))
    if not found:
        return None
    best, begins = min(found, key=lambda one: one[0].left)
    return _in_other_column(log, task, own, best, begins, proven)


def _in_other_column(
    log: Recording, task: Task, own: Candidate, found: Story, begins: float, proven: Proven
) -> Story:
    """Return what shows that two columns are exchanged: in the log, or by the robot's program.

    If the model predicts the motion with the columns as they are read, the log is right, and the
    program passed them to the policy, or on to the motors, in each other's place. (With both [log]
    and the wires exchanged a log looks the same, unless [log] read earlier trials well.)
    """
    from grounded.accounts.judge import contradicted
    from grounded.accounts.table import Account

    (a, b), model = found.names, task.model
    of = "state" if a in model.state_names else "input"
    tables = f"[log.{of}.{a}] and [log.{of}.{b}]"
    every = (*model.state_names, *model.input_names)
    fault = Account("exchange", pairs=((every.index(a), every.index(b)),))
    run, right = log.trial_from(begins), proven(fault)
    said = f"only with {a} and {b} exchanged are its commands those of {own.id}"
    show = f"; {ranges(right)}, read in the same way, show{'s' * (len(right) == 1)} no exchange"
    show *= bool(right)
    if run is None or not contradicted(model, run.until(run.known_steps), range(model.n), fault):
        paths = f"the paths in {tables}, or the column headers in the log"
        mend = "the two in this log, and in what wrote it" if right else paths
        said = f"{a} and {b} seem to be in each other's column: {said}{show}. Exchange {mend}"
        return replace(found, said=said)
    said += f", but the robot moved as the log says{show}"
    its = f"its program sends {a} as {b}, and the reverse (swap its outputs back)"
    if of == "state":
        its = (
            f"so the log is right, and its program passes {a} and {b} to `runner.action` in each "
            f"other's place: the order is {', '.join(model.state_names)}"
        )
    elif right:
        its = f"so the log is right, and {its}"
    else:
        its += "; or both [log] and the robot have them exchanged (exchange the paths in "
        its += f"{tables}, and swap its wires back)"
    said += f": {its}. Mend that and run {own.id} again"
    return replace(found, said=said, rerun=True)


def offset_in(
    log: Recording, task: Task, own: Candidate, trial: Trial, plain: Following | None = None
) -> Story | None:
    """Return that a state of a log is off by a constant from what its program measured, or None.

    Args:
        log: the log.
        task: the task.
        own: the candidate.
        trial: its run, as far as the commands tell.
        plain: the comparison of its commands, if it is known.
    """
    names = [name for name in task.model.state_names if name in log.logged]
    plain = plain or follows(own.policy, trial.until(task.horizon), latest(task))
    if (off := any_offset(task, own, trial, names, plain)) is None:
        return None
    name, by, error = off
    much = with_unit(f"{abs(by):.3g}", task.model.states[name])
    said = (
        f"{name} seems to be {much} too {'large' if by > 0 else 'small'}: does its zero differ "
        f"from that of the program? Add {-by:.3g} to the offset in [log.state.{name}] (a missing "
        "offset is 0); if the log is right, the robot's program measures it wrong"
    )
    moved = np.where(np.isin(trial.state_names, name), trial.states - by, trial.states)
    return scored(Kind.LOG, said, own, replace(trial, states=moved), error, price=ANY)


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
    size, unit = (
        times_too(by),
        unit_by_factor(task.model, names, by) or of_full_scale(task, names, by),
    )
    mend = f"multiply the scale in {tables} of {FILE} by {by:.6g} (a missing scale is 1)"
    if not unit and by not in THOUSAND:
        mend += "; if the log is right, the robot's program measures it wrong"
    if not mapped:
        mend = f"write {which} times {by:.6g} and run it again, or ingest it with --data"
    return f"with {which} {size}{f' (in {unit})' if unit else ''}: {mend}"
