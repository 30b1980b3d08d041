"""In how many motions an effect that names no mechanism is seen: trials that repeat one are one.

A wave in time, a constant, what one state adds to another's rate, a patch of ground: `Family.loose`
fits any shape. Where all trials follow one path, whatever the model lacks is the same function of
time in each of them, and of every state: repeats make it likelier with each trial, and trials that
are left out are foretold by those that repeat them. None of that tells a cause. So such an effect
is believed only as far as motions that differ bear it out: of the nats that are lost without it,
the motion that holds most has no say.

Two trials repeat one motion, for an effect, where what it adds to the rates is nearly the same
function of time in both, and so is a state on which the rates may depend in another way. Compared
are means over tenths of the trial, so that a feedback that chatters, or noise, makes no motion
another one.

What is a function of time alone, a wave or a trend, adds the same to all trials, whatever they do.
Candidates for one target move alike but for a few per cent: a function of a state that they share
follows the wave in all of them but for as much. So there a trial's nats count by the part of its
motion that is not that of the motion with most say.
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
from grounded.effects.places import dynamic
from grounded.frozen import Array
from grounded.model import Model, Param

REPEATS = 0.03  # of a signal's power: trials that differ by less are one motion
TENTHS = 10  # stretches whose means are compared
LENGTH = 0.2  # of a trial's steps by which another one may be longer
KNOWN = 2.0  # standard deviations from zero of a size that is known
HALF = 0.5  # of its say: a trial with less moves as the others do


def repeats(search: FittedHypotheses, fit: Fitted, less: Fitted, name: str) -> int:
    """How many trials make the motion that bears an effect out, or nearly; 0: others do, too.

    Args:
        search: whose evidence counts.
        fit: with the effect.
        less: without it, the rest fitted again.
        name: of the effect.
    """
    data, h = search.data, fit.hypothesis
    if data.count < 2 or not h.effects[h.names.index(name)].family.loose:
        return 0
    if np.bincount(data.trial_of).max() >= PIECES:
        return 0  # a log so long makes many motions, and would do without the others
    paths = _Paths(search.predictor, h.minus(name), h, fit.track)
    motion = paths.motions()
    lost = 0.5 * (less.rss + less.logdet - fit.rss - fit.logdet)
    nats = search.tempering.factor * np.bincount(data.trial_of, lost, data.count)
    most = int(np.bincount(motion, nats).argmax())
    say = (motion != most).astype(float)
    if getattr(h.effects[h.names.index(name)].family, "timed", False):
        first = int(np.flatnonzero(motion == most)[0])
        say *= [paths.apart(first, trial) for trial in range(data.count)]
    alike = int((say < HALF).sum())
    return alike if alike > 1 and say @ nats < CLAIM else 0


def of_no_size(predictor: Predictor, fit: Fitted, trial_of: Array) -> list[str]:
    """The effects of a fit that may as well be nothing, or lie where nobody was.

    No size of it is known to KNOWN deviations. Of a wave of half a period what it adds where
    something was measured is known, what it is is not; of two falls what grows with time is told by
    how both ended. The size of a patch of ground hangs on its place: it counts where a trial came
    within a radius of that. Parameters have priors of their own.

    Args:
        predictor: of the data of the fit.
        fit: with the effects.
        trial_of: what each run is left out with (B,), for the scatter between them.
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
    """Whether a trial came within a radius of a place (x0, y0, ...)."""
    names = data.model.state_names
    where = [name for name in names if f"{name}0" in values]
    own = data.filled[:, [names.index(name) for name in where]]
    away = own - np.array([values[f"{name}0"] for name in where])
    return bool(((away**2).sum(axis=1) < values["radius"] ** 2).any())


def without_others(
    predictor: Predictor, track: Array, adopted: Collection[str], library: Library
) -> Model:
    """The model with the numbers of adopted effects as constants that one motion can't tell.

    Those without a mechanism, where all trials make one motion: other trials have told them.

    Args:
        predictor: of the data.
        track: of the states (L + 1, B, n).
        adopted: names of effects whose numbers are parameters.
        library: that has them.
    """
    data, model, held = predictor.data, predictor.data.model, set[str]()
    for name in adopted if data.count > 1 else ():
        of, _, target = name.partition(":")
        family = library.family(of)
        if not family.loose or target not in family.targets(model):
            continue  # of what has it already: two sensors that were late as one are so no more
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
    """In how many motions that differ the trials were made."""
    return 1 + int(motions(predictor, Hypothesis(), Hypothesis(), predictor.data.y).max())


