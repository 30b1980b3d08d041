"""A whole trial in other units than the rest: degrees for radians, milliseconds for seconds.

Where one state of a trial is in degrees, or its stamps are in milliseconds, the rate of a position
is a constant times what the velocity says; which of the two is off, the sizes in sound trials say.
Where all angles and their rates are in degrees they agree with each other: then commands as large
as in other trials seem to move the body tens of times as far, the model misses that by tens of
times as much, and divided by 57.3 by as much as the rest. Commands in thousandths are tens of times
smaller than in other trials, and the model predicts what the body does with thousand times as much,
neither with a third of that nor with three times.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.errors import GroundedError, NextCommand
from grounded.frozen import Array
from grounded.instruments.finding import DEGREES
from grounded.instruments.kinematics import Integral, integrals, over_steps, pieces
from grounded.model import Model
from grounded.trial import Trial

AHEAD = 0.25  # [s]
STARTS = 200
LARGE = 20.0  # times what the others do
SIMILAR = 3.0
BETTER = 0.9  # of the error with commands as they are, or a third, or three times as large
STAMPS = 1000.0
NEAR = 0.1  # relative, of these factors
TOGETHER = 0.95  # cosine of what a position moves and its velocity says, over the best window
TURNS = (2 * np.pi, 360.0)  # by which a wrapped angle jumps
LIKE = 10.0  # times as large, or as small: beside what corrected signals may be
MANY = 8  # trials that tell enough
LEAST = 8  # windows that a trial must hold
FAR = 1e9

Ratios = Sequence[tuple[Integral, float]]  # of a trial's positions, see `ratios_of`


@dataclass(frozen=True)
class Odd:
    """Signals of trial number `trial` that are `factor` times what they are in the others."""

    trial: int
    factor: float
    states: tuple[int, ...] = ()
    inputs: tuple[int, ...] = ()

    def mended(self, trial: Trial) -> Trial:
        """The trial in the unit of the others."""
        x, u = np.array(trial.states), np.array(trial.inputs)
        x[:, self.states] /= self.factor
        u[:, self.inputs] /= self.factor
        held = trial.start_inputs
        if held is not None:
            held = np.array(held)
            held[list(self.inputs)] /= self.factor
        return replace(trial, states=x, inputs=u, start_inputs=held)


def odd_states(
    model: Model, trials: Sequence[Trial], ratios: Sequence[Ratios], shown: Sequence[int]
) -> Iterator[Odd]:
    """Trials with states in degrees that are in radians in another trial, or divided like degrees.

    Args:
        model: however crude.
        trials: several.
        ratios: of each.
        shown: states that a sensor has, in every trial.

    Yields:
        A trial and its states, all of one factor.
    """
    units = list(model.states.values())
    angular = [i for i in shown if units[i] == "rad" or units[i].startswith("rad/")]
    if len(trials) < 2 or not angular:
        return
    single = [_one_state(trials, ratios, k) for k in range(len(trials))]
    size = [np.sqrt(np.nanmean(t.states[:, angular] ** 2, axis=0)) for t in trials]
    pushed = [size_of(t.inputs) for t in trials]
    error = [missed(model, trial, angular, shown) for trial in trials]
    for k, trial in enumerate(trials):
        if single[k] and not all(single):
            yield from single[k]
            continue
        rest = [j for j in range(len(trials)) if not (size[j] * LARGE > size[k]).any()]
        rest = [
            j for j in rest if 1 / SIMILAR < (pushed[k] + 1e-12) / (pushed[j] + 1e-12) < SIMILAR
        ]
        if not rest:
            continue
        odd = Odd(k, DEGREES, tuple(angular))
        usual = max(error[j] for j in rest)
        mended = missed(model, odd.mended(trial), angular, shown)
        if error[k] > LARGE * max(usual, mended) and mended < SIMILAR * usual:
            yield odd


def _one_state(trials: Sequence[Trial], ratios: Sequence[Ratios], k: int) -> list[Odd]:
    """The states of a trial that are in degrees, or divided so, beside a rate or a position."""
    found = []
    for at, (relation, ratio) in enumerate(ratios[k]):
        factor = next((f for f in (DEGREES, 1 / DEGREES) if abs(ratio / f - 1) < NEAR), None)
        if factor is None:
            continue
        sound = [
            t
            for t, one in zip(trials, ratios, strict=True)
            if len(one) == len(ratios[k]) and 1 / SIMILAR < one[at][1] < SIMILAR
        ]
        choice = [Odd(k, factor, (relation.i,)), Odd(k, 1 / factor, (relation.j,))]
        choice.sort(key=lambda odd: -odd.factor)  # degrees, where no other trial tells
        if sound:
            pair = [relation.i, relation.j]
            usual = np.median([spread(t, pair) for t in sound], axis=0)
            strange = [
                np.abs(np.log(spread(odd.mended(trials[k]), pair) / usual)).sum() for odd in choice
            ]
            choice = [choice[int(np.argmin(strange))]]
        found.append(choice[0])
    return found


def spread(trial: Trial, some: Sequence[int]) -> Array:
    """Standard deviations of some states (len(some),), in their units."""
    return np.asarray(np.nanstd(trial.states[:, some], axis=0) + 1e-300)


PREDICTED = 1.0  # of what the signals do: an error below that predicts them
FULL_TURNS = 4 * np.pi  # [rad] that an angle spans: degrees, or wheels, or a heading
SOON = 0.1  # [s] ahead: a body that a model lacks much of goes its own way later
CONCORDANT, PLAINLY = 0.1, 1.5  # concordance, and times that with other factors
WHOLE = 0.3  # concordance of each angle with what its rate says


def all_in_degrees(model: Model, trials: Sequence[Trial], shown: Sequence[int]) -> list[Odd]:
    """Of each trial the signals that are in degrees in all of them, by what the model makes of it.

    Args:
        model: whose errors fall below half where they are divided by 57.3, not far from that.
        trials: any.
        shown: states that a sensor has, in every trial.
    """
    units, inputs = list(model.states.values()), list(model.inputs.values())
    angles = tuple(i for i in shown if units[i] == "rad")
    sent = tuple(j for j, unit in enumerate(inputs) if unit == "rad")
    moving = tuple(i for i in shown if units[i] in ("rad", "rad/s"))
    some = trials[:: max(1, len(trials) // MANY)]

    def left(odd: Odd) -> Array:
        turned = [odd.mended(trial) for trial in some]
        unit = np.median([spread(t, shown) for t in turned], axis=0)
        return np.array([missed(model, t, shown, shown, unit) for t in turned])

    groups = dict.fromkeys([*((i,) for i in angles), angles, moving, ()])
    choices = [Odd(0, DEGREES, g, u) for g in groups for u in ((), sent) if g or u]
    errors = [float(np.median(left(odd))) for odd in choices]
    if not np.isfinite(errors).any():
        return []
    best = choices[int(np.nanargmin(errors))]
    mended, own = left(best), left(replace(best, factor=1.0))
    judges = mended < PREDICTED  # a trial that no model predicts tells nothing
    near = [left(replace(best, factor=f * DEGREES)) for f in (1 / LIKE, LIKE)]
    told = judges.any() and all(
        np.median(mended[judges] / other[judges]) < 1 for other in (own / 2, *near)
    )
    if not told and angles:
        best = Odd(0, DEGREES, moving)
        told = _turning_as_degrees(model, some, shown, best)
    return [replace(best, trial=k) for k in range(len(trials))] if told else []


def _turning_as_degrees(
    model: Model, trials: Sequence[Trial], shown: Sequence[int], odd: Odd
) -> bool:
    """Whether angles beyond full turns turn as a model says that is crude, were they degrees.

    A payload and friction that a model lacks can make its errors larger than all that moves. Still
    what it predicts goes with what happened, and is about as large, of no angles but the right
    ones: sines of others are noise, and pushes on them are too weak, or too strong.
    """
    units = list(model.states.values())
    angles = [i for i in odd.states if units[i] == "rad"]
    wide = [
        np.nanmax(x, axis=0) - np.nanmin(x, axis=0) for t in trials if len(x := t.states[:, angles])
    ]
    if max((float(one.max()) for one in wide), default=0.0) < FULL_TURNS:
        return False
    going = [r.i for r in integrals(model) if r.exact and {r.i, r.j} <= set(shown)]
    driven = [i for i in shown if i not in going]

    def concord(factor: float, some: Sequence[int] = driven) -> float:
        mended = [replace(odd, factor=factor).mended(t) for t in trials]
        return float(np.median([_concordance(model, t, shown, some) for t in mended]))

    own = [concord(DEGREES, [i]) for i in going if i in angles]
    if min(own, default=0.0) < WHOLE:  # one that its rate does not move is not in its unit
        return False
    mended = concord(DEGREES)
    others = [concord(factor) for factor in (1.0, DEGREES / LIKE, DEGREES * LIKE)]
    return mended > CONCORDANT and all(mended > PLAINLY * other for other in others)


def _concordance(model: Model, trial: Trial, shown: Sequence[int], some: Sequence[int]) -> float:
    """Of what the states `some` do in a moment with what is predicted (Lin 1989), their mean."""
    if not some or (ahead := predicted(model, trial, shown, SOON)) is None:
        return 0.0
    start, x, logged = ahead
    said, moved = (model.difference(to, start)[:, some] for to in (x, logged))
    both = said.var(axis=0) + moved.var(axis=0) + (said - moved).mean(axis=0) ** 2 + 1e-300
    return float((1 - ((said - moved) ** 2).mean(axis=0) / both).mean())


def odd_commands(model: Model, trials: Sequence[Trial], shown: Sequence[int]) -> Iterator[Odd]:
    """Trials with an input in thousandths, or in degrees, of its unit in other trials.

    Args:
        model: however crude.
        trials: several, their states in the model's units.
        shown: states that a sensor has, in every trial.

    Yields:
        A trial and an input.
    """
    if len(trials) < 2 or not shown:
        return
    unit = np.mean([spread(t, shown) for t in trials], axis=0)
    size = np.array([np.sqrt(np.nanmean(t.inputs**2, axis=0)) for t in trials])

    def left(trial: Trial) -> float:
        return missed(model, trial, shown, shown, unit)

    for j, measure in enumerate(model.inputs.values()):
        factors = (STAMPS, 1 / STAMPS, *((DEGREES, 1 / DEGREES) if measure == "rad" else ()))
        for k, factor in ((k, f) for k in range(len(trials)) for f in factors):
            apart = size[k, j] / size[:, j] if factor > 1 else size[:, j] / size[k, j]
            rest = [t for t, one in zip(trials, apart > LARGE, strict=True) if one]
            like = size[k, j] / factor / np.median(size[apart > LARGE, j]) if rest else 0.0
            if not 1 / LIKE < like < LIKE:
                continue
            odd = Odd(k, factor, inputs=(j,))
            mended = left(odd.mended(trials[k]))
            wrong = [replace(odd, factor=f) for f in (factor / SIMILAR, factor * SIMILAR)]
            others = [left(one.mended(trials[k])) for one in wrong]
            sound = mended < SIMILAR * float(np.median([left(t) for t in rest]))
            if sound and mended < BETTER * min(left(trials[k]), *others):
                yield odd


def missed(
    model: Model, trial: Trial, some: Sequence[int], shown: Sequence[int], unit: Array | float = 1.0
) -> float:
    """Rms error of predictions a quarter of a second ahead, of the states `some` together."""
    if (ahead := predicted(model, trial, shown)) is None:
        return float("nan")
    _, x, logged = ahead
    return size_of(model.difference(x, logged)[:, some] / unit)


def predicted(
    model: Model, trial: Trial, shown: Sequence[int], horizon: float = AHEAD
) -> tuple[Array, Array, Array] | None:
    """Logged states (N, n), what the model makes of them by a horizon [s], those logged then.

    None where too little is known. States that are not `shown` are taken for 0.
    """
    steps = max(1, round(horizon / trial.dt))
    logged = np.array(trial.states)
    logged[:, [i for i in range(model.n) if i not in shown]] = 0.0  # nobody knows
    good = np.asarray(np.isfinite(logged).all(axis=1))
    at = np.flatnonzero(good[:-steps] & good[steps:])
    if len(at) < 5:
        return None
    at = at[:: max(1, len(at) // STARTS)]
    x = logged[at]
    for j in range(steps):
        x = model.system.step(x, trial.inputs[at + j], model.values, trial.dt)
        x = np.fmax(np.fmin(x, FAR), -FAR)
    return logged[at], x, logged[at + steps]


def judge_stamps(model: Model, trials: Sequence[Trial], ratios: Sequence[Ratios]) -> None:
    """Stops at a trial whose stamps are in milliseconds, or were taken for such.

    Where all positions are lengths they may be in mm as well: the stamps it is then only where they
    and their velocities are as large as in sound trials.

    Args:
        model: however crude.
        trials: any.
        ratios: of each.

    Raises:
        GroundedError: with the trial, a state and the factor.
    """
    for k, (trial, every) in enumerate(zip(trials, ratios, strict=True)):
        if (found := slow_or_fast(model, every)) is None:
            continue
        relation, ratio = found
        if model.states[model.state_names[relation.i]] == "m":
            some = sorted({i for r, _ in every for i in (r.i, r.j)})
            sound = [t for t, one in zip(trials, ratios, strict=True) if _sound(one)]
            if not sound:
                continue
            apart = spread(trial, some) / np.median([spread(t, some) for t in sound], axis=0)
            if max(apart.max(), 1 / apart.min()) > np.sqrt(STAMPS):
                continue
        q, w = (model.state_names[i] for i in (relation.i, relation.j))
        name = trial.id or f"number {k + 1}"
        raise GroundedError(
            f"trial {name}: {q} moves {ratio:.3g} times as fast as {w} says, so the "
            "stamps of its log are in another unit (milliseconds, not seconds): correct "
            "them and take it in again, without this one",
            then=NextCommand("discard", (trial.id,)) if trial.id else None,
        )


def slow_or_fast(model: Model, every: Ratios) -> tuple[Integral, float] | None:
    """A position that moves a thousand times as fast as it should, or as slowly, as all do.

    One whose unit is not m is taken if there is one.
    """
    found = [one for one in every if one[0].exact]
    for factor in (STAMPS, 1 / STAMPS):
        if found and all(abs(ratio / factor - 1) < NEAR for _, ratio in found):
            units = list(model.states.values())
            return min(found, key=lambda one: units[one[0].i] == "m")
    return None


def _sound(every: Ratios) -> bool:
    """Whether positions move as their velocities say."""
    found = [ratio for relation, ratio in every if relation.exact]
    return bool(found) and all(1 / SIMILAR < ratio < SIMILAR for ratio in found)


def ratios_of(model: Model, trials: Sequence[Trial], shown: Sequence[int]) -> list[Ratios]:
    """Of each trial, the rate of each position over what its velocity says; 1 where they differ."""
    relations = [one for one in integrals(model) if {one.i, one.j} <= set(shown)]
    return [_ratios(relations, trial) for trial in trials]


def _ratios(relations: Sequence[Integral], trial: Trial) -> Ratios:
    """Over the window in which they agree best: a position's noise is small beside a long way."""
    found = []
    for relation in relations:
        some = [
            (_unturned(x[:, 0])[1:-1], np.cumsum([0.0, *over_steps(relation.c * x[:, 1])]))
            for x in pieces([trial], (relation.i, relation.j))
        ]
        best, ratio, steps = TOGETHER, 1.0, 1
        while usable := [pair for pair in some if len(pair[0]) > LEAST * steps]:
            parts = [[z[steps:] - z[:-steps] for z in pair] for pair in usable]
            moved, said = (np.concatenate(z) for z in zip(*parts, strict=True))
            same = abs(moved @ said) / max(size_of(moved) * size_of(said) * len(said), 1e-300)
            if same > best:
                best, ratio = same, size_of(moved) / (size_of(said) * trial.dt)
            steps *= 2
        if some:
            found.append((relation, ratio))
    return found


def _unturned(q: Array) -> Array:
    """Without the jumps of a wrapped angle."""
    steps = np.diff(q)
    for turn in TURNS:
        jumps = np.abs(np.abs(steps) - turn) < 0.1 * turn
        if np.median(np.abs(steps)) < 0.05 * turn:
            steps -= np.where(jumps, np.sign(steps) * turn, 0.0)
    return np.concatenate([[q[0]], q[0] + np.cumsum(steps)])


def size_of(x: Array) -> float:
    """Root mean square of what is known of x, of any shape; 0 where it is empty."""
    return float(np.sqrt(np.nanmean(x**2))) if x.size else 0.0
