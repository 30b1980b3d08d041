"""Detect positions and velocities in units that don't match, such as mm beside m/s.

If time stamps are in milliseconds, every position moves a thousand times as fast as its velocity
says (`judge_stamps`). If one signal is in another unit, its ratio is a power of ten that no physics
causes. Which of the two is off does not follow from the ratio. It follows from the sizes in other
trials that are in the model's units; without such trials, from how well the model predicts the
velocity with either one corrected; otherwise the larger is named first, since logs are more often
in mm than in km. Nothing is corrected here: the factor belongs in [log], where feedback and
utilities use it too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from grounded.errors import GroundedError, NextCommand
from grounded.frozen import Array
from grounded.instruments.finding import unusable
from grounded.instruments.predictions.short_runs import AHEAD, missed, predicted, size_of
from grounded.instruments.units.odd_trial import (
    NEAR,
    SIMILAR,
    STAMPS,
    Odd,
    Ratios,
    ratios_of,
    spread,
)
from grounded.model import Model
from grounded.places import Integral
from grounded.trial import Trial

MILLION = STAMPS**2  # mm for m, and multiplied by a thousand instead of divided
FACTORS = (MILLION, STAMPS, 100.0, 0.01, 1 / STAMPS, 1 / MILLION)  # position rate over velocity
MEND = "Multiply the scale in [log] (a missing scale is 1), or correct the log"
TOLD = 0.5  # of the velocity's change, and of the other's error: below it the model explains it
ALIKE = 30.0  # factor within which a crude model predicts the size of a change
PREFIXES = {1000.0: "m", 100.0: "c"}
SINGLE = ("m", "rad", "V", "A", "N")  # units that take a prefix


@dataclass(frozen=True)
class _Off:
    """The rate of a position is `factor` times its velocity in some trials."""

    relation: Integral
    factor: float
    trials: tuple[int, ...]
    sound: tuple[int, ...]  # trials in which they agree

    @property
    def choices(self) -> tuple[Odd, Odd]:
        """The two possible faults, too large before too small."""
        k, i, j = self.trials[0], self.relation.i, self.relation.j
        both = Odd(k, self.factor, (i,)), Odd(k, 1 / self.factor, (j,))
        return both if self.factor > 1 else (both[1], both[0])


def judge_units(
    model: Model, trials: Sequence[Trial], ratios: Sequence[Ratios], shown: Sequence[int]
) -> None:
    """Raise an error if a position or a velocity is a hundred or a thousand times too large.

    Args:
        model: however crude.
        trials: of this model's states.
        ratios: of each trial, see `odd_trial.ratios_of`.
        shown: indices of the states with a sensor.

    Raises:
        GroundedError: naming the trials, the states, the likely fault and the scale that corrects
            it.
    """
    found = list(_found(ratios))
    if not found:
        return
    in_log, in_program = (
        "; ".join(_clause(model, trials, ratios, one, found, shown, log=log) for one in found)
        for log in (True, False)
    )
    odd = sorted({k for one in found for k in one.trials})
    raise unusable(trials, odd, in_log, MEND, in_program)


def units_apart(model: Model, trial: Trial, shown: Sequence[int]) -> list[str]:
    """Return a clause for each position and velocity of one trial whose units don't match.

    Args:
        model: however crude.
        trial: without gaps.
        shown: indices of the states with a sensor.
    """
    ratios = ratios_of(model, [trial], shown)
    found = list(_found(ratios))
    return [_clause(model, [trial], ratios, one, found, shown) for one in found]


def _found(ratios: Sequence[Ratios]) -> Iterator[_Off]:
    """Yield each relation and factor, with the trials that have it."""
    relations = {relation for every in ratios for relation, _ in every if relation.exact}
    for relation in sorted(relations, key=lambda r: (r.i, r.j)):
        known = {k: dict(every).get(relation, np.nan) for k, every in enumerate(ratios)}
        sound = tuple(k for k, ratio in known.items() if 1 / SIMILAR < ratio < SIMILAR)
        for factor in FACTORS:
            odd = tuple(k for k, ratio in known.items() if abs(ratio / factor - 1) < NEAR)
            if odd:
                yield _Off(relation, factor, odd, sound)


def _clause(
    model: Model,
    trials: Sequence[Trial],
    ratios: Sequence[Ratios],
    one: _Off,
    found: Sequence[_Off],
    shown: Sequence[int],
    *,
    log: bool = True,
) -> str:
    """Return one clause: the ratio, the likeliest fault, and other possible ones."""
    names = model.state_names
    ratio = dict(ratios[one.trials[0]])[one.relation]
    first, second = _ranked(model, trials, one, found, shown)
    text = (
        f"{names[one.relation.i]} moves {ratio:.4g} times as fast as {names[one.relation.j]} says: "
        f"{described(model, first.states[0], first.factor, log=log)}"
    )
    if not (one.sound or _clear(model, trials[one.trials[0]], one, shown, first, second)):
        text += f", or else {described(model, second.states[0], second.factor, log=log)}"
        if slow_or_fast(model, ratios[one.trials[0]]) is not None:
            text += ", or the time stamps are in milliseconds" if one.factor < 1 else ""
            text += ", or the time stamps were taken for milliseconds" if one.factor > 1 else ""
    return text


def _ranked(
    model: Model,
    trials: Sequence[Trial],
    one: _Off,
    found: Sequence[_Off],
    shown: Sequence[int],
) -> tuple[Odd, Odd]:
    """Return the two possible faults, likeliest first."""
    a, b = one.choices
    pair = [one.relation.i, one.relation.j]
    odd = trials[one.trials[0]]
    if one.sound:
        usual = np.median([spread(trials[k], pair) for k in one.sound], axis=0)
        strange = [np.abs(np.log(spread(c.mended(odd), pair) / usual)).sum() for c in (a, b)]
        return (a, b) if strange[0] <= strange[1] else (b, a)
    votes = [sum(c.states[0] in (r.relation.i, r.relation.j) for r in found) for c in (a, b)]
    if votes[0] != votes[1]:  # a velocity that is the position of another relation
        return (a, b) if votes[0] > votes[1] else (b, a)
    swap = _explains(model, odd, one, shown, b, a) or _clear(model, odd, one, shown, b, a)
    return (b, a) if swap else (a, b)


def _explains(
    model: Model, trial: Trial, one: _Off, shown: Sequence[int], first: Odd, second: Odd
) -> bool:
    """Check whether the model predicts the velocity with the first corrected, not the second."""
    j = one.relation.j
    a, b = (_unexplained(model, odd.mended(trial), j, shown) for odd in (first, second))
    return a < TOLD and a < TOLD * b


def _clear(
    model: Model, trial: Trial, one: _Off, shown: Sequence[int], first: Odd, second: Odd
) -> bool:
    """Check whether the model clearly favours the first fault; only for factors beyond 1000.

    Either it predicts the velocity with the first one corrected; or, however crude, it predicts a
    change of about the logged size then, and of a quite different size with the second corrected.
    """
    if max(one.factor, 1 / one.factor) <= STAMPS:
        return False
    if _explains(model, trial, one, shown, first, second):
        return True
    a, b = (_off_by(model, odd.mended(trial), one.relation.j, shown) for odd in (first, second))
    return a < ALIKE < STAMPS < b


def _off_by(model: Model, trial: Trial, j: int, shown: Sequence[int]) -> float:
    """Return the factor (1 or more) by which a model's change of a velocity is off in size."""
    if (ahead := predicted(model, trial, shown)) is None:
        return float("nan")
    start, then, logged = ahead
    made, seen = (size_of(model.difference(x, start)[:, [j]]) for x in (then, logged))
    if not (made > 0 and seen > 0):
        return np.inf if made != seen else np.nan
    return max(made / seen, seen / made)


