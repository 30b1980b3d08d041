"""Check whether a log contains a candidate's run if it is read differently.

Tried are: another rate, another unit, two signals in each other's columns, and an offset.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from grounded.accounts.judge import contradicted
from grounded.accounts.table import Account, of_commands
from grounded.findings import Quantity, found
from grounded.policy import Policy
from grounded.search.candidate import Candidate
from grounded.search.returned.as_predicted import apart, like_predicted
from grounded.search.returned.smoothed import smoothed
from grounded.search.returned.stories import LEADS, Kind, Story, full_scales, scored, stories
from grounded.search.returned.who_drove import EXPLAINED, follows, latest
from grounded.task import Task
from grounded.trial import Trial
from grounded_trials.logs.signals import Series
from grounded_trials.workspace.intake.locating.missed_steps import begins_late
from grounded_trials.workspace.intake.locating.run_start import TRIED, Recording, recording

PAIRS = 28  # largest number of pairs of states, and of inputs, that are tried exchanged
PACES = (2.0, 0.5)  # rates of a recording that are tried

Proven = Callable[[Account], Sequence[str]]  # trials, read by the same [log], without a fault


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
    if log.whole.inputs.any():
        yield from filter(None, (exchanged_in(log, task, own, proven), begun_late(log, own)))


def at_each_start(log: Recording, task: Task, own: Candidate) -> Iterator[Story]:
    """Yield the stories of the part of a log that begins where its run may.

    Args:
        log: a log in which no run of the candidate was found: its commands don't tell where.
        task: the task with the control step.
        own: the candidate.
    """
    acts = not np.allclose(log.whole.inputs, own.policy.past, rtol=0, atol=1e-9)
    logged = [name for name in task.model.state_names if name in log.logged]
    for begins in dict.fromkeys([log.first, *log.openings[:TRIED]]):
        if (trial := log.trial_from(begins)) is None:
            continue
        run = trial.until(min(trial.finite_steps, task.horizon))
        plain = follows(own.policy, run, latest(task))
        yield from stories(task, own, run, plain, acts=acts, logged=logged)
        if smooth := smoothed(task.model, own, run):
            yield scored(Kind.PROGRAM, smooth.finding(own), own, run, smooth.left, price=LEADS)


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
    every = (*task.model.state_names, *task.model.input_names)
    tried = dict.fromkeys(
        (*full_scales(task, log.whole.inputs), *of_commands(task.model, log.whole.inputs))
    )
    for account in tried:
        names, by = tuple(every[k] for k in account.columns), 1 / account.factor
        if {*names} <= {*log.logged}:
            some = {n: replace(log.logged[n], values=log.logged[n].values * by) for n in names}
            if its := _read_as(log, task, own, some):
                run, error, _ = its
                yield scored(Kind.UNIT, None, own, run, error, names=names, by=by)


def _read_as(
    log: Recording, task: Task, own: Candidate, changed: Mapping[str, Series]
) -> tuple[Trial, float, float] | None:
    """Return the run in a log with other columns, what is left of its commands, and its start.

    None if there is none, or if it is farther from its prediction than as it was logged.
    """
    other = recording({**log.logged, **changed}, task, log.complete)
    begun = other.start_of(own.policy, only_alike=True) if other else None
    run = other.trial_from(begun.seconds) if other and begun and begun.alike else None
    fit = follows(own.policy, run.until(own.policy.horizon), 0) if run else None
    if not begun or not run or not fit or fit.error >= EXPLAINED:
        return None
    as_logged = log.trial_from(begun.seconds)
    if as_logged is not None and apart(own, run) > apart(own, as_logged):
        return None
    return run, fit.error, begun.seconds


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
        if its := _read_as(log, task, own, back):
            run, error, begins = its
            story = scored(Kind.LOG, None, own, run, error, price=LEADS, names=(a, b))
            some.append((story, begins))
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
    (a, b), model = story.names, task.model
    every = (*model.state_names, *model.input_names)
    fault = Account("exchange", pairs=((every.index(a), every.index(b)),))
    run, facts = log.trial_from(begins), dict[str, Any](ran=own.id, proven=tuple(proven(fault)))
    if run is None or not contradicted(model, run.until(run.known_steps), range(model.n), fault):
        return replace(story, finding=found("log.exchange", a, b, **facts))
    parts = "states" if a in model.state_names else "outputs"
    told = found("run.exchanged", a, b, parts=parts, moved="as the log says", **facts)
    return replace(story, finding=told, rerun=True)


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
