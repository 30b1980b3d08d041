"""Which of two models predicts better: both as given, on the same trials, nothing fitted to them.

Each model estimates the states along the trials with its own noise, and predicts from there without
measurements (`ruler`). As no value comes from these trials, all of them are held out. The
difference is paired by trial (in a single log by run), with its standard error.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.diagnosis.hypotheses.search import TO_THE_TOP, HypothesisSearch
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.validation.choose import Errors, Gain
from grounded.diagnosis.validation.ruler import Ruler
from grounded.errors import GroundedError
from grounded.findings import found
from grounded.model import Param
from grounded.task import Task
from grounded.trial import Trial


@dataclass(frozen=True, eq=False)
class Predicted:
    """Errors of a model's predictions.

    Attributes:
        ruler: what measured them.
        errors: by horizon, piece and state.
    """

    ruler: Ruler
    errors: Errors

    def gain(self, other: Predicted) -> Gain:
        """Return the gain of another model over this one."""
        return self.ruler.compared(self.errors, other.errors)

    def better(self, other: Predicted) -> int:
        """Return 1 if another model predicts better, -1 if worse, 0 if it can't be decided."""
        return int(self.gain(other).clear) - int(other.gain(self).clear)

    @property
    def by_horizon(self) -> list[tuple[float, Mapping[str, float]]]:
        """Rms error of each state by horizon [s]; the last is the longest trial, as a whole."""
        ruler, rms = self.ruler, self.errors.rms
        times = [*ruler.steps, int(ruler.data.lengths.max())]
        return [
            (
                k * ruler.data.dt,
                {n: float(row[i]) for n, i in zip(ruler.names, ruler.shown, strict=True)},
            )
            for k, row in zip(times, rms, strict=True)
        ]


def predicted(task: Task, trials: Sequence[Trial], hidden: Sequence[str]) -> Predicted:
    """Return the errors of a task's model, at its values, on trials.

    Args:
        task: the model, with its latency.
        trials: with its states; those of several models are the same but for hidden ones.
        hidden: names of states without a sensor.

    Raises:
        GroundedError: if the model can't follow the trials at all.
    """
    fixed = {name: Param(p.value, p.unit) for name, p in task.model.params.items()}
    model = replace(task.model, params=fixed)
    data = prepare(model, trials, task.latency, task.past, hidden)
    search = HypothesisSearch(data, ())
    with np.errstate(all="ignore"):
        fits = search.refined([search.fresh(Hypothesis())], TO_THE_TOP)
        if not fits:
            raise GroundedError(found("model.not_finite", model.name))
        ruler = Ruler(search.predictor)
        return Predicted(ruler, ruler.errors(fits[0]))
