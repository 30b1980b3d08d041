"""Reduction of the noise-normalised gap on held-out trials, and predicted utilities.

The gap is the rms of errors a second ahead, relative to the errors that noise alone would cause; 1
is the floor. It compares only within one diagnosis, because it is divided by the noise estimated
there. Claims are decided by the `ruler`, in the channels' units. The search needs the utility, so
each trial is also simulated from its start, and the utility of that run compared with the real one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.diagnosis.error_report import UtilityPrediction
from grounded.diagnosis.likelihood.carried import stepper
from grounded.diagnosis.likelihood.fitted import Fitted, leave_one_out, moved
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.validation.ahead import FAR
from grounded.diagnosis.validation.prediction_error import Horizon, errors, normalised
from grounded.frozen import Array
from grounded.task import Task
from grounded.trial import Trial


@dataclass(frozen=True, eq=False)
class Shrinkage:
    """Errors of held-out predictions (M, n) before and after, and what noise alone causes."""

    where: Horizon
    before: Array
    after: Array

    @property
    def gap_before(self) -> float:
        """Noise-normalised rms error of the crude model."""
        return normalised(self.before, self.where)

    @property
    def gap_after(self) -> float:
        """Noise-normalised rms error with the effects, values from the other trials."""
        return normalised(self.after, self.where)


def shrinkage(predictor: Predictor, fit: Fitted, bare: Array, where: Horizon) -> Shrinkage:
    """Return held-out errors of the crude model, from states `bare` (L + 1, B, n), and of a fit."""
    before = errors(predictor, Hypothesis(), bare, where)
    return Shrinkage(where, before, held_out_errors(predictor, fit, fit.states, where))


def held_out_errors(predictor: Predictor, fit: Fitted, track: Array, where: Horizon) -> Array:
    """Return the errors of each trial with values from the others, (M, n)."""
    data, h = predictor.data, fit.hypothesis
    if not h.effects and h.spread == 0:
        return errors(predictor, h, track, where)
    left_out = data.folds
    shifts, _ = leave_one_out(fit, left_out)
    found = np.full((len(where.at), data.model.n), np.nan)
    of_start = left_out[where.run]
    for fold, shift in zip(np.unique(left_out), shifts, strict=True):
        own = np.flatnonzero(of_start == fold)
        if len(own):
            part = Horizon(where.steps, where.at[own], where.run[own], where.spread[own])
            found[own] = errors(predictor, moved(data, h, shift), track, part)
    return found


def gaps_of(predictor: Predictor, fits: Sequence[Fitted], where: Horizon) -> list[float]:
    """Return the held-out gap that each of several fits leaves."""
    return [normalised(held_out_errors(predictor, fit, fit.states, where), where) for fit in fits]


@dataclass(frozen=True, eq=False)
class Utilities:
    """Real utilities of whole trials (S,), and predicted ones before and after."""

    real: Array
    before: Array
    after: Array

    def summary(self) -> UtilityPrediction:
        """Return rms errors; NaN if a prediction diverged, defaults if no trial was whole."""
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
    """Return real and predicted utilities of the trials that ran to the horizon.

    Trials without a candidate are left out if they are longer than the horizon, or if other trials
    have a candidate: they are not runs of the task.

    Args:
        predictor: evaluates hypotheses on the data prepared from `trials`.
        fit: the best hypothesis.
        bare: filtered states that the bare model starts from; the fit has its own.
        task: defines the reward.
        trials: the trials of the data, in its order.
    """
    data, h = predictor.data, fit.hypothesis
    fixed = not h.effects and h.spread == 0
    shifts = None if fixed or data.count < 2 else leave_one_out(fit, data.trial_of)[0]
    groups = np.unique(data.trial_of).tolist()
    rows, chosen = [], any(trial.candidate for trial in trials)
    for i, trial in enumerate(trials):
        real = task.utility(trial)
        by_hand = not trial.candidate and (chosen or trial.steps > task.horizon)
        if not np.isfinite(real) or i not in groups or by_hand:  # not the utility of a policy
            continue
        first = int(np.flatnonzero(data.trial_of == i)[0])
        if data.time[0, first] > 0:  # its first run was left out
            continue
        own = h if shifts is None else moved(data, h, shifts[groups.index(i)])
        pairs = [(Hypothesis(), bare[0, first]), (own, fit.states[0, first])]
        parts = [task.utility(_again(predictor, g, trial, start, i)) for g, start in pairs]
        rows.append([real, *parts])
    found = np.array(rows).reshape(-1, 3)
    return Utilities(found[:, 0], found[:, 1], found[:, 2])


def _again(predictor: Predictor, h: Hypothesis, trial: Trial, start: Array, i: int) -> Trial:
    """Return the trial as a hypothesis predicts it from its start, with its commands."""
    data = predictor.data
    received = predictor.received(h)[i]
    states = predictor.marched(h, start[None], received[: trial.steps, None])
    if states is None or not (np.abs(states) < FAR).all():
        advance, path = stepper(predictor, h), [start[None]]
        for t in range(trial.steps):
            x = advance(path[-1], received[t][None], np.array([t * data.dt]))
            path.append(np.minimum(np.maximum(x, -FAR), FAR))
        states = np.stack(path)
    logged = states + predictor.offset(h, states)
    return replace(trial, states=logged[:, 0])
