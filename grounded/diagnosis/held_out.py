"""How far the gap shrinks on trials that had no part in the values; no claim that these contradict.

For each trial the values are estimated from the other trials (one Newton step from the estimate on
all), and the trial is predicted from many of its moments, a second ahead, with the commands that
were really sent. Errors are in units of what noise alone would make of them; 1 is the floor. What
matters to the search is the utility: so each trial is also run again from its start, and the
utility of that run is compared with the real one (`utility_prediction`).

Evidence alone does not see when the likeliest hypothesis is wrong (`noise_confirmed`, `confirmed`).
There are four ways, most of them where predictions miss by far more than noise makes: something is
wrong then that is not in the library, and likelihoods are those of a wrong model.

Noise that is allowed to be coloured, or parameters that are allowed to move, explain a lasting
effect away that predictions a second ahead still miss (a bias of a motor, a friction that is lower
at first): another noise is confirmed. A further effect takes up what is left somewhere and predicts
hardly better: it is dropped. So is what makes less than a two-hundredth of the gap: where there is
next to no noise, the last digits of a step can be a claim. And values that one trial alone
determines (a wave, a saturation that one run reaches) make predictions of the others worse: another
hypothesis takes its place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.diagnosis.fitted import Fitted, leave_one_out, moved
from grounded.diagnosis.hypotheses import CLAIM
from grounded.diagnosis.hypothesis import Hypothesis, Predictor
from grounded.diagnosis.prediction_error import Horizon, errors, horizon, normalised
from grounded.diagnosis.report import UtilityPrediction
from grounded.diagnosis.search import HypothesisSearch
from grounded.frozen import Array
from grounded.task import Task
from grounded.trial import Trial


@dataclass(frozen=True, eq=False)
class Shrinkage:
    """Errors of held-out predictions (M, n) before and after, and their sizes."""

    where: Horizon
    before: Array
    after: Array

    @property
    def gap_before(self) -> float:
        """Noise-normalised rms of the model as it is."""
        return normalised(self.before, self.where)

    @property
    def gap_after(self) -> float:
        """The same with the effects, values from the other trials."""
        return normalised(self.after, self.where)


def shrinkage(predictor: Predictor, fit: Fitted, bare: Array, where: Horizon) -> Shrinkage:
    """Held-out errors before, from the states `bare` (L + 1, B, n), and after, from its own."""
    before = errors(predictor, Hypothesis(), bare, where)
    return Shrinkage(where, before, held_out_errors(predictor, fit, fit.track, where))


def held_out_errors(predictor: Predictor, fit: Fitted, track: Array, where: Horizon) -> Array:
    """Errors of each trial with values from the others, (M, n)."""
    data, h = predictor.data, fit.hypothesis
    if not h.effects and h.spread == 0:
        return errors(predictor, h, track, where)
    shifts, _ = leave_one_out(fit, data.trial_of)
    found = np.full((len(where.at), data.model.n), np.nan)
    of_start = data.trial_of[where.run]
    for trial, shift in zip(np.unique(data.trial_of), shifts, strict=True):
        own = np.flatnonzero(of_start == trial)
        if len(own):
            part = Horizon(where.steps, where.at[own], where.run[own], where.spread[own])
            found[own] = errors(predictor, moved(data, h, shift), track, part)
    return found


def whole_runs(predictor: Predictor, h: Hypothesis, track: Array) -> Array:
    """Rms error of each state when runs are predicted from their first state to their end, (n,)."""
    data = predictor.data
    lengths = data.valid.sum(axis=1).astype(int)
    total, count = np.zeros(data.model.n), np.zeros(data.model.n)
    for length in np.unique(lengths):
        runs = np.flatnonzero(lengths == length)
        at = np.zeros(len(runs), int)
        where = Horizon(int(length), at, runs, np.ones((len(runs), data.model.n)))
        for steps in np.unique(np.linspace(length / 4, length, 4).astype(int)):
            part = Horizon(max(int(steps), 1), where.at, where.run, where.spread)
            error = errors(predictor, h, track, part)
            total += np.nansum(error**2, axis=0)
            count += np.isfinite(error).sum(axis=0)
    return np.asarray(np.sqrt(total / np.maximum(count, 1)))


def gaps_of(predictor: Predictor, fits: Sequence[Fitted], where: Horizon) -> list[float]:
    """The gap that each of several hypotheses leaves, held out."""
    return [normalised(held_out_errors(predictor, fit, fit.track, where), where) for fit in fits]


FAR = 1e6  # a state beyond it has diverged


@dataclass(frozen=True, eq=False)
class Utilities:
    """Real utilities of whole trials (S,), predicted ones before and after."""

    real: Array
    before: Array
    after: Array

    def summary(self) -> UtilityPrediction:
        """Rms errors; NaN where a prediction diverged or no trial was whole."""
        if not len(self.real):
            return UtilityPrediction()
        before, after = (
            float(np.sqrt(((predicted - self.real) ** 2).mean()))
            for predicted in (self.before, self.after)
        )
        spread, mean = float(self.real.std()), float(self.real.mean())
        return UtilityPrediction(len(self.real), "utility, rms", before, after, spread, mean)


def utility_prediction(
    predictor: Predictor, fit: Fitted, bare: Array, task: Task, trials: Sequence[Trial]
) -> Utilities:
    """Real and predicted utilities of the trials that ran to the horizon.

    Args:
        predictor: the data that were made from `trials`.
        fit: the best hypothesis.
        bare: filtered states that the bare model starts from; the fit has its own.
        task: whose reward it is.
        trials: those of the data, in its order.
    """
    data, h = predictor.data, fit.hypothesis
    fixed = not h.effects and h.spread == 0
    shifts = None if fixed or data.count < 2 else leave_one_out(fit, data.trial_of)[0]
    groups = np.unique(data.trial_of).tolist()
    rows = []
    for i, trial in enumerate(trials):
        real = task.utility(trial)
        if not np.isfinite(real) or i not in groups:
            continue
        first = int(np.flatnonzero(data.trial_of == i)[0])
        if data.time[0, first] > 0:  # the run that it began with was left out
            continue
        own = h if shifts is None else moved(data, h, shifts[groups.index(i)])
        pairs = [(Hypothesis(), bare[0, first]), (own, fit.track[0, first])]
        parts = [task.utility(_again(predictor, g, trial, start, i)) for g, start in pairs]
        rows.append([real, *parts])
    found = np.array(rows).reshape(-1, 3)
    return Utilities(found[:, 0], found[:, 1], found[:, 2])


def _again(predictor: Predictor, h: Hypothesis, trial: Trial, start: Array, i: int) -> Trial:
    """The trial as a hypothesis predicts it, from its start, with its commands."""
    data = predictor.data
    received = predictor.received(h)[i]
    x = start[None]
    path = [x]
    for t in range(trial.steps):
        x = predictor.advance(h, x, received[t][None], np.array([t * data.dt]))
        x = np.clip(x, -FAR, FAR)
        path.append(x)
    states = np.stack(path)
    logged = states + predictor.offset(h, states)
    return replace(trial, states=logged[:, 0])


MISFIT = 1.3  # times what noise makes of predictions, from which the noise is doubted
BETTER = 1.5  # times smaller is what another noise has to leave
WORTH = 1.3  # times larger is the gap without an effect that is worth naming in a misfit
SLIGHT = 0.005  # of the bare model's gap: what is not worth a name
WORSE = 1.1  # times the gap without the effects
TRIES = 6  # hypotheses that are looked at


def noise_confirmed(
    search: HypothesisSearch, best: Fitted, most: int, seconds: float
) -> tuple[HypothesisSearch, Fitted]:
    """The search and its best hypothesis, under the noise whose claims predict held-out trials.

    Another structure of noise, or exact parameters, is preferred to the likeliest one only where
    that one's claim leaves much more than noise and the other's leaves much less.

    Args:
        search: with all hypotheses that were fitted.
        best: the likeliest one.
        most: so many effects at most.
        seconds: how far ahead trials are predicted [s].
    """
    if not best.hypothesis.effects or search.data.count < 2:
        return search, best
    where = horizon(search.predictor, best, seconds)
    (gap,) = gaps_of(search.predictor, [best], where)
    if not gap > MISFIT:
        return search, best
    found = []
    for structure, spread in dict.fromkeys((s, w) for s, w, _ in search.fits):
        if (structure, spread) == (best.noise.structure, best.hypothesis.spread):
            continue
        other = search.under(structure, spread)
        if other is not None and (rival := other.chosen(most)).hypothesis.effects:
            found.append((gaps_of(search.predictor, [rival], where)[0], other, rival))
    found = [each for each in found if each[0] * BETTER < gap]
    if not found:
        return search, best
    _, other, rival = min(found, key=lambda each: each[0])
    other.finished(other.of_size(len(rival.hypothesis.effects))[:TRIES], 20)
    return other, other.chosen(most)


def confirmed(search: HypothesisSearch, best: Fitted, seconds: float) -> Fitted:
    """The best hypothesis, or the likeliest one below it that predicts held-out trials.

    Args:
        search: with all hypotheses that were fitted.
        best: the one that would be claimed.
        seconds: how far ahead trials are predicted [s].
    """
    null, score = search.best_null(), search.score
    if not best.hypothesis.effects or search.data.count < 2:
        return best
    size = len(best.hypothesis.effects)
    rivals = [f for k in range(1, size + 1) for f in search.of_size(k) if f is not best]
    rivals = [f for f in rivals if score(null) + CLAIM < score(f) <= score(best)]
    rivals.sort(key=lambda f: -score(f))
    for fit in [best, *rivals[: TRIES - 1]]:
        where = horizon(search.predictor, fit, seconds)
        found = shrinkage(search.predictor, fit, null.track, where)
        if not found.gap_after > WORSE * found.gap_before:
            return _pruned(search, fit, found, where)
    return null


def _pruned(search: HypothesisSearch, fit: Fitted, held: Shrinkage, where: Horizon) -> Fitted:
    """Without the effects that hardly matter: in a misfit, or beside one that makes all the gap."""
    gap, slight = held.gap_after, SLIGHT * held.gap_before
    while fit.hypothesis.effects and (gap > MISFIT or slight > max(gap, 1.0)):
        names = set(fit.hypothesis.names)
        fewer = [f for f in search.of_size(len(names) - 1) if set(f.hypothesis.names) < names]
        fewer = fewer if len(names) > 1 else [search.best_null()]
        gaps = gaps_of(search.predictor, fewer, where)
        if not gaps or not min(gaps) < max(WORTH * gap if gap > MISFIT else 0.0, slight):
            break
        gap, fit = min(zip(gaps, fewer, strict=True), key=lambda each: each[0])
    return fit
