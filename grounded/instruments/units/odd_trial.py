"""Find trials in other units than the rest: degrees for radians, thousandths of a command.

If one state of a trial is in degrees, the rate of a position is a constant multiple of the velocity
(`ratios_of`); the sizes in sound trials show which of the two is off. If all angles and their rates
are in degrees, they agree with each other. Commands of the usual size then seem to move the body
tens of times as far, and the model's error is tens of times as large; divided by 57.3 it is as in
the other trials. Commands in thousandths are tens of times smaller than in other trials, and the
model predicts the motion with a thousand times as much, but not with a third or three times of
that.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.frozen import Array
from grounded.instruments.finding import DEGREES
from grounded.instruments.kinematics.relations import over_steps, pieces
from grounded.instruments.predictions.short_runs import Ahead, missed, predicted, size_of
from grounded.model import Model
from grounded.places import Integral, integrals
from grounded.trial import Trial

LARGE = 20.0  # times as large as in other trials
SIMILAR = 3.0  # within this factor sizes count as similar
BETTER = 0.9  # of the error with the commands as logged, or a third or three times the corrected
STAMPS = 1000.0  # factor between time stamps in milliseconds and in seconds
NEAR = 0.1  # relative tolerance of these factors
LIKE = 10.0  # factor within which corrected commands must match those of other trials
MANY = 8  # number of trials examined
PREDICTED = 1.0  # error relative to the motion, below which a prediction is informative
FULL_TURNS = 4 * np.pi  # [rad] range of an angle that suggests degrees (or a wheel, or a heading)
SOON = 0.1  # [s] horizon: a very crude model soon diverges
CONCORDANT, PLAINLY = 0.1, 1.5  # least concordance, and factor by which it must exceed others
SMALL = 1.0  # [rad] angles that stay below it are not in degrees
SEEN = 0.5  # of a motion: a prediction that misses by less sees it
FEW, CLEAR = 120, 1.0  # samples of a trial to predict from, and gain [nats] of the calibrated model
WHOLE = 0.3  # least concordance of each angle with the motion by its rate
TOGETHER = 0.95  # cosine between displacements by position and by velocity, in the best window
TURNS = (2 * np.pi, 360.0)  # jumps of a wrapped angle
LEAST = 8  # windows that a trial must hold

Ratios = Sequence[tuple[Integral, float]]  # of a trial's positions, see `ratios_of`


def ratios_of(model: Model, trials: Sequence[Trial], shown: Sequence[int]) -> list[Ratios]:
    """Return for each trial the rate of each position over its velocity.

    The ratio is 1 where the two do not correlate, and no ratio can be given.
    """
    relations = [one for one in integrals(model) if {one.i, one.j} <= set(shown)]
    return [_ratios(relations, trial) for trial in trials]


def _ratios(relations: Sequence[Integral], trial: Trial) -> Ratios:
    """Return the ratios over the window with the best agreement; longer ones suppress noise."""
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
    """Remove the jumps of a wrapped angle."""
    steps = np.diff(q)
    for turn in TURNS:
        jumps = np.abs(np.abs(steps) - turn) < 0.1 * turn
        if np.median(np.abs(steps)) < 0.05 * turn:
            steps -= np.where(jumps, np.sign(steps) * turn, 0.0)
    return np.concatenate([[q[0]], q[0] + np.cumsum(steps)])


def spread(trial: Trial, some: Sequence[int]) -> Array:
    """Return the standard deviations of some states (len(some),), in their units."""
    return np.asarray(np.nanstd(trial.states[:, some], axis=0) + 1e-300)


@dataclass(frozen=True)
class Odd:
    """Signals of trial number `trial` that are `factor` times as large as in the other trials."""

    trial: int
    factor: float
    states: tuple[int, ...] = ()
    inputs: tuple[int, ...] = ()

    def mended(self, trial: Trial) -> Trial:
        """Return the trial in the unit of the others."""
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
    """Yield trials with states off by the factor between degrees and radians, either way.

    Args:
        model: however crude.
        trials: several.
        ratios: of each trial, see `ratios_of`.
        shown: indices of the states with a sensor in every trial.

    Yields:
        A trial and its states that share a factor.
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
    """Return the states of a trial that are off by 57.3 against their rate or position."""
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
        choice.sort(key=lambda odd: -odd.factor)  # degrees, if no other trial shows which
        if sound:
            pair = [relation.i, relation.j]
            usual = np.median([spread(t, pair) for t in sound], axis=0)
            strange = [
                np.abs(np.log(spread(odd.mended(trials[k]), pair) / usual)).sum() for odd in choice
            ]
            choice = [choice[int(np.argmin(strange))]]
        found.append(choice[0])
    return found


