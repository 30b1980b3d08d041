"""Number of different motions in which an effect without a mechanism is seen.

Families marked `Family.loose` (a wave in time, a constant, a coupling between states, a patch of
ground) fit any shape. If all trials follow one path, any error of the model is the same function of
time, and of every state, in each of them. Each repeat then raises the evidence of such an effect,
and a held-out trial is predicted well by those that repeat it, but none of that identifies a cause.
So the effect is accepted only if different motions support it: of the nats lost without it, those
of the motion with the largest share are not counted.

Two trials make the same motion, for an effect, if what it adds to the rates is nearly the same
function of time in both, and so is at least one state that the rates may depend on instead.
Compared are means over tenths of the trial, so that noise or a chattering feedback does not make
motions different.

Candidates for one target move alike except for a few per cent, and so does any function of a state
that they share: a wave, but also a patch of ground or a coupling. So a trial's nats are weighted by
the fraction of its motion, or of what the effect adds to it, that differs from the motion with the
largest share. A constant is told: what else repeats with a motion changes along it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from grounded.diagnosis.hypotheses.explored import CLAIM, FittedHypotheses
from grounded.diagnosis.likelihood.data import PIECES, Data
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.intervals import standard_deviations
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.effects import Library, ParamFamily, param_name
from grounded.frozen import Array
from grounded.model import Model, Param
from grounded.places import dynamic

REPEATS = 0.03  # fraction of a signal's power below which trials make the same motion
TENTHS = 10  # stretches whose means are compared
LENGTH = 0.2  # relative difference of the lengths of trials of one motion, at most
KNOWN = 2.0  # standard deviations from zero from which a size is known
STEADY = 0.05  # relative change up to which what an effect adds is constant
HALF = 0.5  # weight below which a trial counts as the same motion


def repeats(search: FittedHypotheses, fit: Fitted, less: Fitted, name: str) -> int:
    """Return the number of trials of the only motion that supports an effect.

    Args:
        search: provides tempering and predictor.
        fit: the fit with the effect.
        less: the fit without it, the rest fitted again.
        name: name of the effect.

    Returns:
        0 if other motions support it, too, or if it names a mechanism.
    """
    data, h = search.data, fit.hypothesis
    if data.count < 2 or not h.effects[h.names.index(name)].family.loose:
        return 0
    if np.bincount(data.trial_of).max() >= PIECES:
        return 0  # a log this long contains many motions
    paths = _Paths(search.predictor, h.minus(name), h, fit.track)
    motion = paths.motions()
    lost = 0.5 * (less.rss + less.logdet - fit.rss - fit.logdet)
    nats = search.tempering.factor * np.bincount(data.trial_of, lost, data.count)
    most = int(np.bincount(motion, nats).argmax())
    say, own = (motion != most).astype(float), np.flatnonzero(motion == most)
    if not paths.constant:
        say *= [min(paths.unlike(int(i), k) for i in own) for k in range(data.count)]
    alike = int((say < HALF).sum())
    return alike if alike > 1 and say @ nats < CLAIM else 0


def of_no_size(predictor: Predictor, fit: Fitted, trial_of: Array) -> list[str]:
    """Return the effects of a fit whose size is not known, or patches that no trial visited.

    The size is not known if no coefficient differs from zero by KNOWN standard deviations. (Of a
    wave of half a period, the sum in the measured range is known, its coefficients are not.) The
    size of a patch of ground depends on its place, so it counts if a trial came within a radius of
    it. Parameters are exempt, since they have priors.

    Args:
        predictor: evaluates hypotheses on the data of the fit.
        fit: the fit with the effects.
        trial_of: fold of each run (B,), for the scatter between them.
    """
    found, sizes, at = [], dict[str, list[int]](), 0
    for effect, values in fit.hypothesis.pairs:
        strengths = [at + k for k, q in enumerate(effect.free) if not q.grid]
        if effect.family.loose and "radius" in values:
            found += [effect.name] * (not _visited(predictor.data, values))
        elif strengths and not isinstance(effect.family, ParamFamily):
            sizes[effect.name] = strengths
        at += len(effect.free)
    if sizes:
        theta, stds = fit.hypothesis.theta, standard_deviations(predictor, fit, trial_of)[0]
        found += [n for n, own in sizes.items() if (np.abs(theta[own]) < KNOWN * stds[own]).all()]
    return found


def _visited(data: Data, values: Mapping[str, float]) -> bool:
    """Check whether a trial came within a radius of a place (x0, y0, ...)."""
    names = data.model.state_names
    where = [name for name in names if f"{name}0" in values]
    own = data.filled[:, [names.index(name) for name in where]]
    away = own - np.array([values[f"{name}0"] for name in where])
    return bool(((away**2).sum(axis=1) < values["radius"] ** 2).any())


def without_others(
    predictor: Predictor, track: Array, adopted: Collection[str], library: Library
) -> Model:
    """Return the model with the values of adopted effects held that one motion can't determine.

    These are effects without a mechanism, if all trials make the same motion for them. Their
    values were found from other trials.

    Args:
        predictor: evaluates hypotheses on the data.
        track: states (L + 1, B, n).
        adopted: names of the adopted effects, whose values are parameters of the model.
        library: source of the effects.
    """
    data, model, held = predictor.data, predictor.data.model, set[str]()
    for name in adopted if data.count > 1 else ():
        of, _, target = name.partition(":")
        family = library.family(of)
        if not family.loose or target not in family.targets(model):
            continue  # not applicable any more, as a common delay once one sensor has another one
        effect = library.effect(name, model, data.scales)
        own = {q.name: param_name(name, q.name) for q in effect.quantities}
        if not all(p in model.params for p in own.values()):
            continue
        values = {q: model.params[p].value for q, p in own.items()}
        h = Hypothesis().plus(effect, values)
        if not motions(predictor, Hypothesis(), h, track).any():
            held |= set(own.values())
    params = {n: Param(p.value, p.unit) if n in held else p for n, p in model.params.items()}
    return replace(model, params=params) if held else model


def how_many(predictor: Predictor) -> int:
    """Return the number of different motions of the trials."""
    return 1 + int(motions(predictor, Hypothesis(), Hypothesis(), predictor.data.y).max())


def motions(predictor: Predictor, less: Hypothesis, h: Hypothesis, track: Array) -> Any:
    """Return the motion of each trial, (S,) of int, for what `h` adds to `less` along a track."""
    return _Paths(predictor, less, h, track).motions()


class _Paths:
    """What `h` adds to `less` along each trial, and the states that rates may depend on."""

    def __init__(self, predictor: Predictor, less: Hypothesis, h: Hypothesis, track: Array) -> None:
        data, x = predictor.data, track[:-1]
        added = data.model.difference(predictor.next(less, x), predictor.next(h, x))
        self.signal, self.states = _by_trial(data, added), _states(data)
        self.power = [float(_power(one, none=0.0)) for one in self.signal]
        means = np.concatenate([_tenths(one) for one in self.states])
        seen = np.isfinite(means).any(axis=0)
        self.spread = np.full(len(seen), np.nan)  # NaN where not measured
        self.spread[seen] = np.nanvar(means[:, seen], axis=0)
        self.moves = np.zeros(len(seen), bool)
        self.moves[seen] = self.spread[seen] > 1e-9 * np.nanmean(means[:, seen] ** 2, axis=0)

    @property
    def constant(self) -> bool:
        """Whether what is added is the same at every step."""
        change = 0.0
        for one in self.signal:  # NaN in runs left out, which may be all of a trial
            known = np.isfinite(one)
            mean = np.where(known, one, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
            change += float(_power(one - mean, none=0.0))
        return change <= STEADY**2 * sum(self.power)

    def motions(self) -> Any:
        """Return the motion of each trial, (S,) of int."""
        found = np.arange(len(self.signal))
        for i in range(len(found)):
            for j in range(i):
                if found[i] != found[j] and self.same(i, j):  # also by way of others
                    found[found == max(found[i], found[j])] = min(found[i], found[j])
        return np.unique(found, return_inverse=True)[1]

    def same(self, i: int, j: int) -> bool:
        """Check whether two trials make the same motion."""
        return self.unlike(i, j) <= REPEATS

    def unlike(self, i: int, j: int) -> float:
        """Return by which fraction what is added to two trials, or else their motion, differs."""
        acts, both = _power(self._between(self.signal, i, j)), self.power[i] + self.power[j]
        return max(self.apart(i, j), min(float(acts) / both, 1.0) if both > 0 else 0.0)

    def apart(self, i: int, j: int) -> float:
        """Return by which fraction of its power the most similar state of two trials differs."""
        length, other = len(self.signal[i]), len(self.signal[j])
        if max(length, other) > (1 + LENGTH) * min(length, other) or not self.moves.any():
            return 1.0
        moved = _power(self._between(self.states, i, j), axis=0)[self.moves]
        return float(min((0.5 * moved / self.spread[self.moves]).min(), 1.0))

    def _between(self, each: list[Array], i: int, j: int) -> Array:
        """Return the difference of two trials over their common steps, in means over tenths."""
        steps = min(len(self.signal[i]), len(self.signal[j]))
        return _tenths(each[i][:steps]) - _tenths(each[j][:steps])


def _by_trial(data: Data, values: Array) -> list[Array]:
    """Return values by step (L, B, n) as one array (T, n) per trial; NaN in runs left out."""
    flat = np.full((int(data.lengths.sum()), values.shape[-1]), np.nan)
    there = data.valid > 0
    flat[data.step_at[there]] = values.swapaxes(0, 1)[there]
    return np.split(flat, np.cumsum(data.lengths)[:-1])


def _states(data: Data) -> list[Array]:
    """Return, per trial (T + 1, n), the measured states that a rate may depend on."""
    names = data.model.state_names
    known = [names.index(n) for n in dynamic(data.model) if n in names]
    seen = [i for i in known if data.seen[..., i].any() and i not in data.hidden]
    return np.split(data.filled[:, seen], np.cumsum(data.lengths + 1)[:-1])


def _power(values: Array, axis: int | None = None, none: float = np.inf) -> Any:
    """Return the mean square of finite values; `none` if there are none."""
    known = np.isfinite(values)
    count = known.sum(axis=axis)
    total = (np.where(known, values, 0.0) ** 2).sum(axis=axis)
    return np.where(count > 0, total / np.maximum(count, 1), none)


def _tenths(values: Array) -> Array:
    """Return means over stretches of time, (TENTHS, n) of (T, n)."""
    parts = np.array_split(values, min(TENTHS, len(values)))
    return np.stack([part.mean(axis=0) for part in parts])
