"""Decide which candidates improved and how certain that is, given the noise of real systems."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from grounded.result import figure, percent, with_error
from grounded.search.candidate import PART, SURE, Candidate, Tried
from grounded.search.scatter import (
    NoiseSoFar,
    Repeats,
    beyond_noise,
    by_pieces,
    by_states,
    explained_by_starts,
    noise_cost,
    noise_missed,
    with_errors,
)
from grounded.task import Task
from grounded.trial import Trial, scattered

if TYPE_CHECKING:
    from grounded.search.starts import Starts
    from grounded.search.step.step_size import SearchOptions

ANOTHER = 99.0  # ratio of a state's costs in two runs that is no scatter, see `another_kind`
LUCK = 2.0  # standard errors that a loss must exceed to break a promise
SHOWN = 1.645  # standard errors of a gain that is one with probability SURE, 0.95
MANY = 50  # runs of a candidate; that more would be needed is said, but not how many
CLEAR = 3.44  # ratio of two costs that is no scatter: F(8, 8) exceeds it in 1 of 20 cases
FEW = 8  # repeats below which a scatter may be off by half, so that their number is told


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
        tried = replace(tried, placed=explained_by_starts((*history, tried)))
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
                and in_doubt(task, incumbent, tried, history, most, once)
            ):
                again = to_settle(incumbent, tried, most, once)
                name = again.candidate.id if again else ""
                tried = replace(tried, accepted=None, in_doubt=True, to_settle=name)
        history.append(tried)
    best_one = incumbent and incumbent.candidate
    noises = NoiseSoFar(trials, task.model.n)
    later = [[one.id for one in candidates[k:]] for k in range(len(candidates))]
    pairs = zip(history, later, strict=True)
    told = with_chances(with_errors([_with_noise(task, t, noises, ids) for t, ids in pairs]))
    best = next((t for t in told if t.candidate is best_one), None)
    return told, best, iteration


def _with_noise(task: Task, tried: Tried, noises: NoiseSoFar, since: Sequence[str]) -> Tried:
    """Return the candidate with the mean cost of the noise in its logs, and what was promised.

    The promise is made with the noise known before its first run, and stays as it is.

    Args:
        task: its reward judges the logs.
        tried: the candidate.
        noises: the noise of the sensors over time.
        since: ids of the candidate and of all later ones.
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
    task: Task, incumbent: Tried, loser: Tried, history: Sequence[Tried], most: int, once: int = 2
) -> bool:
    """Return whether a loss may be due to a lucky trial of the incumbent, or to other start states.

    What different start states explain of it (`Tried.excused`) is no loss. A lucky incumbent would
    block every further step. So after a loss within two standard errors the incumbent is run again,
    until it has `most` trials: one for each loss; a loser whose starts explain it is, until it has
    `once`. Without repeats at a similar utility, the standard deviation is taken as half of the
    utility, as for chi-squared with eight degrees of freedom; a loss of more than 1.4 times the
    best cost is then accepted at once, and one of more than 0.7 times if it is of another kind
    (`another_kind`).
    On a deterministic system this costs one trial per incumbent.
    """
    if not np.isfinite(loser.utility) or to_settle(incumbent, loser, most, once) is None:
        return False
    scatter = Repeats((*history, loser)).near(incumbent.utility)
    each = math.sqrt(scatter.variance) if scatter.known else 0.5 * abs(incumbent.utility)
    error = each * np.sqrt(1 / len(incumbent.trials) + 1 / len(loser.trials))
    loss = -loser.gain_over(incumbent)
    if not scatter.known and loss > error and another_kind(task, incumbent, loser):
        return False
    return not loss > 2 * error


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


def another_kind(task: Task, incumbent: Tried, loser: Tried) -> bool:
    """Return whether the error of one state explains a loss, and is no scatter of the incumbent's.

    Even if a state's cost has only two degrees of freedom, as a single slow swing has, the ratio of
    two such costs exceeds 99 by chance in 1 of 100 cases, F(2, 2): a tenfold error.
    """
    before, after = by_states(task, incumbent.trials), by_states(task, loser.trials)
    rise, loss = after - before, incumbent.utility - loser.utility
    return bool(((rise >= loss) & (after > ANOTHER * before)).any())