def motions(predictor: Predictor, less: Hypothesis, h: Hypothesis, track: Array) -> Any:
    """Which motion each trial makes, (S,) of int, for what `h` adds to `less` along a track."""
    return _Paths(predictor, less, h, track).motions()


class _Paths:
    """What `h` adds to `less` along each trial, and the states there on which rates may depend."""

    def __init__(self, predictor: Predictor, less: Hypothesis, h: Hypothesis, track: Array) -> None:
        data, x = predictor.data, track[:-1]
        added = data.model.difference(predictor.next(less, x), predictor.next(h, x))
        self.signal, self.states = _by_trial(data, added), _states(data)
        self.power = [float(_power(one, none=0.0)) for one in self.signal]
        means = np.concatenate([_tenths(one) for one in self.states])
        seen = np.isfinite(means).any(axis=0)
        self.spread = np.full(len(seen), np.nan)  # of what nobody measures
        self.spread[seen] = np.nanvar(means[:, seen], axis=0)
        self.moves = np.zeros(len(seen), bool)
        self.moves[seen] = self.spread[seen] > 1e-9 * np.nanmean(means[:, seen] ** 2, axis=0)

    def motions(self) -> Any:
        """Which motion each trial makes, (S,) of int."""
        led, found = list[int](), np.zeros(len(self.signal), int)
        for i in range(len(found)):
            leader = next((k for k, j in enumerate(led) if self.same(i, j)), len(led))
            led += [i] * (leader == len(led))
            found[i] = leader
        return found

    def same(self, i: int, j: int) -> bool:
        """Whether two trials repeat one motion."""
        acts = _power(self._between(self.signal, i, j))
        alike = acts <= REPEATS * (self.power[i] + self.power[j])
        return bool(alike and self.apart(i, j) <= REPEATS)

    def apart(self, i: int, j: int) -> float:
        """By which part of its power two trials differ in the state that differs least, 0 to 1."""
        length, other = len(self.signal[i]), len(self.signal[j])
        if max(length, other) > (1 + LENGTH) * min(length, other) or not self.moves.any():
            return 1.0
        moved = _power(self._between(self.states, i, j), axis=0)[self.moves]
        return float(min((0.5 * moved / self.spread[self.moves]).min(), 1.0))

    def _between(self, each: list[Array], i: int, j: int) -> Array:
        """What two trials differ by, over as many steps as both have, in means over tenths."""
        steps = min(len(self.signal[i]), len(self.signal[j]))
        return _tenths(each[i][:steps]) - _tenths(each[j][:steps])


def _by_trial(data: Data, values: Array) -> list[Array]:
    """Values by step (L, B, n), of each trial (T, n); NaN where a run was left out."""
    flat = np.full((int(data.lengths.sum()), values.shape[-1]), np.nan)
    there = data.valid > 0
    flat[data.step_at[there]] = values.swapaxes(0, 1)[there]
    return np.split(flat, np.cumsum(data.lengths)[:-1])


def _states(data: Data) -> list[Array]:
    """Of each trial (T + 1, n) the states on which a rate may depend, and that some sensor has."""
    names = data.model.state_names
    known = [names.index(n) for n in dynamic(data.model) if n in names]
    seen = [i for i in known if data.seen[..., i].any() and i not in data.hidden]
    return np.split(data.filled[:, seen], np.cumsum(data.lengths + 1)[:-1])


def _power(values: Array, axis: int | None = None, none: float = np.inf) -> Any:
    """The mean square of what is known; `none` where nothing is, as of a trial left out."""
    known = np.isfinite(values)
    count = known.sum(axis=axis)
    total = (np.where(known, values, 0.0) ** 2).sum(axis=axis)
    return np.where(count > 0, total / np.maximum(count, 1), none)


def _tenths(values: Array) -> Array:
    """Means over stretches of time, (TENTHS, n) of (T, n)."""
    parts = np.array_split(values, min(TENTHS, len(values)))
    return np.stack([part.mean(axis=0) for part in parts])
