"""Decide which candidates improved, given the noise of real systems; see also `difference`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from grounded.search.candidate import Candidate, Tried
from grounded.search.difference import LUCK, Difference, Repeats, by_pieces
from grounded.search.noise import known_noise, noise_cost, noise_missed, sensor_noise
from grounded.task import Task
from grounded.trial import Trial, scattered

if TYPE_CHECKING:
    from grounded.search.difference import Starts
    from grounded.search.step.step_size import SearchOptions


def judged(
    task: Task,
    candidates: Sequence[Candidate],
    trials: Sequence[Trial],
    options: SearchOptions,
    model: str,
    starts: Starts | None = None,
) -> tuple[tuple[Tried, ...], Tried | None, int]:
    """Return every candidate with its trials and verdict, the incumbent, and the iterations.

    A candidate is accepted by measured utilities alone, as in the paper: a model that is told the
    start by one noisy sample was wrong by half of what it explained. A loss that different start
    states explain is in doubt.
    """
    history: list[Tried] = []
    incumbent: Tried | None = None
    iteration = losses = 0  # accepted improvements; steps from the incumbent that did not improve
    exact = False  # whether the system has repeated itself to the last bit
    known = {trial.id for trial in trials}
    runs: dict[str, list[Trial]] = {one.id: [] for one in candidates}
    for trial in trials:
        if trial.candidate in runs:
            runs[trial.candidate].append(trial.whole(task.horizon))
    every = [trial for some in runs.values() for trial in some]
    spent, agree = len(every) >= options.max_trials, not scattered(every)
    for candidate in candidates:
        own = tuple(runs[candidate.id])
        utilities = tuple(task.utility(t) for t in own)
        gone = tuple(one for one in candidate.seen if one not in known)
        failed = any(u == -np.inf for u in utilities)
        exact = exact or (agree and repeated_exactly(own))
        enough = min(options.repeats, len(own)) if exact and own else options.repeats
        if len(own) < enough and not failed:
            history.append(Tried(candidate, own, utilities, None, gone=gone))
            continue
        pieces = by_pieces(task, own) if len(own) > 1 and np.isfinite(utilities).all() else None
        tried = Tried(candidate, own, utilities, False, pieces=pieces, gone=gone, starts=starts)
        better = incumbent is None or tried.utility > incumbent.utility
        if better and not failed:
            tried = replace(tried, accepted=True)
            iteration += incumbent is not None
            incumbent, losses = tried, 0
            # a loss that was in doubt is one: this candidate beat both runs
            history = [
                replace(t, accepted=False, in_doubt=False, to_settle="") if t.in_doubt else t
                for t in history
            ]
        elif incumbent is not None and (candidate.base, candidate.model) == (
            incumbent.candidate.id,
            model,
        ):
            losses += 1
            most, once = losses + options.repeats, options.repeats + 1
            if (
                options.rerun_incumbent
                and not (spent or exact)
                and in_doubt(incumbent, tried, history, most, once)
            ):
                again = to_settle(incumbent, tried, most, once)
                name = again.candidate.id if again else ""
                tried = replace(tried, accepted=None, in_doubt=True, to_settle=name)
        history.append(tried)
    told = _told(task, history, trials)
    best = next((t for t in told if incumbent and t.candidate is incumbent.candidate), None)
    return told, best, iteration


def _told(task: Task, history: Sequence[Tried], trials: Sequence[Trial]) -> tuple[Tried, ...]:
    """Return the candidates with the noise in their logs, their scatter, and how sure gains are."""
    pool, now, n = Repeats(history), sensor_noise(trials, task.model.n), task.model.n
    found, best = list[Tried](), None
    for tried in history:
        made = tried.candidate
        tried = replace(
            tried,
            noise_missed=noise_missed(task, made, known_noise(trials, made, n)),
            noise_cost=noise_cost(task, made.policy, now) if tried.trials else 0.0,
            deviation=math.sqrt(pool.near(tried.utility).variance),
        )
        found.append(with_chance(tried, best, history, pool))
        best = tried if tried.accepted else best
    return tuple(found)


def with_chance(tried: Tried, best: Tried | None, history: Sequence[Tried], pool: Repeats) -> Tried:
    """Return a candidate; an improvement on the best before it gets the probability that it is."""
    if not tried.accepted or best is None:
        return tried
    gained = Difference(best, tried, history, pool)
    return replace(tried, probability=gained.probability, unsure=not gained.sure)


def repeated_exactly(trials: Sequence[Trial]) -> bool:
    """Return whether two successive trials have exactly the same states."""
    return any(a.repeats(b) for a, b in pairwise(trials))


def in_doubt(
    incumbent: Tried, loser: Tried, history: Sequence[Tried], most: int, once: int = 2
) -> bool:
    """Return whether a loss may be due to a lucky trial of the incumbent, or to other start states.

    What different start states explain of it (`Tried.excused`) is no loss. A lucky incumbent would
    block every further step. So after a loss within two standard errors the incumbent is run again,
    until it has `most` trials: one for each loss; a loser whose starts explain it is, until it has
    `once`. Without repeats at a similar utility a loss of more than 1.4 times the best cost is
    accepted at once (`Difference.likely_error`). On a deterministic system this costs one trial per
    incumbent.
    """
    if not np.isfinite(loser.utility) or to_settle(incumbent, loser, most, once) is None:
        return False
    lead = Difference(loser, incumbent, (*history, loser))
    return not -loser.gain_over(incumbent) > LUCK * lead.likely_error


def to_settle(incumbent: Tried, loser: Tried, most: int, once: int = 2) -> Tried | None:
    """Return which of two candidates to run again after a loss; None if that was done enough.

    It is the incumbent, which may have been lucky, but the one whose starts matter more if start
    states explain the loss. An incumbent is not run again that has `most` trials, nor a loser that
    has `once`: where a robot can't be placed more exactly, a further run begins no nearer.
    """
    either = [(incumbent, most)]
    if loser.starts is not None and loser.excused(incumbent):
        either, cost = [(loser, min(once, most)), (incumbent, most)], loser.starts.cost
        either.sort(key=lambda one: -abs(cost(one[0])))
    return next((one for one, runs in either if len(one.trials) < runs), None)