def with_chances(history: Sequence[Tried]) -> tuple[Tried, ...]:
    """Return the candidates; every improvement gets the probability that it is one."""
    found, best = list(history), None
    for k, tried in enumerate(history):
        if tried.accepted and best is not None:
            sure = chance(best, tried, history)
            unsure = math.isnan(sure) and not clear(best, tried, history)
            found[k] = replace(tried, probability=sure, unsure=unsure)
        best = tried if tried.accepted else best
    return tuple(found)


def chance(before: Tried, after: Tried, history: Sequence[Tried]) -> float:
    """Return the probability that a later candidate is better than an earlier one.

    The part of the gain that is due to different start states does not count.

    Returns:
        The probability; NaN if no candidate of similar utility was repeated, or if they began
        apart and no model tells what that is worth.
    """
    if not math.isfinite(before.utility):  # it failed
        return 1.0
    gain = after.utility - before.utility - owed_to_start(before, after, history)
    error, freedom = error_between(before, after, history)
    if not freedom or (error and _start_unknown(before, after, history)):
        return math.nan
    return student(gain / error, freedom) if error else float(gain > 0)


def clear(before: Tried, after: Tried, history: Sequence[Tried]) -> bool:
    """Return whether a gain is one although no repeat tells how much runs scatter.

    Their utilities are then taken to scatter as in `in_doubt`, as chi-squared with eight degrees of
    freedom. The part of the gain that is due to different start states does not count.
    """
    if not math.isfinite(before.utility):  # it failed
        return True
    left = after.utility - owed_to_start(before, after, history)
    return before.utility < CLEAR * left


def explained(before: Tried, after: Tried, history: Sequence[Tried]) -> str:
    """Return what may explain that a later candidate is ahead, to be followed by `its lead`; or "".

    "" if it is better with probability SURE or, while nothing similar was repeated, if the gain is
    `clear`.
    """
    sure, gain = chance(before, after, history), after.utility - before.utility
    if sure < SURE:
        error, freedom = error_between(before, after, history)
        if error and student(gain / error, freedom) >= SURE:
            return "where the runs began may explain"
        return "the scatter of repeats may explain"
    if math.isnan(sure) and not clear(before, after, history):
        if before.utility < CLEAR * after.utility:
            return "where the runs began may explain"
        return "how much runs scatter is not known, and may explain"
    return ""


def share_of_cost(before: Tried, after: Tried, history: Sequence[Tried]) -> str:
    """Return the difference of two candidates' costs as a share of the first: `16 % (+- 4.3 %)`.

    The standard error is told if repeats tell it, with on how few of them it rests.
    """
    share = percent(abs((after.utility - before.utility) / before.utility))
    error, freedom = error_between(before, after, history)
    if not (freedom and error):
        return share
    on = few(Repeats(history).near(after.utility).repeats)
    return f"{share} (+- {percent(error / abs(before.utility))}{on})"


def last_improvement(history: Sequence[Tried], again: str = "") -> str:
    """Return a sentence on how certain the last accepted improvement is; "" before there is one.

    Student's t-test with the scatter of all repeats at a similar utility (`scatter`), which also
    gives the standard errors in the table. It asks for no run: what to do is decided elsewhere.

    Args:
        history: all candidates with their trials.
        again: the command that runs the best one again, in brackets.
    """
    accepted = [t for t in history if t.accepted]
    if len(accepted) < 2:
        return ""
    before, after = accepted[-2], accepted[-1]
    gain, start = after.utility - before.utility, owed_to_start(before, after, history)
    error, freedom = error_between(before, after, history)
    if start:
        other, rest = before.candidate.id, gain - start
        measured = f"{gain:.3g}" + (f" +- {error:.2g}" if freedom and error else "")
        said = f"is {measured} as measured, which the search goes by; by the model,"
        if rest < 0:
            why = f"{said} {other} would be ahead by {-rest:.3g} from the same start"
        else:
            why = (
                f"{said} {start:.3g} of it is due to where their runs began and {rest:.3g} to the "
            )
            why += "policy"
        if not rest > SHOWN * (error if freedom else 0.0):
            why += ": which of the two is better is open"
        return f"the last gain, of {after.candidate.id} over {other}, {why}"
    if freedom and error and _start_unknown(before, after, history):
        return (
            f"the last gain in utility is {with_error(gain, error)} by the scatter of repeats, but "
            f"{before.candidate.id} and {after.candidate.id} began from different start states, "
            "and how much of it is due to that is not known: run both from [task] start to be sure"
        )
    if not freedom:
        return (
            f"the last gain in utility is {figure(gain, 3)}; candidates of similar utility were "
            "run only once, so the noise of a trial is unknown; another run of the best one would "
            f"show it{again}"
        )
    if error == 0:
        return f"the last gain in utility is {figure(gain, 3)}; repeated trials agree exactly"
    return (
        f"the last gain in utility is {with_error(gain, error)}: an improvement with probability "
        f"{chance(before, after, history):.2f}{few(Repeats(history).near(after.utility).repeats)}"
    )


