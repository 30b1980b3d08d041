"""The stories of a log in which no run of its candidate was found, wherever its run may begin.

The commands don't tell where: so the rows of the table (`grounded.accounts.returned`) are compared
at the instants at which commands begin to change; and if none of them explains a run, each row from
the instants at which it leaves the fewest strays. A row is also certain if it gives the logged
commands to the last digits on the samples that the program acted on: the control grid is too coarse
for degrees passed as radians, with which a millisecond moves a command from one limit to the other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from grounded.accounts.returned import (
    NEARLY_ALL,
    Kind,
    Row,
    Story,
    known_rows,
    scored,
    stories,
    stories_of,
)
from grounded.accounts.sent import EXACT, SLIGHT, apart, follows, latest
from grounded.search.candidate import Candidate
from grounded.task import Task
from grounded.trial import Trial
from grounded_trials.workspace.intake.opening.acted_on import FEW, acted_on, held_before
from grounded_trials.workspace.intake.opening.run_start import (
    BATCH,
    TRIED,
    Recording,
    Start,
    least_of,
)

APART = 10 * EXACT  # smallest difference of two commands that exact ones tell apart
MANY = 300_000  # largest number of commands that are computed for a row, roughly
EACH, ALL = 2, 24  # numbers of instants that are examined for a row, and in all


def stories_of_log(log: Recording, task: Task, own: Candidate, start: Start | None) -> list[Story]:
    """Return the stories of a log that explain its commands as its candidate's.

    Args:
        log: a log whose commands are not the candidate's.
        task: the task with the control step.
        own: the candidate.
        start: the start that fits best, if any.
    """
    at = [*([start.seconds] if start else []), log.first, *log.openings[:TRIED]]
    some = list[Story]()
    for begins in dict.fromkeys(log.on_step(own.policy, one) for one in at):
        some += _from(log, task, own, begins)
    if min((one.commands for one in some), default=0.0) > np.log(APART):
        some += _wherever(log, task, own)
    return some


def _from(log: Recording, task: Task, own: Candidate, begins: float) -> list[Story]:
    """Return the stories of the part of a log that begins at an instant [s]."""
    if (trial := log.trial_from(begins)) is None:
        return []
    run = trial.until(min(trial.finite_steps, task.horizon))
    plain = follows(own.policy, run, latest(task))
    return stories(
        task,
        own,
        run,
        plain,
        acts=_acts(log, own),
        logged=log.measured,
        waits=log.waits,
    )


def _acts(log: Recording, own: Candidate) -> bool:
    return not np.allclose(log.whole.inputs, own.policy.past, rtol=0, atol=1e-9)


def _wherever(log: Recording, task: Task, own: Candidate) -> Iterator[Story]:
    """Yield the stories of the instants from which some row leaves few strays."""
    first, every = _steps_of(log, own)
    if every.steps < least_of(own.policy.horizon):
        return
    rows = known_rows(task, own, every, acts=_acts(log, own), logged=log.measured)
    tried = [(*one, row) for row in rows for one in _begins(every, row)]
    for _, k, row in sorted(tried, key=lambda one: one[0])[:ALL]:
        at = log.on_step(own.policy, first + k * log.dt)
        if (trial := log.trial_from(at)) is None:
            continue
        trial = trial.until(min(trial.finite_steps, task.horizon))
        if row.program is not None and apart(own, trial) <= apart(own, row.of(trial)):
            if np.isfinite(left := _exactly(log, own, row, at)):
                yield scored(Kind.PROGRAM, row.told, own, trial, left, price=row.program)
        elif row.log is not None and (plain := follows(own.policy, trial, latest(task))):
            each = stories_of(row, task, own, trial, plain)
            yield from (one for one in each if one.kind is not Kind.PROGRAM)


def _steps_of(log: Recording, own: Candidate) -> tuple[float, Trial]:
    """Return the steps of a whole log with the samples before each command, and their first [s]."""
    first = log.on_step(own.policy, log.first)
    middle = round((first - log.first) * log.parts / log.dt) + log.parts // 2
    sent = log.whole.inputs[max(0, middle) :: log.parts]
    return first, Trial(held_before(log, first, len(sent) + 1), sent, log.dt, *log.names)


def _begins(every: Trial, row: Row) -> Iterator[tuple[float, int]]:
    """Yield the share of strays, and the steps from which a row leaves fewest.

    Commands at a limit that the policy sends as well don't count.
    """
    policy, steps, passed = row.policy, every.steps, row.of(every)
    T = int(np.clip(MANY // max(steps, 1), least_of(policy.horizon), policy.horizon))
    sent = np.clip(passed.inputs, policy.low, policy.high)
    size = np.abs(sent).max(axis=0) + 1e-12
    strays = np.full(steps, np.inf)
    for first in range(0, steps, BATCH):
        here = np.arange(first, min(first + BATCH, steps))[:, None] + np.arange(T)
        known, here = here < steps, np.minimum(here, steps - 1)
        u = sent[here]
        asked = policy.commands(passed.states[here], policy.past, u)
        told = known[:, :, None] & ((asked != u) | ((u > policy.low) & (u < policy.high)))
        stray = told & (np.abs(asked - u) / size > SLIGHT)
        count, lost = (one.any(axis=2).sum(axis=1) for one in (told, stray))
        strays[first : first + BATCH] = np.where(count < FEW, np.inf, lost / np.maximum(count, 1))
    for k in np.argsort(strays, kind="stable")[:EACH]:
        if np.isfinite(strays[k]):
            yield float(strays[k]), int(k)


def _exactly(log: Recording, own: Candidate, row: Row, at: float) -> float:
    """Return what a row leaves of commands that it explains to the last digits, else infinity."""
    if row.off is not None or row.share or row.steps:
        return np.inf
    fit, plain = acted_on(_as_passed(log, row), row.policy, at), acted_on(log, own.policy, at)
    if fit is None or plain is None or plain.exact or not fit.throughout:
        return np.inf
    differs = np.abs(fit.asked - plain.asked) > APART * fit.size
    tells = np.isfinite(fit.off) & differs.any(axis=1)
    moves = np.abs(np.diff(fit.asked[tells], axis=0)) > EXACT * fit.size
    if moves.any(axis=1).sum() < FEW:  # many a program holds an input
        return np.inf
    return fit.left if np.mean(fit.off[tells] < EXACT) >= NEARLY_ALL else np.inf


def _as_passed(log: Recording, row: Row) -> Recording:
    """Return a log with its states as the program passed them."""
    series = dict(log.series)
    if row.order:
        series |= {n: log.series[p] for n, p in zip(sum(log.names, ()), row.order, strict=True)}
    else:
        for name in row.names:
            spec = series[name].spec
            scaled = replace(spec, scale=spec.scale * row.by, offset=spec.offset * row.by)
            series[name] = replace(series[name], spec=scaled)
    return replace(log, series=series)
