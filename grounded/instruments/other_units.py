"""A position in mm beside a velocity in m/s: their ratio is a unit's, which no physics makes.

Which of the two is off can't be read off them. Where trials in the model's units are among the
others, sizes there tell it; else what the model makes of the velocity with either mended; else the
larger is taken first, since logs have mm rather than km. What is found is never put right here: a
sensor's factor of a thousand belongs into [log], where feedback and utilities see it too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from grounded.errors import GroundedError, NextCommand
from grounded.frozen import Array
from grounded.instruments.kinematics import Integral
from grounded.instruments.odd_trial import (
    AHEAD,
    NEAR,
    SIMILAR,
    STAMPS,
    Odd,
    Ratios,
    missed,
    predicted,
    ratios_of,
    size_of,
    slow_or_fast,
    spread,
)
from grounded.model import Model
from grounded.trial import Trial

MILLION = STAMPS**2  # mm for m, multiplied by a thousand once more
FACTORS = (MILLION, STAMPS, 100.0, 0.01, 1 / STAMPS, 1 / MILLION)  # rates by velocities
MEND = "Multiply the scale in [log] (1 where none is given), or correct the log"
TOLD = 0.5  # of how far a velocity changes, and of the other's error: a model that explains it
ALIKE = 30.0  # times as large, or as small, as a crude model makes a change
PREFIXES = {1000.0: "m", 100.0: "c"}
SINGLE = ("m", "rad", "V", "A", "N")  # units that are written with a prefix


@dataclass(frozen=True)
class _Off:
    """The rate of a position is `factor` times its velocity in some trials."""

    relation: Integral
    factor: float
    trials: tuple[int, ...]
    sound: tuple[int, ...]  # trials in which they agree

    @property
    def choices(self) -> tuple[Odd, Odd]:
        """What may be off, the larger first."""
        k, i, j = self.trials[0], self.relation.i, self.relation.j
        both = Odd(k, self.factor, (i,)), Odd(k, 1 / self.factor, (j,))
        return both if self.factor > 1 else (both[1], both[0])


def judge_units(
    model: Model, trials: Sequence[Trial], ratios: Sequence[Ratios], shown: Sequence[int]
) -> None:
    """Stops at a position and a velocity of which one is a hundred or a thousand times too large.

    Args:
        model: however crude.
        trials: any.
        ratios: of each, see `odd_trial.ratios_of`.
        shown: states that a sensor has.

    Raises:
        GroundedError: with the trials, the states, what may be off and the scale that mends it.
    """
    found = list(_found(ratios))
    if not found:
        return
    clauses = [_clause(model, trials, ratios, one, found, shown) for one in found]
    odd = sorted({k for one in found for k in one.trials})
    raise unusable(trials, odd, "; ".join(clauses), MEND)


def units_apart(model: Model, trial: Trial, shown: Sequence[int]) -> list[str]:
    """What one trial says of that by itself, a clause for each position and velocity.

    Args:
        model: however crude.
        trial: without gaps.
        shown: states that a sensor has.
    """
    ratios = ratios_of(model, [trial], shown)
    found = list(_found(ratios))
    return [_clause(model, [trial], ratios, one, found, shown) for one in found]


def unusable(trials: Sequence[Trial], odd: Sequence[int], clauses: str, mend: str) -> GroundedError:
    """That nothing can be said before some trials are taken in again, and the command for it.

    Args:
        trials: all of them.
        odd: the numbers of those that are concerned.
        clauses: what is wrong there.
        mend: what to do about it, before the log is taken in again.
    """
    names = [trials[k].id or f"number {k + 1}" for k in odd]
    one, every = len(odd) == 1, len(odd) == len(trials) > 1
    where = "in every trial" if every else f"in trial{'s' * (not one)} {', '.join(names)}"
    return GroundedError(
        f"{where} {clauses}. {mend}, and take it in again, without "
        f"{'this one' if one else 'these'}",
        then=NextCommand("discard", tuple(names)) if trials[0].id else None,
    )


def _found(ratios: Sequence[Ratios]) -> Iterator[_Off]:
    """Each relation and factor, with the trials that have it."""
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
) -> str:
    """What is seen, what it looks like, and what else it may be."""
    names = model.state_names
    ratio = dict(ratios[one.trials[0]])[one.relation]
    first, second = _ranked(model, trials, one, found, shown)
    text = (
        f"{names[one.relation.i]} moves {ratio:.4g} times as fast as {names[one.relation.j]} says: "
        f"{described(model, first.states[0], first.factor)}"
    )
    if not (one.sound or _clear(model, trials[one.trials[0]], one, shown, first, second)):
        text += f", or else {described(model, second.states[0], second.factor)}"
        if slow_or_fast(model, ratios[one.trials[0]]) is not None:
            text += ", or the stamps are in milliseconds" if one.factor < 1 else ""
            text += ", or the stamps were taken for milliseconds" if one.factor > 1 else ""
    return text


def _ranked(
    model: Model,
    trials: Sequence[Trial],
    one: _Off,
    found: Sequence[_Off],
    shown: Sequence[int],
) -> tuple[Odd, Odd]:
    """What may be off, the likelier first."""
    a, b = one.choices
    pair = [one.relation.i, one.relation.j]
    odd = trials[one.trials[0]]
    if one.sound:
        usual = np.median([spread(trials[k], pair) for k in one.sound], axis=0)
        strange = [np.abs(np.log(spread(c.mended(odd), pair) / usual)).sum() for c in (a, b)]
        return (a, b) if strange[0] <= strange[1] else (b, a)
    votes = [sum(c.states[0] in (r.relation.i, r.relation.j) for r in found) for c in (a, b)]
    if votes[0] != votes[1]:  # a velocity that is the position of another
        return (a, b) if votes[0] > votes[1] else (b, a)
    swap = _explains(model, odd, one, shown, b, a) or _clear(model, odd, one, shown, b, a)
    return (b, a) if swap else (a, b)


def _explains(
    model: Model, trial: Trial, one: _Off, shown: Sequence[int], first: Odd, second: Odd
) -> bool:
    """Whether the model explains the velocity with the first mended, and not with the second."""
    j = one.relation.j
    a, b = (_unexplained(model, odd.mended(trial), j, shown) for odd in (first, second))
    return a < TOLD and a < TOLD * b


def _clear(
    model: Model, trial: Trial, one: _Off, shown: Sequence[int], first: Odd, second: Odd
) -> bool:
    """Whether the model says which of the two it is: of factors that no common unit is apart by.

    It explains the velocity with the first mended. Or, however crude, it makes about as large a
    change of it as was logged, and one that is not comparable with the second mended in its place.
    """
    if max(one.factor, 1 / one.factor) <= STAMPS:
        return False
    if _explains(model, trial, one, shown, first, second):
        return True
    a, b = (_off_by(model, odd.mended(trial), one.relation.j, shown) for odd in (first, second))
    return a < ALIKE < STAMPS < b


def _off_by(model: Model, trial: Trial, j: int, shown: Sequence[int]) -> float:
    """How many times too large, or too small, a model's change of a velocity is."""
    if (ahead := predicted(model, trial, shown)) is None:
        return float("nan")
    start, then, logged = ahead
    made, seen = (size_of(model.difference(x, start)[:, [j]]) for x in (then, logged))
    if not (made > 0 and seen > 0):
        return np.inf if made != seen else np.nan
    return max(made / seen, seen / made)


def _unexplained(model: Model, trial: Trial, j: int, shown: Sequence[int]) -> float:
    """What the model misses a velocity by, over how far that changes meanwhile."""
    steps = max(1, round(AHEAD / trial.dt))
    x: Array = trial.states[:, j]
    change = size_of(x[steps:] - x[:-steps])
    return missed(model, trial, [j], shown) / change if change > 0 else np.inf


def described(model: Model, i: int, factor: float) -> str:
    """One state as it seems to be logged, `factor` times too large, and the scale for it."""
    name = model.state_names[i]
    size = max(factor, 1 / factor)
    base, _, per = model.states[name].partition("/")
    prefix = PREFIXES.get(factor, "") if base in SINGLE else ""
    unit = f" (in {prefix}{base}{'/' * bool(per)}{per})" if prefix else ""
    text = f"{size:g} times too {'large' if factor > 1 else 'small'}{unit}"
    return f"{name} looks {text}, [log.state.{name}] scale = {1 / factor:g}"
