"""Check whether a log contains a candidate's run if it is read differently.

Tried are: another rate, another unit, two signals in each other's columns, and an offset.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from grounded.findings import Quantity, found
from grounded.policy import Policy
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
from grounded_trials.workspace.intake.locating.missed_steps import begins_late
from grounded_trials.workspace.intake.locating.run_start import TRIED, Recording, recording
from grounded_trials.workspace.intake.recognising.stories import Kind, Story, scored

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
            told = found("log.pace", ran=own.id, by=pace)
            yield scored(Kind.LOG, told, own, run, fit.error)


def _in_other_units(log: Recording, task: Task, own: Candidate) -> Iterator[Story]:
    """Yield the signals and factors with which a log contains a run."""
    fits, tried = False, set[tuple[tuple[str, ...], float]]()
    for group, by in (*full_scales(task, log.whole.inputs), *units_tried(task.model)):
        names = tuple(name for name in group if name in log.logged)
        if not names or (names, by) in tried:
            continue
        tried.add((names, by))
        scaled = {n: replace(log.logged[n], values=log.logged[n].values * by) for n in names}
        run = _run_in(recording({**log.logged, **scaled}, task, log.complete), own.policy)
        fit = run and follows(own.policy, run.until(own.policy.horizon), 0)
        if run and fit and fit.error < NEARLY and _nearer(own, run, multiplied(run, names, 1 / by)):
            fits = True
            yield scored(Kind.UNIT, None, own, run, fit.error, names=names, by=by)
    for begins in log.openings[:TRIED] if not fits else ():
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
    return scored(Kind.UNIT, None, own, run, error, price=price, names=names, by=by)


def _nearer(own: Candidate, run: Trial, as_logged: Trial | None) -> bool:
    """Return whether a log without a fault is not farther from the prediction than as logged."""
    return as_logged is None or apart(own, run) <= apart(own, as_logged)


def begun_late(log: Recording, own: Candidate) -> Story | None:
    """Return that a log begins after its run did, or None."""
    step, error = begins_late(log, own.policy)
    run = log.trial_from(log.first)
    if not step or run is None:
        return None
    told = found("log.begun_late", ran=own.id, late=Quantity(step * log.dt, "s"))
    rest = replace(own, predicted_states=own.predicted_states[step:])
    return scored(Kind.LOG, told, rest, run, error, rerun=True)


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
    policy, some = own.policy, list[tuple[Story, float]]()
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
            story = scored(Kind.LOG, None, own, run, fit.error, price=EXCHANGED, names=(a, b))
            some.append((story, begun.seconds))
    if not some:
        return None
    best, begins = min(some, key=lambda one: one[0].left)
    return _in_other_column(log, task, own, best, begins, proven)


def _in_other_column(
    log: Recording, task: Task, own: Candidate, story: Story, begins: float, proven: Proven
) -> Story:
    """Return what shows that two columns are exchanged: in the log, or by the robot's program.

    If the model predicts the motion with the columns as they are read, the log is right, and the
    program passed them to the policy, or on to the motors, in each other's place. (With both [log]
    and the wires exchanged a log looks the same, unless [log] read earlier trials well.)
    """
    from grounded.accounts.judge import contradicted
    from grounded.accounts.table import Account

    (a, b), model = story.names, task.model
    every = (*model.state_names, *model.input_names)
    fault = Account("exchange", pairs=((every.index(a), every.index(b)),))
    run, facts = log.trial_from(begins), dict[str, Any](ran=own.id, proven=tuple(proven(fault)))
    if run is None or not contradicted(model, run.until(run.known_steps), range(model.n), fault):
        return replace(story, finding=found("log.exchange", a, b, **facts))
    parts = "states" if a in model.state_names else "outputs"
    told = found("run.exchanged", a, b, parts=parts, moved="as the log says", **facts)
    return replace(story, finding=told, rerun=True)


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
    size, unit = "large" if by > 0 else "small", task.model.states[name]
    told = found("log.zero", name, ran=own.id, size=size, off=Quantity(abs(by), unit))
    told = told.also(add=-by, tables=(f"[log.state.{name}]",))
    moved = np.where(np.isin(trial.state_names, name), trial.states - by, trial.states)
    return scored(Kind.LOG, told, own, replace(trial, states=moved), error, price=ANY)


def _run_in(log: Recording | None, policy: Policy) -> Trial | None:
    """Return the run of a policy in a log, or None if there is none."""
    start = log.start_of(policy, only_alike=True) if log else None
    return log.trial_from(start.seconds) if log and start and start.alike else None


def _paced(series: Series, pace: float) -> Series:
    """Scale the time between samples by `pace`."""
    t, log = (
        at[:1] + np.round((at - at[:1]) * pace).astype(at.dtype)
        for at in (series.t, series.log_times)
    )
    return replace(series, t=t, log_times=log)
