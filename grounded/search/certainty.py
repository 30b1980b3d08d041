"""Which candidates improved, and how sure that is: real systems seldom do the same thing twice."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from grounded.search.candidate import Candidate, Tried
from grounded.search.scatter import (
    Repeats,
    beyond_noise,
    by_pieces,
    noise_cost,
    white_noise,
    with_errors,
)
from grounded.task import Task
from grounded.trial import Trial, scattered

if TYPE_CHECKING:
    from grounded.search.standing import SearchOptions

FAR = 1e100  # in its unit: "noise" of a run that flew off
PART = 0.3  # of a gain: less than that by where runs began is not told
FEW = 4.0  # degrees of freedom, with which two standard errors are no certainty


def judged(
    task: Task,
    candidates: Sequence[Candidate],
    trials: Sequence[Trial],
    options: SearchOptions,
    model: str,
) -> tuple[tuple[Tried, ...], Tried | None, int]:
    """Every candidate with its trials, accepted or not; the incumbent; iterations done."""
    history: list[Tried] = []
    incumbent: Tried | None = None
    iteration = losses = 0  # accepted improvements; steps from the incumbent that did not improve
    exact = False  # whether the system has repeated itself to the last bit
    ids = {c.id for c in candidates}
    spent = sum(t.candidate in ids for t in trials) >= options.max_trials
    by_name: dict[str, list[Trial]] = {}
    for trial in trials:
        by_name.setdefault(trial.candidate, []).append(trial.whole(task.horizon))
    agree = not scattered([trial for one in ids for trial in by_name.get(one, ())])
    for candidate in candidates:
        own = tuple(by_name.get(candidate.id, ()))
        utilities = tuple(task.utility(t) for t in own)
        failed = any(u == -np.inf for u in utilities)
        exact = exact or (agree and repeated_exactly(own))
        enough = min(options.repeats, len(own)) if exact and own else options.repeats
        if len(own) < enough and not failed:
            history.append(Tried(candidate, own, utilities, None))
            continue
        better = incumbent is None or float(np.mean(utilities)) > incumbent.utility
        accepted = better and not failed
        pieces = by_pieces(task, own) if len(own) > 1 and np.isfinite(utilities).all() else None
        tried = Tried(candidate, own, utilities, accepted, pieces=pieces)
        if accepted:
            iteration += incumbent is not None
            incumbent, losses = tried, 0
        elif incumbent is not None and (candidate.base, candidate.model) == (
            incumbent.candidate.id,
            model,
        ):
            losses += 1
            if (
                options.rerun_incumbent
                and not (spent or exact)
                and in_doubt(incumbent, tried, history, losses + options.repeats)
            ):
                tried = replace(tried, accepted=None, in_doubt=True)
        history.append(tried)
    best_one = incumbent and incumbent.candidate
    asked = [t.candidate is best_one or not t.candidate.grounded for t in history]
    told = with_errors(
        [_with_noise(task, t) if ask else t for ask, t in zip(asked, history, strict=True)]
    )
    best = next((t for t in told if t.candidate is best_one), None)
    return told, best, iteration


def _with_noise(task: Task, tried: Tried) -> Tried:
    """The same with what the noise in its own logs costs in the mean; without a log as it is."""
    if not tried.trials:
        return tried
    each = np.minimum([white_noise(trial.states) for trial in tried.trials], FAR)
    noise = np.sqrt(np.mean(each**2, axis=0))
    return replace(tried, noise_cost=noise_cost(task, tried.candidate.policy, noise))


def repeated_exactly(trials: Sequence[Trial]) -> bool:
    """Whether two trials of a candidate have the very same states."""
    return any(a.repeats(b) for a, b in pairwise(trials))


def in_doubt(incumbent: Tried, loser: Tried, history: Sequence[Tried], most: int) -> bool:
    """Whether a loss may be luck: the incumbent's, whose trials were the best of several.

    A lucky winner blocks every step from there on. So a loss within two standard errors sends the
    incumbent out once more, until it has `most` trials: one for each loss. Where nothing near it
    was repeated, a run is taken to scatter by half of its utility, that of chi-squared with eight
    degrees of freedom: a loss by more than 1.4 times the best cost is believed at once. Where
    trials repeat themselves exactly, it costs one trial a winner.
    """
    if not np.isfinite(loser.utility) or len(incumbent.trials) >= most:
        return False
    scatter = Repeats((*history, loser)).near(incumbent.utility)
    each = math.sqrt(scatter.variance) if scatter.known else 0.5 * abs(incumbent.utility)
    error = each * np.sqrt(1 / len(incumbent.trials) + 1 / len(loser.trials))
    return not incumbent.utility - loser.utility > 2 * error


def last_improvement(history: Sequence[Tried], again: str = "run the best one again") -> str:
    """How sure the last accepted improvement is, as a sentence; "" before there is one.

    Student's t-test with the scatter of all repeats near the two (`scatter`), of which their
    standard errors in the table are made.
    """
    accepted = [t for t in history if t.accepted]
    if len(accepted) < 2:
        return ""
    before, after = accepted[-2], accepted[-1]
    gain, start = after.utility - before.utility, owed_to_start(before, after, history)
    if start:
        return (
            f"the last gain is {gain:.3g}: where the runs of {before.candidate.id} and "
            f"{after.candidate.id} began makes {start:.3g} of the difference, as the model sees "
            f"it, and the policy {gain - start:.3g}; run {before.candidate.id} again from "
            "[task] start to be sure"
        )
    error, freedom = error_between(before, after, history)
    if not freedom:
        return (
            f"the last gain is {gain:.3g}; all candidates near it were run once, so the noise of "
            f"a trial is unknown: {again}"
        )
    if error == 0:
        return f"the last gain is {gain:.3g}; repeated trials agree exactly"
    probability = student(gain / error, freedom)
    return (
        f"the last gain is {gain:.3g} +- {error:.2g}: an improvement with probability "
        f"{probability:.2f}" + ", for so few repeats" * (freedom < FEW)
    )


def owed_to_start(before: Tried, after: Tried, history: Sequence[Tried]) -> float:
    """How much of a gain comes of where the runs of the two began; 0 where it is a small part.

    A run from elsewhere than s_0 costs more or less, whatever the policy. What that is worth, the
    models say that were grounded on these trials: U^ of the run from s_0 less that of the run from
    where the trials began.
    """

    def worth(one: Tried) -> float:
        found = [c for t in history if (c := t.candidate).base == one.candidate.id]
        starts = [c.expected_of_base - c.base_as_run for c in found]
        known = [start for start in starts if math.isfinite(start)]
        if not known or not one.trials:
            return 0.0
        s_0 = one.candidate.predicted_states[0]
        off = np.array([trial.states[0] - s_0 for trial in one.trials])
        return known[-1] if beyond_noise(one.trials, off, s_0).any() else 0.0

    gain, start = after.utility - before.utility, worth(before) - worth(after)
    return start if abs(start) > PART * abs(gain) and math.isfinite(start) else 0.0


def student(x: float, freedom: float) -> float:
    """Student's t distribution, P(T <= x), to 1e-5; importing scipy takes longer than a command.

    T = sqrt(freedom) tan(a), and the density of the angle a goes with cos(a)^(freedom - 1).
    """
    angles = np.linspace(0.0, math.pi / 2, 20_001)
    density = np.cos((angles[1:] + angles[:-1]) / 2) ** (freedom - 1.0)
    within = np.append(0.0, np.cumsum(density)) / density.sum()
    reached = np.interp(math.atan(abs(x) / math.sqrt(freedom)), angles, within)
    return 0.5 + math.copysign(0.5, x) * float(reached)


def error_between(before: Tried, after: Tried, history: Sequence[Tried]) -> tuple[float, float]:
    """Standard error of the difference of two means, and its degrees of freedom; 0 for unknown.

    The later one's scatter speaks for both where the earlier one has none near it. Two estimates
    that differ are added as Welch (1947) does.
    """
    repeats = Repeats(history)
    later = repeats.near(after.utility)
    if not later.known:
        return math.nan, 0.0
    earlier = repeats.near(before.utility)
    earlier = earlier if earlier.known else later
    squares = earlier.error(len(before.utilities)) ** 2, later.error(len(after.utilities)) ** 2
    error = math.sqrt(sum(squares))
    if earlier == later or not error:
        return error, later.freedom
    return error, error**4 / (squares[0] ** 2 / earlier.freedom + squares[1] ** 2 / later.freedom)
