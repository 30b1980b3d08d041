"""Decide which candidates improved, given the noise of real systems; see also `difference`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING

import numpy as np

from grounded.search.candidate import Candidate, Tried
from grounded.search.difference import LUCK, Difference
from grounded.search.scatter import (
    NoiseSoFar,
    Repeats,
    StartShare,
    by_pieces,
    noise_cost,
    noise_missed,
    with_errors,
)
from grounded.task import Task
from grounded.trial import Trial, scattered

if TYPE_CHECKING:
    from grounded.search.starts import Starts
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
    share = StartShare()
    ids = {c.id for c in candidates}
    known = {trial.id for trial in trials}
    spent = sum(t.candidate in ids for t in trials) >= options.max_trials
    by_name: dict[str, list[Trial]] = {}
    for trial in trials:
        by_name.setdefault(trial.candidate, []).append(trial.whole(task.horizon))
    agree = not scattered([trial for one in ids for trial in by_name.get(one, ())])
    for candidate in candidates:
        own = tuple(by_name.get(candidate.id, ()))
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
        share.add(tried)
        tried = replace(tried, placed=share.most)
        better = incumbent is None or tried.utility > incumbent.utility
        if better and not failed:
            tried = replace(tried, accepted=True)
            iteration += incumbent is not None
            incumbent, losses = tried, 0
            history = [_settled(one) for one in history]
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
    best_one = incumbent and incumbent.candidate
    noises = NoiseSoFar(trials, task.model.n)
    since = [*accumulate((noises.first(c.id) for c in reversed(candidates)), min)][::-1]
    pairs = zip(history, since, strict=True)
    whole = [_with_noise(task, tried, noises, first) for tried, first in pairs]
    pool = Repeats(whole)
    told = with_chances(with_errors(whole, pool), pool)
    best = next((t for t in told if t.candidate is best_one), None)
    return told, best, iteration


def _with_noise(task: Task, tried: Tried, noises: NoiseSoFar, since: int) -> Tried:
    """Return the candidate with the mean cost of the noise in its logs, and what was promised.

    The promise is made with the noise known before its first run, and stays as it is.

    Args:
        task: its reward judges the logs.
        tried: the candidate.
        noises: the noise of the sensors over time.
        since: place of the first trial of the candidate or of a later one.
    """
    made = tried.candidate
    missed = noise_missed(task, made, noises.before(since, made.seen))
    cost = noise_cost(task, made.policy, noises.now) if tried.trials else 0.0
    return replace(tried, noise_cost=cost, noise_missed=missed)


def _settled(tried: Tried) -> Tried:
    """Return a candidate whose loss was in doubt as one that lost: a later one beat both runs."""
    return replace(tried, accepted=False, in_doubt=False, to_settle="") if tried.in_doubt else tried


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


def with_chances(history: Sequence[Tried], pool: Repeats) -> tuple[Tried, ...]:
    """Return the candidates; every improvement gets the probability that it is one."""
    found, best = list(history), None
    for k, tried in enumerate(history):
        if tried.accepted and best is not None:
            gained = Difference(best, tried, history, pool)
            sure = gained.probability
            unsure = math.isnan(sure) and not gained.clear
            found[k] = replace(tried, probability=sure, unsure=unsure)
        best = tried if tried.accepted else best
    return tuple(found)
