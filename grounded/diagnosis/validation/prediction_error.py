"""Where the gap is: prediction errors relative to noise, by channel, time and region.

The errors of the ruler's longest horizon are divided by what noise alone would cause (the filter's
covariance, propagated): 1.0 is the floor, anything above it could be explained. The gain of the
best hypothesis, or of a flexible regression, is broken down by channel, by time and by region. A
region is a half-space of one state or input with a large share of the gain in little of the time.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Any

import numpy as np

from grounded.diagnosis.error_report import Region, TimeShare
from grounded.diagnosis.hypotheses.leftover import filter_of
from grounded.diagnosis.levels import FAR, MANY
from grounded.diagnosis.likelihood.data import Data
from grounded.diagnosis.likelihood.delays import delays_of
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.validation.ahead import unseen
from grounded.diagnosis.validation.ruler import Ruler
from grounded.filter import kalman
from grounded.frozen import Array

MOST_STARTS = 400


def carried(ruler: Ruler, fit: Fitted) -> Array:
    """Return the rms error of noise alone by horizon, (K, n); NaN for whole trials.

    The one-step noise is propagated by the model. No log is predicted before it shows anything new
    (`unseen`).
    """
    first = unseen(ruler.predictor, fit.hypothesis)
    ahead = {*ruler.steps, *first.tolist()}
    of = {steps: _noise_ahead(ruler.predictor, fit, steps) for steps in ahead}
    each = [np.maximum(steps, first) for steps in ruler.steps]
    rows = [[of[int(k)][i] for i, k in enumerate(at)] for at in each]
    return np.array([*rows, np.full(len(first), np.nan)])


def gap_of(ruler: Ruler, fit: Fitted, noise: Array) -> float:
    """Return the held-out gap that a fit leaves at the longest horizon, relative to `carried`."""
    shown, last = ruler.shown, len(ruler.steps) - 1
    return float(np.sqrt(np.nanmean((ruler.errors(fit).rms / noise)[last, shown] ** 2)))


def _noise_ahead(predictor: Predictor, fit: Fitted, steps: int) -> Array:
    """Return the rms error of the log from noise alone some steps ahead, by state (n,).

    Outliers are included, because the errors compared with it contain them.
    """
    # moments of all runs; a shorter horizon if no run is as long
    data = predictor.data
    lengths = data.valid.sum(axis=1).astype(int)
    steps = max(1, min(steps, int(np.median(lengths)) - 2))
    pairs = [(t, b) for b, end in enumerate(lengths) for t in range(data.begin[b], end - steps + 1)]
    if not pairs:
        steps = max(1, int(lengths.max()) - 2)
        pairs = [(t, b) for b, end in enumerate(lengths) for t in range(1, end - steps + 1)]
    pairs = pairs or [(0, 0)]
    at, run = np.array(pairs[:: max(1, len(pairs) // MOST_STARTS)]).T

    # the filter's covariance there, and ahead
    fit = replace(fit, noise=fit.noise.plain)
    noise = fit.noise
    (L, B), n = data.time.shape, data.model.n
    g, delays = filter_of(predictor, fit, covariances=True), delays_of(fit.hypothesis, data)
    R, Q = np.broadcast_to(noise.measurement(L), (L + 1, B, n)), g.system.Q
    wide, N = g.k.shape[2:]
    P = g.posterior[np.maximum(at - 1, 0), run]
    P[:, wide:], P[:, :, wide:] = 0.0, 0.0  # coloured noise: start from its stationary variance
    k = np.arange(wide, wide + n if wide < N else wide)
    P[:, k, k] = noise.start(1)[0] if wide < N else 0.0
    delayed = {} if delays is None else dict(zip(delays.channel, delays.whole, strict=True))
    # a delayed channel shows a state from before the horizon; if even from before the start, that
    # state is filtered already, and this variance is an upper bound
    found = {i: P[:, i, i] for i, whole in delayed.items() if whole >= steps}
    for j in range(steps):
        A, q = g.system.A[at + j, run], Q[at + j, run]
        G = None if g.system.G is None else g.system.G[at + j, run]
        P = kalman.predicted(P, A, q, G)
        found |= {i: P[:, i, i] for i, whole in delayed.items() if whole == steps - 1 - j}
    variance = np.einsum("bii->bi", P[:, :n, :n]).copy()
    for i, of_late in found.items():
        variance[:, i] = of_late
    variance += R[at + steps, run]
    count = (seen := data.seen[at + steps, run] > 0).sum(axis=0)
    mean = np.where(seen, variance, 0.0).sum(axis=0) / np.maximum(count, 1)
    return np.where(count > 0, np.sqrt(mean), np.nan)


def explained(predictor: Predictor, null: Hypothesis, best: Fitted) -> Array:
    """Return the gain of `best` over the bare model at every step and channel, (L, B, n) [nats].

    Both are filtered with the noise of `best`. The bare model's own noise estimate is larger and
    would hide the gap.
    """
    data = predictor.data
    g = filter_of(predictor, best)
    track = best.track
    x = track[:-1]
    after = predictor.advance(null, x, predictor.inputs(null), data.time)
    d = data.model.difference(after, track[1:])
    r = data.model.difference(data.y - track, np.zeros_like(track))
    delays = delays_of(best.hypothesis, data)
    r = r if delays is None else delays.aligned(r)
    white, _ = kalman.innovations(g, d[..., None], r[..., None])
    return np.asarray(0.5 * (white[..., 0] ** 2 - best.white**2))


def by_time(gain: Array, data: Data, parts: int = 8) -> list[TimeShare]:
    """Return the shares of the gap in equal parts of the trial's duration, which sum to 1.

    A part in which predictions lose has none of it.
    """
    end = float(data.time.max()) + data.dt
    edges = [*itertools.pairwise(np.linspace(0, end, parts + 1))]
    each = [float(gain[(data.time >= a) & (data.time < b)].sum()) for a, b in edges]
    whole = max(sum(max(one, 0.0) for one in each), 1e-12)
    return [
        TimeShare(float(a), float(b), max(one, 0.0) / whole)
        for (a, b), one in zip(edges, each, strict=True)
    ]


def by_region(
    gain: Array, predictor: Predictor, fit: Fitted, most: int = 3, but: Collection[str] = ()
) -> list[Region]:
    """Return the half-spaces of a state or an input with most of the gap in little of the time.

    Args:
        gain: what is left in each step, (L, B).
        predictor: has the data.
        fit: its states.
        most: number of regions, at most one a signal.
        but: states that are left out.
    """
    data = predictor.data
    model = data.model
    signals: list[tuple[str, Array]] = []
    u = data.runs(data.commands)
    signals += [(n, u[..., j]) for j, n in enumerate(model.input_names)]
    hidden = {*but, *(model.state_names[i] for i in data.hidden)}
    shown = [(i, n) for i, n in enumerate(model.state_names) if n not in hidden]
    signals += [(n, fit.track[:-1, :, i]) for i, n in shown]
    signals.append(("t", data.time))
    units = {**model.states, **model.inputs, "t": "s"}
    whole = max(float(gain.sum()), 1e-12)
    valid = data.valid.T > 0
    found = []
    for name, signal in signals:
        best = _stump(name, signal, gain, valid, whole)
        if best is not None:
            found.append(replace(best, unit=units[name]))
    found.sort(key=lambda region: -(region.share - region.occupancy))
    return found[:most]


def _stump(name: str, signal: Array, gain: Array, valid: Any, whole: float) -> Region | None:
    """Return the best half-space of one signal, by its value or its magnitude, or None."""
    best: Region | None = None
    margin = 0.1
    nothing = 1e-3 * float(signal[valid].std())  # levels below it are shown as zero
    forms: list[tuple[str, Callable[[Array], Array]]] = [(name, lambda v: v)]
    if float(signal.min()) < 0 < float(signal.max()):
        forms.append((f"|{name}|", np.abs))
    for label, form in forms:
        values = form(signal)
        for level in np.quantile(values[valid], np.linspace(0.1, 0.9, 9)):
            for sign, inside in (("<", values < level), (">", values > level)):
                inside = inside & valid
                occupancy = float(inside.sum()) / float(valid.sum())
                share = float(gain[inside].sum()) / whole
                if occupancy < 0.03 or share - occupancy <= margin:
                    continue
                if share * (1 - occupancy) < FAR * (1 - share) * occupancy:
                    continue  # the gap is nearly everywhere that was driven
                if share - occupancy < MANY * _scatter(gain, inside, min(share, 1.0), whole):
                    continue  # it may be there by chance
                margin = share - occupancy
                shown = 0.0 if abs(level) < nothing else level
                best = Region(f"{label} {sign} {shown:.3g}", min(share, 1.0), occupancy)
    return best


def _scatter(gain: Array, inside: Any, share: float, whole: float) -> float:
    """Return the standard deviation of a region's share, by steps that are independent.

    Where a correction gains little, its steps gain and lose by turns: of 20 nats, made of 123 that
    are won and 103 that are lost, any half of the time can hold all.
    """
    return float(np.sqrt(np.sum((gain * (inside - share)) ** 2))) / whole
