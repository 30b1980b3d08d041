"""The decision in numbers: errors, noise floor, credit, leftover, and where the gap is.

Errors above the floor are reported as a leftover, whatever is claimed. A correction by a flexible
regression counts as a leftover if predictions gain by it; what it predicts is not noise, so the
floor is lowered to what it reaches.

The errors of the ruler's longest horizon are divided by what noise alone would cause (the filter's
covariance, propagated): 1.0 is the floor, anything above it could be explained. The gain of the
best hypothesis, or of a flexible regression, is broken down by channel, by time and by region. A
region is a half-space of one state or input with a large share of the gain in little of the time.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from grounded.diagnosis.error_report import (
    Credit,
    Part,
    Region,
    Remainder,
    RulerRow,
    TimeShare,
)
from grounded.diagnosis.hypotheses.leftover import Leftover, filter_of, whiteness
from grounded.diagnosis.levels import ABOVE, CHANCE, FAR, HALF, MANY, WILD
from grounded.diagnosis.likelihood.data import Data
from grounded.diagnosis.likelihood.delays import delays_of
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.validation.decide import Decision, plain
from grounded.diagnosis.validation.ruler import Ruler, repeated, unseen
from grounded.filter import kalman
from grounded.frozen import Array
from grounded.trial import Trial

# of all errors: at most this share is in a part that holds most of those above the noise
SMALL_PART = 0.2


class Measured:
    """Measurements of a decision; every method is one part of the `Diagnosis`."""

    def __init__(
        self,
        decision: Decision,
        ruler: Ruler,
        trials: Sequence[Trial],
        first: int,
        exact: bool = False,
    ) -> None:
        self.first = first  # trials of the first group; the others may be of a changed robot
        self.decision, self.ruler, self.trials = decision, ruler, trials
        self.exact = exact  # all repeats were bit-identical: a simulator
        self.search, self.best = decision.search, decision.fit
        self.predictor, self.data = self.search.predictor, self.search.data
        self.units = {n: self.data.model.states[n] for n in ruler.names}
        self.left, self.flexible = decision.left, decision.flexible
        self.whiteness = self.white()
        told = [p for n, p in self.whiteness.items() if n not in self.data.between]
        self.is_white = not self.left and min(told, default=0.0) * len(told) > CHANCE
        self.carried = carried(ruler, self.best)
        self.floor, self.source = self.noise_floor()  # sets `unsure`, std of its log, (K, 1)
        by_repeats = self.source == "repeats"
        self.at_most = not self.exact and bool(self.left) if by_repeats else not self.is_white

    def rms(self, fit: Fitted) -> Array:
        """Return the rms errors of a fit by horizon and shown state, (K, n')."""
        return np.asarray(self.ruler.errors(fit).rms[:, self.ruler.shown])

    def calibrated(self) -> Fitted | None:
        """Return the best calibrated fit without effects, or the crude fit if that predicts better.

        Candidates are the likeliest one and the decision without its effect. None if the parameters
        were never calibrated.
        """
        fits = [f for (_, spread, names), f in self.search.fits.items() if spread and not names]
        if not fits:
            return None
        rest = [f for f in self.decision.without.values() if f in fits]
        found, crude = [max(fits, key=self.search.score), *rest], self.decision.crude
        return max([crude, *found], key=lambda f: self.ruler.gain(crude, f).mean)

    def noise_floor(self) -> tuple[Array, str]:
        """Return the rms error of noise alone, by horizon and shown state, and its source.

        Without repeats, the one-step noise is propagated by the model. It contains the error of the
        model, so the floor is an upper bound (`at_most`). Beside a leftover the scatter of repeats
        does as well, and the smaller of the two is the floor of its channel. Coloured noise is
        taken as noise only in channels in which a flexible regression finds no structure. Few
        repeats may scatter less than their sensors do, which no prediction of a reading can.
        """
        self.unsure = np.zeros((len(self.ruler.steps) + 1, 1))
        if self.exact and not self.is_white:  # white innovations are noise, and the repeat a copy
            return np.zeros((len(self.ruler.steps) + 1, len(self.units))), "repeats"
        repeats = repeated(self.trials, self.data, self.first)
        scatter, source = self.ruler.scatter(self.best, repeats), "repeats"
        off = [self.data.model.state_names.index(left.channel) for left in self.left]
        if scatter is None:
            found, source = self.carried.copy(), "short horizon"
            if off:
                found[:, off] = carried(self.ruler, plain(self.search, self.best))[:, off]
        else:
            found, self.unsure = scatter[0], scatter[1][:, None]
            if off:  # both are bounds then, and the smaller one holds
                own = carried(self.ruler, plain(self.search, self.best))[:, off]
                less, place = own < found[:, off], [self.ruler.shown.index(i) for i in off]
                found[:, off] = np.where(less, own, found[:, off])
                self.unsure = np.repeat(self.unsure, len(self.units), axis=1)
                self.unsure[:, place] *= ~less
        if scatter is not None and not self.exact:
            found[:-1] = np.fmax(found[:-1], self.sensors())
        reached = [e.rms for _, e in self.ruler.measured]
        reached += [errors.rms for _, errors in self.flexible.values()]
        least = np.fmin.reduce(reached)
        if scatter is not None and np.isnan(found[-1]).all():
            least[-1] = np.nan  # repeats are too short for the floor of whole trials
        return np.fmin(found, least)[:, self.ruler.shown], source

    def sensors(self) -> Array:
        """Return the rms white noise of each state's sensor, (n,); 0 without samples.

        It is the smaller of two estimates. That of the best fit contains errors of the model within
        a step, and that of differences a motion that bends within few samples.
        """
        fitted = np.sqrt(self.best.noise.plain.measurement(1)[-1, 0])
        rows = [len(trial.states) for trial in self.trials]
        seen = np.average([trial.noise() ** 2 for trial in self.trials], axis=0, weights=rows)
        return np.asarray(np.minimum(fitted, np.sqrt(seen)))

    def white(self) -> dict[str, float]:
        """Return the p-value of white innovations, by channel."""
        delays = delays_of(self.best.hypothesis, self.data)
        seen = self.data.seen if delays is None else delays.samples()[1]
        found = whiteness(self.best, seen)
        return {n: float(found[i]) for i, n in zip(self.ruler.shown, self.units, strict=True)}

    def gap(self, fit: Fitted) -> float:
        """Return the gap that a fit leaves at the longest horizon, relative to the noise alone."""
        relative = (self.ruler.errors(fit).rms / self.carried)[len(self.ruler.steps) - 1]
        return float(np.sqrt(np.nanmean(relative[self.ruler.shown] ** 2)))

    def prediction_error(self) -> tuple[RulerRow, ...]:
        """Return the table of prediction errors at 0.1, 0.5, 1 s and over the whole trial."""
        calibrated = self.calibrated()
        before = None if self.ruler.origin is None else self.ruler.outset.rms[:, self.ruler.shown]
        columns = {
            "outset": before,
            "crude": self.rms(self.decision.crude),
            "calibrated": None if calibrated is None else self.rms(calibrated),
            "with_effects": self.rms(self.best),
            "noise_floor": self.floor,
        }
        rows = []
        for k, seconds in self.horizons():
            found = {
                key: {} if rms is None else dict(zip(self.units, map(float, rms[k]), strict=True))
                for key, rms in columns.items()
            }
            away = {
                key: tuple(n for n, e in found[key].items() if e > WILD * self.reach[n] > 0)
                for key in columns
            }
            rows.append(
                RulerRow(
                    seconds,
                    k == len(self.ruler.steps),
                    self.units,
                    self.ruler.by,
                    floor_from=self.source,
                    floor_at_most=self.at_most,
                    floor_unsure=float(self.unsure[k].max()),
                    runs_away={key: names for key, names in away.items() if names},
                    drowned=bool(self.drowned[k]),
                    **found,
                )
            )
        return tuple(rows)

    @cached_property
    def drowned(self) -> Any:
        """Horizons at which noise alone exceeds the measured range of some state, (K,) of bool."""
        reach = np.array(list(self.reach.values()))
        lost = np.any((self.floor > reach) & (reach > 0), axis=1)
        lost[-1] = False  # whole trials have a floor from repeats only
        return lost

    @cached_property
    def reach(self) -> dict[str, float]:
        """Measured range of each shown state, largest minus smallest value."""
        reach = np.ptp(self.data.filled, axis=0)
        return {n: float(reach[i]) for i, n in zip(self.ruler.shown, self.units, strict=True)}

    def horizons(self) -> list[tuple[int, float]]:
        """Return (index, seconds) of the table's rows; a single step only if it is long enough."""
        dt, steps = self.data.dt, self.ruler.steps
        first = 0 if len(steps) < 2 or dt > 0.05 else 1
        rows = [(k, steps[k] * dt) for k in range(first, len(steps))]
        return [*rows, (len(steps), float(np.median(self.data.lengths)) * dt)]

    @cached_property
    def credits(self) -> tuple[Credit, ...]:
        """The credit of each cause, largest first: its share of the total gain in log error.

        If causes overlap, the shares sum to less than 1. If they depend on one another, so that the
        losses sum to more than the total gain, the shares are normalised to 1.
        """
        gain, best, k = self.ruler.gain, self.best, len(self.ruler.steps) - 1
        without = self.decision.without.items()
        lost = {name: max(gain(fit, best).mean, 0.0) for name, fit in without}
        whole = max(gain(self.decision.crude, best).mean, sum(lost.values()), 1e-12)
        found = []
        for name, fit in without:
            errors = dict(zip(self.units, self.rms(fit)[k].tolist(), strict=True))
            found.append(Credit(name, lost[name] / whole, errors))
        return tuple(sorted(found, key=lambda one: -one.share))

    def remainders(self) -> tuple[Remainder, ...]:
        """Return the leftovers: errors above the floor, and corrections that improve predictions.

        They are sorted by the ratio of error to floor, largest first, with or without a correction.
        """
        data, ruler = self.data, self.ruler
        k = int(np.flatnonzero(~self.drowned[:-1]).max(initial=0))
        now, fine = self.rms(self.best), ruler.fine[ruler.shown]
        short = slice(0, k + 1)
        unsure = np.hypot(2 * ruler.doubt(self.best), MANY * self.unsure)
        doubt = np.minimum(unsure, np.log(FAR))
        least = np.maximum(np.log(ABOVE), doubt)
        above = (np.log(now / self.floor) > least) & (now > 2 * fine)
        found = []
        for i, name in enumerate(ruler.names):
            left = self.flexible[name][0] if name in self.flexible else None
            if now[k, i] <= 2 * fine[i]:
                left = None
            error, floor = float(now[k, i]), float(self.floor[k, i])
            if left is None and not above[short, i].any():
                continue
            at = k
            if left is None and not above[k, i]:
                at = int(np.flatnonzero(above[short, i])[-1])
                error, floor = float(now[at, i]), float(self.floor[at, i])
            row = Remainder(
                name,
                error=error,
                floor=floor,
                horizon_s=ruler.steps[at] * data.dt,
                error_unit=self.units[name],
                floor_at_most=self.at_most,
                part=self.part(at, ruler.shown[i], floor),
            )
            found.append((-error / max(floor, float(fine[i])), i, left, row))
        found.sort(key=lambda each: each[:2])
        return tuple(self.with_region(row, left) for *_, left, row in found)

    def part(self, k: int, i: int, floor: float) -> Part | None:
        """Return the part of a trial, of a second or less, with most of a state's error; or None.

        Args:
            k: place of the horizon.
            i: the state.
            floor: rms error of noise alone, which does not count.
        """
        errors, ruler, data = self.ruler.errors(self.best), self.ruler, self.data
        total, count = errors.total[k, :, i], errors.count[k, :, i]
        above = np.maximum(total - count * floor**2, 0.0)
        most = int(np.argmax(above))
        share = above[most] / max(float(above.sum()), 1e-300)
        if share < HALF or count[most] > SMALL_PART * count.sum():
            return None
        run = int(ruler.run_of[most])
        trial = int(data.trial_of[run])
        first = int(data.step_at[run, 0] - ruler.step0[trial])
        first += int(most - ruler.piece0[run]) * ruler.steps[-1]
        end = min(first + ruler.steps[-1], int(data.lengths[trial]))
        return Part(self.trials[trial].id, first * data.dt, end * data.dt, float(share))

    def with_region(self, row: Remainder, left: Leftover | None) -> Remainder:
        """Add the missing rate and its region, as a flexible regression finds them."""
        if left is None:
            return row
        size = left.correction**2 * self.data.valid.T
        regions = by_region(size, self.predictor, self.best, 1)
        region = regions[0] if regions else None
        return replace(row, size=left.size, unit=left.unit, evidence=left.gain, region=region)


MOMENTS = 400  # most moments at which the noise is propagated


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
    at, run = np.array(pairs[:: max(1, len(pairs) // MOMENTS)]).T

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


def by_region(gain: Array, predictor: Predictor, fit: Fitted, most: int = 3) -> list[Region]:
    """Return the half-spaces of a state or an input with most of the gap in little of the time.

    Args:
        gain: what is left in each step, (L, B).
        predictor: has the data.
        fit: its states.
        most: number of regions, at most one a signal.
    """
    data = predictor.data
    model = data.model
    signals: list[tuple[str, Array]] = []
    u = data.runs(data.commands)
    signals += [(n, u[..., j]) for j, n in enumerate(model.input_names)]
    shown = [(i, n) for i, n in enumerate(model.state_names) if i not in data.hidden]
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