def few(repeats: int) -> str:
    """Return on how many repeats a scatter rests, as a clause, if it may be far off; else ""."""
    if not 0 < repeats < FEW:
        return ""
    return f", from {'a single repeat' if repeats == 1 else f'{repeats} repeats'} only"


def one_trial_error(best: Tried, repeats: int = 1) -> float:
    """Return the standard error of a new candidate's gain over the best; 0 if no noise is known."""
    each = best.deviation
    return each * math.sqrt(1 / repeats + 1 / len(best.utilities)) if each > 0 else 0.0


def runs_to_show(gain: float, best: Tried) -> int:
    """Return how many runs of a candidate and as many of the best show a gain, see `SHOWN`."""
    return math.ceil(2 * (SHOWN * best.deviation / gain) ** 2)


def runs_needed(gain: float, best: Tried) -> str:
    """Say how many runs show a gain: "22 runs", or that it takes more than anyone makes.

    Of a single repeat, the scatter is known to a factor of several only, and the number to its
    square: then none is told.
    """
    if best.repeats == 1:
        return "more runs"
    runs = runs_to_show(gain, best)
    return f"{runs} runs" if runs <= MANY else f"more than {MANY} runs"


def beyond_one_trial(made: Candidate, best: Tried, repeats: int = 1) -> str:
    """Return a sentence saying that a trial can't show what a candidate promises; "" if it can."""
    own, least = best.candidate.id, SHOWN * one_trial_error(best, repeats)
    gain = made.promised_over(best) if made.base == own else 0.0
    if not 0 < gain < least:
        return ""
    stop = f". If that is too many, stop with {own}" * (not made.doubtful)  # else `doubt` says it
    if best.is_unsteady:
        stop = (
            f". But runs as good as {own} scatter by about as much as they cost, and {made.id} may "
            "be steadier, which its first runs would show"
        )
    return (
        f"{made.id} promises {gain:.2g} over {own}, less than its trial can show: the utilities of "
        f"single runs scatter by {best.deviation:.2g}{few(best.repeats)}, so a gain below "
        f"{least:.2g} may be luck. To show it takes {runs_needed(gain, best)} of each of the "
        f"two{stop}"
    )


def owed_to_start(before: Tried, after: Tried, history: Sequence[Tried]) -> float:
    """Return how much of a gain is due to different start states; 0 if it is a small part.

    The models that were grounded on these trials give the estimate: U^ of the run from s_0 less U^
    of the run from where the trials began. It is 0 if both began alike, or if a candidate that
    began elsewhere has no such model (`_start_unknown`).
    """
    gain, start = after.utility - before.utility, _of_start(before, after, history)
    return start if abs(start) > PART * abs(gain) and math.isfinite(start) else 0.0


def by_starts(before: Tried, after: Tried, history: Sequence[Tried]) -> str:
    """Return a clause on the share of a cost that different start states changed; "" for little."""
    if not (start := owed_to_start(before, after, history)):
        return ""
    did = "reduced" if start > 0 else "raised"
    share = percent(abs(start / before.utility))
    return f"by the model, different start states alone {did} the cost by {share}"


def _start_unknown(before: Tried, after: Tried, history: Sequence[Tried]) -> bool:
    """Return whether two candidates began apart, and no model tells what that is worth."""
    return math.isnan(_of_start(before, after, history))