def _unexplained(model: Model, trial: Trial, j: int, shown: Sequence[int]) -> float:
    """Return the model's prediction error of a velocity, relative to how far that changes."""
    steps = max(1, round(AHEAD / trial.dt))
    x: Array = trial.states[:, j]
    change = size_of(x[steps:] - x[:-steps])
    return missed(model, trial, [j], shown) / change if change > 0 else np.inf


def described(model: Model, i: int, factor: float, *, log: bool = True) -> str:
    """Return a clause on a state that looks `factor` times too large, with the correction.

    Args:
        model: with the state's name and unit.
        i: index of the state.
        factor: by which it looks too large.
        log: whether to name the key of [log] that corrects it, not only the factor.
    """
    name = model.state_names[i]
    size = max(factor, 1 / factor)
    base, _, per = model.states[name].partition("/")
    prefix = PREFIXES.get(factor, "") if base in SINGLE else ""
    unit = f" (in {prefix}{base}{'/' * bool(per)}{per})" if prefix else ""
    text = f"{size:g} times too {'large' if factor > 1 else 'small'}{unit}"
    if not log:
        return f"{name} looks {text} (multiply it by {1 / factor:g})"
    return f"{name} looks {text}, corrected by [log.state.{name}] scale = {1 / factor:g}"


def judge_stamps(model: Model, trials: Sequence[Trial], ratios: Sequence[Ratios]) -> None:
    """Raise an error if a trial's stamps are in milliseconds, or were read as milliseconds.

    If all positions are lengths, they may be in mm instead. Then the stamps are blamed only if
    positions and velocities are as large as in sound trials.

    Args:
        model: however crude.
        trials: of this model's states.
        ratios: of each trial, see `odd_trial.ratios_of`.

    Raises:
        GroundedError: naming the trial, a state and the factor.
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
            "stamps of its log are in another unit (milliseconds instead of seconds): "
            "correct them, discard this trial and ingest the log again",
            then=NextCommand("discard", (trial.id,)) if trial.id else None,
        )


def slow_or_fast(model: Model, every: Ratios) -> tuple[Integral, float] | None:
    """Return a position and its ratio if all positions move 1000 times too fast or too slowly.

    A position whose unit is not m is preferred.
    """
    found = [one for one in every if one[0].exact]
    for factor in (STAMPS, 1 / STAMPS):
        if found and all(abs(ratio / factor - 1) < NEAR for _, ratio in found):
            units = list(model.states.values())
            return min(found, key=lambda one: units[one[0].i] == "m")
    return None


def _sound(every: Ratios) -> bool:
    """Check whether positions move as their velocities imply."""
    found = [ratio for relation, ratio in every if relation.exact]
    return bool(found) and all(1 / SIMILAR < ratio < SIMILAR for ratio in found)
