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

from grounded.frozen import Array
from grounded.search.candidate import Candidate
from grounded.search.returned.as_predicted import apart
from grounded.search.returned.misused import NEAR, NEARLY_ALL, TELLS, Way, likeliest, misused, ways
from grounded.search.returned.who_drove import follows, latest
from grounded.task import Task
from grounded.trial import Trial
from grounded_trials.workspace.intake.acted_on import EXACT, FEW, acted_on
from grounded_trials.workspace.intake.instants import BATCH, least_of
from grounded_trials.workspace.intake.run_start import TRIED, Recording

EACH, ALL = 3, 16  # numbers of instants that are examined for a misuse, and in all


def exactly_misused(log: Recording, task: Task, own: Candidate) -> str:
    """Return how a program misused its candidate, if its commands are that to the last digits.

    Args:
        log: a log in which no run of the candidate was found.
        task: the task with the control step.
        own: the candidate.

    Returns:
        The end of a sentence about its commands; "" if nothing reproduces them.
    """
    tried = [
        (*one, way) for way in ways(task.model, own, unsent=False) for one in _begins(log, way)
    ]
    found = list[tuple[float, Way]]()
    for _, k, way in sorted(tried, key=lambda one: one[0])[:ALL]:
        at = log.on_step(way.policy, log.first + k * log.dt / log.parts)
        left = _left(log, own, way, at)
        if left < EXACT and not _rather_logged(log, own, way, at):
            found.append((left, way))
    return likeliest(found).said if found else ""


def misused_in(log: Recording, task: Task, own: Candidate) -> str:
    """Return how the robot's program misused its candidate, and the remedy; or "".

    Args:
        log: a log in which no run of the candidate was found: its commands don't tell where.
        task: the task with the control step.
        own: the candidate.
    """
    for begins in dict.fromkeys([log.first, *log.openings[:TRIED]]):
        if trial := log.trial_from(begins):
            run = trial.until(min(trial.finite_steps, task.horizon))
            plain = follows(own.policy, run, latest(task))
            if plain and not plain.beyond and (told := misused(task, own, run, plain)):
                return told
    return ""


def _begins(log: Recording, way: Way) -> Iterator[tuple[float, int]]:
    """Yield the instants at which a misused run begins most likely, with the share of strays.

    Commands at a limit that the policy sends as well don't count.
    """
    whole, policy = log.whole, way.policy
    T, parts = least_of(policy.horizon), log.parts
    states = way.passed(Trial(whole.states, whole.inputs, log.dt / parts, *log.names)).states
    sent = np.clip(whole.inputs, policy.low, policy.high)
    size = np.abs(sent).max(axis=0) + 1e-12
    every = np.arange(0, len(sent) - parts * T, parts)
    strays = np.full(len(every), np.inf)
    for first in range(0, len(every), BATCH):
        here = every[first : first + BATCH, None] + parts * np.arange(T)
        u = sent[here + parts // 2]
        asked = policy.commands(states[here], policy.past, u)
        told = (_inside(policy.low, asked, policy.high) | _inside(policy.low, u, policy.high)) | (
            asked != u
        )
        off = np.abs(asked - u) / size > NEAR
        count, stray = told.any(axis=2).sum(axis=1), (told & off).any(axis=2).sum(axis=1)
        strays[first : first + BATCH] = np.where(count < FEW, np.inf, stray / np.maximum(count, 1))
    for i in np.argsort(strays)[:EACH]:
        if np.isfinite(strays[i]):
            yield float(strays[i]), int(every[i])


def _inside(low: Array, u: Array, high: Array) -> Array:
    found: Array = (u > low) & (u < high)
    return found


def _left(log: Recording, own: Candidate, way: Way, at: float) -> float:
    """Return the median difference that a misuse leaves; infinite if it does not explain a run."""
    fit, plain = acted_on(_as_passed(log, way), way.policy, at), acted_on(log, own.policy, at)
    if fit is None or plain is None or plain.exact or not fit.throughout:
        return np.inf
    tells = fit.told & (np.abs(fit.asked - plain.asked) > TELLS * fit.size).any(axis=1)
    sure = tells.sum() >= FEW and np.mean(fit.off[tells] < EXACT) >= NEARLY_ALL
    return fit.left if sure else np.inf


def _as_passed(log: Recording, way: Way) -> Recording:
    """Return a log with its states as the program passed them."""
    series = dict(log.series)
    if way.exchanged:
        one, other = way.names
        series[one], series[other] = series[other], series[one]
    else:
        for name in way.names:
            spec = series[name].spec
            scaled = replace(spec, scale=spec.scale * way.factor, offset=spec.offset * way.factor)
            series[name] = replace(series[name], spec=scaled)
    return replace(log, series=series)


def _rather_logged(log: Recording, own: Candidate, way: Way, at: float) -> bool:
    """Return whether the log is rather wrong than the program: mended, it is as predicted."""
    if not way.names or (trial := log.trial_from(at)) is None:
        return False
    return apart(own, way.passed(trial)) < apart(own, trial)