def _of_start(before: Tried, after: Tried, history: Sequence[Tried]) -> float:
    """Return the model's part of a gain that is due to the start; 0 if alike, NaN if unknown.

    It is the planning model's (`Starts`), which tells it of both; of the models that were grounded
    on trials one may know only one of them. These tell it where the planning model can't.
    """
    found = _of_grounded(before, after, history)
    if after.starts is None or not before.trials:
        return found
    planned = after.starts.owed(after, before)
    if not planned and found:  # NaN, too: they began apart
        planned = after.starts.cost(before) - after.starts.cost(after)
    return planned if math.isfinite(planned) else found


def _of_grounded(before: Tried, after: Tried, history: Sequence[Tried]) -> float:
    if not (before.trials and after.trials and began_apart(before, after)):
        return 0.0

    def worth(one: Tried) -> float:
        s_0 = one.candidate.predicted_states[0]
        off = np.array([trial.began - s_0 for trial in one.trials])
        if not beyond_noise(one.trials, off, s_0, one.candidate.predicted_states).any():
            return 0.0
        found = [c for t in history if (c := t.candidate).base == one.candidate.id]
        known = [cost for c in found if math.isfinite(cost := cost_of_start(one, c))]
        return known[-1] if known else math.nan

    return worth(before) - worth(after)


def planned_before(best: Tried, made: Candidate) -> bool:
    """Return whether a candidate was planned before the latest run of its base, `best`."""
    return bool(made.seen) and not {trial.id for trial in best.trials} <= {*made.seen}


def cost_of_start(best: Tried, made: Candidate) -> float:
    """Return what the starts of a candidate's runs cost on average, by the model; NaN if unknown.

    Args:
        best: the candidate.
        made: one that was planned from its runs. The model that was grounded on those tells it; of
            runs that came later the planning model does.
    """
    if planned_before(best, made):
        return math.nan if best.starts is None else best.starts.cost(best)
    return made.expected_of_base - made.base_as_run


def missed_by_start(tried: Tried) -> float:
    """Return what the starts of a candidate's runs cost by the model; 0 if that is a small part.

    A part of what they missed its prediction by, which begins at [task] start. 0 if the model can't
    tell it, too.
    """
    if tried.starts is None or not tried.trials or not math.isfinite(tried.utility):
        return 0.0
    cost = tried.starts.cost(tried)
    small = abs(cost) < PART * abs(tried.promised - tried.utility)
    return 0.0 if small or not math.isfinite(cost) else cost


def began_apart(one: Tried, other: Tried) -> bool:
    """Return whether the trials of two candidates began apart.

    That is by more than the sensors' noise, and more than the scatter of where repeats begin, which
    the scatter of their utilities includes.
    """
    first, second = (np.array([t.began for t in tried.trials]) for tried in (one, other))
    s_0, apart = one.candidate.predicted_states[0], np.ones(first.shape[1], bool)
    if (freedom := len(first) + len(second) - 2) > 0:
        squares = sum(len(starts) * starts.var(axis=0) for starts in (first, second)) / freedom
        error = np.sqrt(squares * (1 / len(first) + 1 / len(second)))
        apart = np.abs(first.mean(axis=0) - second.mean(axis=0)) > LUCK * error
    pairs = ((one, first - second.mean(axis=0)), (other, second - first.mean(axis=0)))
    return all(
        (apart & beyond_noise(tried.trials, off, s_0, tried.candidate.predicted_states)).any()
        for tried, off in pairs
    )


def student(x: float, freedom: float) -> float:
    """Return Student's t distribution, P(T <= x), to 1e-5, without the slow import of scipy.

    T = sqrt(freedom) tan(a), and the density of the angle a goes with cos(a)^(freedom - 1).
    """
    angles = np.linspace(0.0, math.pi / 2, 20_001)
    density = np.cos((angles[1:] + angles[:-1]) / 2) ** (freedom - 1.0)
    within = np.append(0.0, np.cumsum(density)) / density.sum()
    reached = np.interp(math.atan(abs(x) / math.sqrt(freedom)), angles, within)
    return 0.5 + math.copysign(0.5, x) * float(reached)


def error_between(before: Tried, after: Tried, history: Sequence[Tried]) -> tuple[float, float]:
    """Return the standard error of the difference of two means and its degrees of freedom.

    The degrees of freedom are 0 if the error is unknown. If no repeats are near the earlier
    candidate, the scatter of the later one is used for both. Different estimates are combined as in
    Welch (1947).
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
