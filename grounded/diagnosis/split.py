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
from typing import Any

import numpy as np

from grounded.diagnosis.data import Data
from grounded.diagnosis.fitted import Fitted
from grounded.diagnosis.held_out import held_out_errors
from grounded.diagnosis.hypothesis import Hypothesis, Predictor
from grounded.diagnosis.prediction_error import Horizon, errors
from grounded.diagnosis.report import ChannelParts, Parts, Split
from grounded.frozen import Array

MOST_MOMENTS = 40  # at which repeats are compared


def shares(before: Array, after: Array, floor: Array) -> Array:
    """explained, unexplained, irreducible: the shares of each mean squared error, (3, ...).

    Args:
        before: of the bare model.
        after: with the effects.
        floor: what no model predicts.
    """
    after = np.minimum(after, before)
    floor = np.minimum(floor, after)
    return np.stack([before - after, after - floor, floor]) / np.maximum(before, 1e-300)


def split(
    predictor: Predictor, fit: Fitted, bare: Array, where: Horizon, repeats: Sequence[Sequence[int]]
) -> Split:
    """The parts of the error at one horizon.

    Args:
        predictor: the data.
        fit: the best hypothesis.
        bare: filtered states that the bare model's predictions start from; the fit has its own.
        where: the horizon (`gap.horizon`).
        repeats: groups of trials (indices) that ran the same candidate.
    """
    data = predictor.data
    before = _mean_square(errors(predictor, Hypothesis(), bare, where))
    after = _mean_square(held_out_errors(predictor, fit, fit.track, where))
    noise = (where.spread**2).mean(axis=0)
    repeated = scatter(predictor, fit, where.steps, repeats)
    parts = before, after, noise if repeated is None else repeated
    each = shares(*map(np.nan_to_num, parts))
    units = 1 / np.maximum(noise, 1e-300)  # in all, each state counts in units of its noise
    whole = shares(*(np.nan_to_num(units * part).sum() for part in parts))
    rms = np.sqrt(np.nan_to_num(before))
    channels = tuple(
        ChannelParts(name, data.model.states[name], float(rms[i]), *map(float, each[:, i]))
        for i, name in enumerate(data.model.state_names)
        if i not in data.hidden
    )
    source = "noise" if repeated is None else "repeats"
    return Split(where.steps * data.dt, Parts(*map(float, whole)), channels, source)


def _mean_square(error: Array) -> Array:
    seen = np.isfinite(error)
    total = np.where(seen, error, 0.0) ** 2
    return np.asarray(total.sum(axis=0) / np.maximum(seen.sum(axis=0), 1))


def scatter(
    predictor: Predictor, fit: Fitted, steps: int, repeats: Sequence[Sequence[int]]
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