def all_in_degrees(model: Model, trials: Sequence[Trial], shown: Sequence[int]) -> list[Odd]:
    """Return the signals that are in degrees in all trials, one `Odd` per trial; else [].

    They are found by the model: dividing by 57.3 must at least halve its errors, and factors far
    from that must not do better. A model that can't predict the body is calibrated first.

    Args:
        model: however crude.
        trials: of this model's states.
        shown: indices of the states with a sensor in every trial.
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
    judges = mended < PREDICTED  # a trial that the model can't predict is not informative
    near = [left(replace(best, factor=f * DEGREES)) for f in (1 / LIKE, LIKE)]
    told = judges.any() and all(
        np.median(mended[judges] / other[judges]) < 1 for other in (own / 2, *near)
    )
    if not told and angles:
        best = Odd(0, DEGREES, moving)
        told = _turning_as_degrees(model, some, shown, best) or (
            model.m > 0 and all(_calibrated_as_degrees(model, t, shown, best) for t in some)
        )
    return [replace(best, trial=k) for k in range(len(trials))] if told else []


def _turning_as_degrees(
    model: Model, trials: Sequence[Trial], shown: Sequence[int], odd: Odd
) -> bool:
    """Check whether angles that span full turns follow the model if they are taken as degrees.

    An unmodelled payload or friction can make the model's errors larger than the motion. Even then
    its predictions correlate with the motion, and have about its size, only if the unit is right:
    with a wrong unit the sines of the angles are noise, and the effect of inputs on them is far too
    weak or too strong.
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
    if min(own, default=0.0) < WHOLE:  # an angle that does not follow its rate is in another unit
        return False
    mended = concord(DEGREES)
    others = [concord(factor) for factor in (1.0, DEGREES / LIKE, DEGREES * LIKE)]
    return mended > CONCORDANT and all(mended > PLAINLY * other for other in others)


def _calibrated_as_degrees(model: Model, trial: Trial, shown: Sequence[int], odd: Odd) -> bool:
    """Check whether a calibrated model predicts a trial far better with its angles as degrees.

    A crude model of an unstable body errs by more than the body moves, in any unit. Where all is
    linear, inputs of another strength explain the log as well as degrees do: that strength must
    then be about 57.3 times the model's.
    """
    units, usual = list(model.states.values()), np.ones(model.m)
    angles = np.abs(trial.states[:, [i for i in odd.states if units[i] == "rad"]])
    if not (angles > SMALL).any() or not np.isfinite(trial.inputs).all():
        return False
    with np.errstate(all="ignore"):
        logged, mended = (Ahead(model, t, shown, FEW) for t in (trial, odd.mended(trial)))
        if not (logged.enough and mended.enough):
            return False
        rms = mended.best([usual], free=False).rms
        rms[list(odd.states)] *= odd.factor  # as large as in the log
        if not np.log(logged.plain(usual).rms / rms).sum() > CLEAR:
            return False  # calibrated, the errors of the log are smaller still
        gained = np.log(logged.best([usual], free=False).rms / rms)
        most = int(gained.argmax())
        if not rms[most] < SEEN * logged.moved[most]:  # no unit makes the log predictable
            return False
        if not (gained.sum() > CLEAR and gained[most] > np.log(2.0)):
            return False
        free = logged.best([usual])
    strong = (free.gains > odd.factor / LIKE) & (free.gains < odd.factor * LIKE)
    return bool(strong.all() or not free.score - np.log(rms).sum() < CLEAR)


def _concordance(model: Model, trial: Trial, shown: Sequence[int], some: Sequence[int]) -> float:
    """Return the mean concordance (Lin 1989) of predicted and logged changes of some states."""
    if not some or (ahead := predicted(model, trial, shown, SOON)) is None:
        return 0.0
    start, x, logged = ahead
    said, moved = (model.difference(to, start)[:, some] for to in (x, logged))
    both = said.var(axis=0) + moved.var(axis=0) + (said - moved).mean(axis=0) ** 2 + 1e-300
    return float((1 - ((said - moved) ** 2).mean(axis=0) / both).mean())


def odd_commands(model: Model, trials: Sequence[Trial], shown: Sequence[int]) -> Iterator[Odd]:
    """Yield trials with an input off by 1000 or 57.3 against the other trials.

    Args:
        model: however crude.
        trials: several, their states in the model's units.
        shown: indices of the states with a sensor in every trial.

    Yields:
        A trial and one of its inputs.
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
