"""How well the utility of a trial is predicted, with and without the effects.

Each trial is run again in the model from where it started, with the commands that were really sent
and values that were estimated from the other trials; the utility of that run is compared with the
real one. What matters to the search is the utility, not a state a second ahead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.diagnosis.fitted import Fit
from grounded.diagnosis.hypothesis import Hypothesis, Predictor
from grounded.diagnosis.intervals import leave_one_out
from grounded.diagnosis.report import UtilityPrediction
from grounded.diagnosis.shrinkage import moved
from grounded.frozen import Array
from grounded.task import Task
from grounded.trial import Trial

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
    predictor: Predictor, fit: Fit, bare: Array, task: Task, trials: Sequence[Trial]
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
        own = h if shifts is None else moved(predictor, h, shifts[groups.index(i)])
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
