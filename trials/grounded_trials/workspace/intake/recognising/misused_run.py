"""Find a run in a log whose program misused the candidate, wherever the run begins.

A misuse is certain if it gives the logged commands to the last digits on the samples that the
program acted on, in nearly all steps in which it differs from the right use. Both are compared
there: a grid is too coarse for degrees passed as radians, with which a millisecond moves a command
from one limit to the other. Where the run may begin is sought on the grid first, for each misuse.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from grounded.findings import found
from grounded.model import Model
from grounded.result import figure, with_unit
from grounded.search.candidate import Candidate
from grounded.search.returned.as_predicted import apart
from grounded.search.returned.clipped import Clipped, clipped
from grounded.search.returned.stories import NEARLY_ALL, Kind, Story, Way, scored, ways
from grounded.search.returned.who_drove import (
    EXACT,
    RESEMBLES,
    SLIGHT,
    Commanded,
    commanded,
    follows,
)
from grounded.task import Task
from grounded.trial import Trial
from grounded_trials.workspace.intake.locating.acted_on import FEW, acted_on, held_before
from grounded_trials.workspace.intake.locating.missed_steps import other_clock
from grounded_trials.workspace.intake.locating.run_start import (
    BATCH,
    TRIED,
    Recording,
    Start,
    least_of,
)

APART = 10 * EXACT  # smallest difference of two commands that exact ones tell apart
MOSTLY = 0.9  # least share of the steps in which cut commands are near what is logged
MANY = 300_000  # largest number of commands that are computed for a misuse, roughly
EACH, ALL = 2, 24  # numbers of instants that are examined for a misuse, and in all


def misuses(log: Recording, task: Task, own: Candidate, start: Start | None) -> Iterator[Story]:
    """Yield the stories by which a program misused its candidate.

    Args:
        log: a log whose commands are not the candidate's.
        task: the task with the control step.
        own: the candidate.
        start: the start that fits best, if any.
    """
    yield from exactly_misused(log, task, own)
    if clock := other_clock(log, own):
        finding, step, error = clock
        rest = replace(own, predicted_states=own.predicted_states[step:])
        if run := log.trial_from(log.on_step(own.policy, log.openings[0])):
            yield scored(Kind.PROGRAM, finding, rest, run, error)
    yield from cut_in(log, own, start)
    yield from other_origin(log, task.model, own)


def exactly_misused(log: Recording, task: Task, own: Candidate) -> Iterator[Story]:
    """Yield how a program misused its candidate, if its commands are that to the last digits.

    Args:
        log: a log in which no run of the candidate was found.
        task: the task with the control step.
        own: the candidate.
    """
    first, every = _steps_of(log, own)
    misuses = ways(task.model, own, unsent=False)
    tried = [(*one, way) for way in misuses for one in _begins(every, way)]
    some = list[tuple[float, Way, Trial]]()
    for _, k, way in sorted(tried, key=lambda one: one[0])[:ALL]:
        at = first + k * log.dt
        left, run = _left(log, own, way, at), log.trial_from(at)
        if left < EXACT and run and apart(own, run) <= apart(own, way.passed(run)):
            some.append((left, way, run))  # else rather the log is wrong
    if some:
        left, way, run = min(some, key=lambda one: (-len(one[1].names), one[0]))
        yield scored(Kind.PROGRAM, way.finding, own, run, left)


def other_origin(log: Recording, model: Model, own: Candidate) -> Iterator[Story]:
    """Yield that a program passed its candidate states from another origin than the logged ones.

    That is, two or more of them.

    To first order, exact for states that are no angles, states that are off by d change a command
    by the gains times d. Constant offsets that leave nothing of the difference are what it passed.

    Args:
        log: a log whose commands are not the candidate's.
        model: with the units of the states.
        own: the candidate.
    """
    policy, n = own.policy, model.n
    if policy.gain is None or (policy.state_names, policy.input_names) != log.names:
        return
    starts, runs = [log.first, *log.openings[:TRIED]], list[tuple[Trial, Commanded]]()
    for begins in dict.fromkeys(log.on_step(policy, one) for one in starts):
        trial = log.trial_from(begins)
        if trial is not None and min(trial.finite_steps, policy.horizon) >= least_of(
            policy.horizon
        ):
            runs.append((trial, commanded(policy, trial)))
    # from the right start, its own commands may be nearer than any offset makes those of another
    each = [float(np.median(np.abs(r.sent - r.asked) / r.size)) for _, r in runs]
    nearest = min(each, default=0.0)
    for trial, run in runs:
        free = (run.sent > policy.low) & (run.sent < policy.high)
        free &= (run.asked > policy.low) & (run.asked < policy.high)
        off = ((run.sent - run.asked) / run.size)[free]
        gains = (policy.gain[: len(free), :, :n] / run.size[:, None])[free]
        if free.any(axis=1).sum() < FEW * n or float(np.median(np.abs(off))) < APART:
            continue
        by = np.linalg.lstsq(gains, off, rcond=1e-6)[0]
        left = float(np.median(np.abs(off - gains @ by)))
        if left > min(RESEMBLES * float(np.median(np.abs(off))), nearest):
            continue
        does = np.abs(gains * by).max(axis=0) > RESEMBLES * np.abs(off).max()
        if does.sum() < 2:  # of one state, its sensor's zero may differ as well
            continue
        shares = zip(model.states.items(), by, does, strict=True)
        beside = tuple(f"{n} {with_unit(figure(x, 2), u)}" for (n, u), x, is_ in shares if is_)
        told = found("run.origin", ran=own.id, off=beside)
        yield scored(Kind.PROGRAM, told, own, trial, left, price=0.5 * does.sum())


def cut_in(log: Recording, own: Candidate, start: Start | None) -> Iterator[Story]:
    """Yield that a program cut its candidate's commands inside their limits, wherever it began.

    Multiplied by any large number, commands that a cut holds at one value are at their limit, as
    the policy's may be: another unit, it seemed. In the run they follow the policy below the cut.

    Args:
        log: a log whose commands are not the candidate's.
        own: the candidate.
        start: the start that fits best, if any.
    """
    starts = [*([start.seconds] if start else []), log.first, *log.openings[:TRIED]]
    for begins in dict.fromkeys(log.on_step(own.policy, one) for one in starts):
        if (trial := log.trial_from(begins)) and (cut := clipped(own, trial)):
            if not _was_sent(own, cut, log):
                continue
            run = trial.until(min(trial.finite_steps, own.policy.horizon))
            low, high = cut.bounds(own)
            within = replace(own.policy, low=low, high=high)
            sent, fit = commanded(within, run), follows(within, run, 0)
            off = (np.abs(sent.asked - sent.sent) / sent.size).max(axis=1)
            if (off <= SLIGHT).mean() >= MOSTLY or (fit and fit.alike):
                error = float(np.median(off))
                yield scored(Kind.PROGRAM, cut.finding(own), own, run, error)
                return


def _was_sent(own: Candidate, cut: Clipped, log: Recording) -> bool:
    """Return whether cut commands were sent at all, unlike those before a run and after it."""
    (low, high), held = cut.bounds(own), log.past
    above = (low >= held) & (low > own.policy.low)
    return not (above | ((high <= held) & (high < own.policy.high))).any()


def _steps_of(log: Recording, own: Candidate) -> tuple[float, Trial]:
    """Return the steps of a whole log with the samples before each command, and their first [s]."""
    first = log.on_step(own.policy, log.first)
    middle = round((first - log.first) * log.parts / log.dt) + log.parts // 2
    sent = log.whole.inputs[max(0, middle) :: log.parts]
    return first, Trial(held_before(log, first, len(sent) + 1), sent, log.dt, *log.names)


def _begins(every: Trial, way: Way) -> Iterator[tuple[float, int]]:
    """Yield the share of strays, and the steps from which a misused run leaves fewest.

    Commands at a limit that the policy sends as well don't count.
    """
    policy, steps = way.policy, every.steps
    T = int(np.clip(MANY // max(steps, 1), least_of(policy.horizon), policy.horizon))
    states = way.passed(every).states
    sent = np.clip(every.inputs, policy.low, policy.high)
    size = np.abs(sent).max(axis=0) + 1e-12
    strays = np.full(steps, np.inf)
    for first in range(0, steps, BATCH):
        here = np.arange(first, min(first + BATCH, steps))[:, None] + np.arange(T)
        known, here = here < steps, np.minimum(here, steps - 1)
        u = sent[here]
        asked = policy.commands(states[here], policy.past, u)
        told = known[:, :, None] & ((asked != u) | ((u > policy.low) & (u < policy.high)))
        stray = told & (np.abs(asked - u) / size > SLIGHT)
        count, lost = (one.any(axis=2).sum(axis=1) for one in (told, stray))
        strays[first : first + BATCH] = np.where(count < FEW, np.inf, lost / np.maximum(count, 1))
    for k in np.argsort(strays, kind="stable")[:EACH]:
        if np.isfinite(strays[k]):
            yield float(strays[k]), int(k)


def _left(log: Recording, own: Candidate, way: Way, at: float) -> float:
    """Return the median difference that a misuse leaves; infinite if it does not explain a run."""
    fit, plain = acted_on(_as_passed(log, way), way.policy, at), acted_on(log, own.policy, at)
    if fit is None or plain is None or plain.exact or not fit.throughout:
        return np.inf
    differs = np.abs(fit.asked - plain.asked) > APART * fit.size
    tells = np.isfinite(fit.off) & differs.any(axis=1)
    moves = np.abs(np.diff(fit.asked[tells], axis=0)) > EXACT * fit.size
    if moves.any(axis=1).sum() < FEW:  # many a program holds an input
        return np.inf
    return fit.left if np.mean(fit.off[tells] < EXACT) >= NEARLY_ALL else np.inf


def _as_passed(log: Recording, way: Way) -> Recording:
    """Return a log with its states as the program passed them."""
    series = dict(log.series)
    if way.order:
        given = zip(way.policy.state_names, way.order, strict=True)
        series |= {name: log.series[passed] for name, passed in given}
    else:
        for name in way.names:
            spec = series[name].spec
            scaled = replace(spec, scale=spec.scale * way.factor, offset=spec.offset * way.factor)
            series[name] = replace(series[name], spec=scaled)
    return replace(log, series=series)
