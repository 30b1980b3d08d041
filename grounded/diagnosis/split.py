"""What the prediction error is made of: explained, unexplained, irreducible; one step, 1 s, a run.

    mean e^2 of the bare model  =  explained    what the effects take away on held-out trials
                                +  unexplained  what they leave above the noise
                                +  irreducible  process and measurement noise: no model predicts it

Two estimates of the irreducible part. The filter's: the estimated noises, carried on by the model's
own Jacobian. And, where a candidate was run several times, the trials': predictions of the repeats
from the same moment miss by the same model error and by different noise, so the variance of the
errors among the repeats is the noise, whatever the model. The second is taken where there is one.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from grounded.diagnosis.data import Data
from grounded.diagnosis.fitted import Fit
from grounded.diagnosis.hypothesis import Hypothesis, Predictor
from grounded.diagnosis.prediction_error import Horizon, errors
from grounded.diagnosis.report import ChannelParts, Parts, Split
from grounded.diagnosis.shrinkage import held_out
from grounded.frozen import Array

MOST_MOMENTS = 40  # at which repeats are compared


@dataclass(frozen=True, eq=False)
class SquaredErrors:
    """Mean squared errors of each state (n,) at one horizon; `noise` is the filter's estimate."""

    horizon: float  # [s]
    before: Array
    after: Array
    noise: Array
    repeats: Array | None  # from repeated trials

    @property
    def irreducible(self) -> Array:
        """The part that no model predicts."""
        return self.noise if self.repeats is None else self.repeats

    def shares(self, weight: Array | None = None) -> Any:
        """explained, unexplained, irreducible: of each channel (3, n), or of their sum (3,)."""
        w = np.ones_like(self.before) if weight is None else weight
        parts = [np.nan_to_num(w * p) for p in (self.before, self.after, self.irreducible)]
        before, after, floor = parts if weight is None else [p.sum() for p in parts]
        after = np.minimum(after, before)
        floor = np.minimum(floor, after)
        return np.stack([before - after, after - floor, floor]) / np.maximum(before, 1e-300)

    def shared_out(self, data: Data) -> Split:
        """The shares of each state and in all, where each counts in units of its noise."""
        model, each = data.model, self.shares()
        channels = [
            ChannelParts(
                name,
                model.states[name],
                float(np.sqrt(np.nan_to_num(self.before[i]))),
                *map(float, each[:, i]),
            )
            for i, name in enumerate(model.state_names)
            if i not in data.hidden
        ]
        whole = Parts(*map(float, self.shares(1 / np.maximum(self.noise, 1e-300))))
        source = "noise" if self.repeats is None else "repeats"
        return Split(self.horizon, whole, tuple(channels), source)


def split(
    predictor: Predictor, fit: Fit, bare: Array, where: Horizon, repeats: Sequence[Sequence[int]]
) -> SquaredErrors:
    """The parts of the error at one horizon.

    Args:
        predictor: the data.
        fit: the best hypothesis.
        bare: filtered states that the bare model's predictions start from; the fit has its own.
        where: the horizon (`gap.horizon`).
        repeats: groups of trials (indices) that ran the same candidate.
    """
    before = errors(predictor, Hypothesis(), bare, where)
    after = held_out(predictor, fit, fit.track, where)
    return SquaredErrors(
        where.steps * predictor.data.dt,
        _mean_square(before),
        _mean_square(after),
        (where.spread**2).mean(axis=0),
        scatter(predictor, fit, where.steps, repeats),
    )


def _mean_square(error: Array) -> Array:
    seen = np.isfinite(error)
    total = np.where(seen, error, 0.0) ** 2
    return np.asarray(total.sum(axis=0) / np.maximum(seen.sum(axis=0), 1))


def scatter(
    predictor: Predictor, fit: Fit, steps: int, repeats: Sequence[Sequence[int]]
) -> Array | None:
    """Variance of prediction errors among repeats of one candidate, (n,); None without repeats."""
    data = predictor.data
    lengths = data.valid.sum(axis=1).astype(int)
    total, count = np.zeros(data.model.n), np.zeros(data.model.n)
    for group in repeats:
        for runs in _side_by_side(data, group):
            moments = np.arange(1, int(lengths[runs].min()) - steps + 1)
            moments = moments[:: max(1, len(moments) // MOST_MOMENTS)]
            if len(runs) < 2 or not len(moments):
                continue
            at, run = np.tile(moments, len(runs)), np.repeat(runs, len(moments))
            where = Horizon(steps, at, run, np.ones((len(at), data.model.n)))
            error = errors(predictor, fit.hypothesis, fit.track, where)
            error = error.reshape(len(runs), len(moments), -1)
            whole = np.isfinite(error).all(axis=0)
            variance = np.where(whole, np.nan_to_num(error).var(axis=0, ddof=1), 0.0)
            total += (len(runs) - 1) * variance.sum(axis=0)
            count += (len(runs) - 1) * whole.sum(axis=0)
    shown = np.delete(np.arange(data.model.n), list(data.hidden))
    return total / np.maximum(count, 1) if (count[shown] > 0).all() else None


def _side_by_side(data: Data, group: Sequence[int]) -> list[Any]:
    """The runs of a group's trials that begin at the same time, as indices."""
    own = np.flatnonzero(np.isin(data.trial_of, group))
    begins = data.time[0, own]
    return [own[begins == begin] for begin in np.unique(begins)]


def repeated(candidates: Sequence[str]) -> list[list[int]]:
    """Groups of trials that ran the same candidate, as indices; logs that ran none are no group."""
    groups: dict[str, list[int]] = defaultdict(list)
    for i, candidate in enumerate(candidates):
        if candidate:
            groups[candidate].append(i)
    return [group for group in groups.values() if len(group) > 1]
