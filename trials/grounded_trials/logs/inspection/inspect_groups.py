"""Assign the log's positions with their rates to the model's, where names don't decide.

A trolley and the load below it both have a position and a rate that follows it, so derivatives
can't tell them apart: they are right or wrong together. All assignments are tried. With each, the
calibrated model predicts the log a quarter of a second ahead (`short_runs`). An assignment is
accepted if its error is clearly smaller than that of every other and its units fit; otherwise all
of them stay unsure, with the alternatives listed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import islice, permutations, product

import numpy as np

from grounded.accounts.judge import CLEAR, HALF
from grounded.accounts.motion import Ahead
from grounded.frozen import Array
from grounded.model import Model
from grounded.trial import Trial
from grounded_trials.logs.inspection.inspect_guess import Guess
from grounded_trials.logs.inspection.inspect_pairs import COMBINATIONS, Signals, rates_in
from grounded_trials.logs.stated_units import factor_between, may_be

STARTS = 120  # samples to predict from
MANY = 16  # largest number of signals among which positions and rates are sought
Pair = tuple[str, str]  # a position and its rate: names, or paths
Way = tuple[Pair, ...]  # the paths of each pair of states, in order


def by_groups(
    model: Model,
    guesses: Mapping[str, Guess],
    pairs: Sequence[Pair],
    signals: Signals,
    joints: Mapping[str, str],
) -> dict[str, Guess]:
    """Assign positions and rates without matching names, all together; unsure if undecided.

    Args:
        model: however crude.
        guesses: of all its states and inputs.
        pairs: position and rate states without a matching name.
        signals: the samples of all candidates.
        joints: units of joints' numbers by path.
    """
    said = tuple((guesses[q].path, guesses[w].path) for q, w in pairs)
    ways = [w for w in permutations(_in_log(guesses, said, signals), len(pairs)) if _apart(w)]
    if not pairs or not 1 < len(ways) <= COMBINATIONS:
        return {}
    fits = [way for way in ways if _of_their_units(way, pairs, model, signals, joints)]
    whole = all(path for pair in said for path in pair)
    first = said if whole and (said in fits or not fits) else [*fits, *ways][0]
    left = {
        way: found
        for way in ways
        if (found := _left(model, guesses, pairs, way, signals)) is not None
    }
    best = min(left, key=lambda way: float(left[way].sum()), default=first)
    clear = len(left) == len(ways) and all(
        _clearly(left[best], left[way]) for way in ways if way != best
    )
    if not clear or best not in fits:
        rivals = [way for way in fits or ways if way != first]
        why = ("the model's steps don't clearly favour one",) if rivals and left else ()
        return _given(guesses, pairs, first, rivals, why)
    second = min((way for way in ways if way != best), key=lambda way: float(left[way].sum()))
    better = 1 - np.exp(-float((left[second] - left[best]).sum()) / len(model.states))
    why = (f"with it the model's steps fit {100 * better:.0f} % better than with the next best",)
    return _given(guesses, pairs, best, (), why)


def _in_log(guesses: Mapping[str, Guess], said: Way, signals: Signals) -> list[Pair]:
    """Return the positions with their rates among the log's unassigned numbers."""
    own = {path for pair in said for path in pair if path}
    taken = {guess.path for guess in guesses.values()} - own
    free = [path for path in signals.found if path not in taken]
    found = rates_in(signals, free if len(free) <= MANY else sorted(own))
    whole = [pair for pair in said if all(pair)]
    return list(dict.fromkeys([*whole, *((q, w) for q, (w, by) in found.items() if by == 1)]))


def _apart(way: Way) -> bool:
    paths = [path for pair in way for path in pair]
    return len(set(paths)) == len(paths)


def _of_their_units(
    way: Way,
    pairs: Sequence[Pair],
    model: Model,
    signals: Signals,
    joints: Mapping[str, str],
) -> bool:
    """Check that every number has a unit that fits its state."""
    both = [one for k, pair in enumerate(pairs) for one in zip(pair, way[k], strict=True)]
    units = [(model.states[name], path, signals.stated.unit(path)) for name, path in both]
    return all(
        may_be(path, unit, joints) and not (said and factor_between(said, unit) is None)
        for unit, path, said in units
    )


def _left(
    model: Model,
    guesses: Mapping[str, Guess],
    pairs: Sequence[Pair],
    way: Way,
    signals: Signals,
) -> Array | None:
    """Return the logarithm of each state's error (n,) relative to its changes; None if unknown.

    An unsure input is taken from whichever of its rivals, or those of other unsure ones, fits best.
    """
    names, paths = [*model.state_names, *model.input_names], {n: g.path for n, g in guesses.items()}
    paths |= {n: p for k, pair in enumerate(pairs) for n, p in zip(pair, way[k], strict=True)}
    states = {paths[name] for name in model.state_names}
    own = [guesses[name] for name in model.input_names]
    open_ = [one.path for one in own if not one.sure]  # commands may be exchanged like joints
    may = [dict.fromkeys((g.path, *g.others, *open_ * (not g.sure))) for g in own]
    inputs = [[path for path in some if path and path not in states] for some in may]
    found = []
    for chosen in islice(product(*inputs), COMBINATIONS):
        sent = dict(zip(model.input_names, chosen, strict=True))
        ahead = _ahead(model, guesses, [(paths | sent)[name] for name in names], signals)
        if ahead is not None and ahead.enough:
            rms, moved = ahead.best([np.ones(model.m)]).rms, (ahead.last - ahead.first).std(axis=0)
            found.append(np.log(rms / np.maximum(moved, ahead.least)))
    return min(found, key=lambda one: float(one.sum()), default=None)


def _ahead(
    model: Model, guesses: Mapping[str, Guess], paths: Sequence[str], signals: Signals
) -> Ahead | None:
    """Return the model's predictions of the log, with states and inputs read at some paths."""
    gridded = signals.grid(paths) if len(set(paths)) == len(paths) else None
    if gridded is None:
        return None
    units = {**model.states, **model.inputs}
    scale = {guess.path: guess.scale for guess in guesses.values()}
    by = [
        scale.get(path, 1.0) * signals.stated.factor(path, unit)
        for path, unit in zip(paths, units.values(), strict=True)
    ]
    values = np.column_stack(gridded[1]) * by
    n = model.n
    names = model.state_names, model.input_names
    trial = Trial(values[:, :n], values[:-1, n:], gridded[0], *names)
    with np.errstate(all="ignore"):
        return Ahead(model, trial, range(n), STARTS)


def _clearly(best: Array, other: Array) -> bool:
    """Check whether errors are clearly smaller, in total and for at least one state."""
    gained = other - best
    return float(gained.sum()) > CLEAR and float(gained.max()) > -np.log(HALF)


def _given(
    guesses: Mapping[str, Guess],
    pairs: Sequence[Pair],
    way: Way,
    rivals: Sequence[Way],
    why: tuple[str, ...],
) -> dict[str, Guess]:
    """Return the guesses with their paths; sure, as a group, if there are no rivals."""
    scale = {guess.path: guess.scale for guess in guesses.values()}
    reasons = {guess.path: guess.reasons for guess in guesses.values()}
    paths = {n: p for k, pair in enumerate(pairs) for n, p in zip(pair, way[k], strict=True)}
    plain = bool(why) and not rivals and all(scale.get(path, 1.0) == 1 for path in paths.values())
    found = {}
    for k, pair in enumerate(pairs):
        for j, name in enumerate(pair):
            path = paths[name]
            others = tuple(dict.fromkeys(one[k][j] for one in rivals if one[k][j] != path))
            found[name] = replace(
                guesses[name],
                path=path,
                sure=plain,
                others=others,
                reasons=(*reasons.get(path, ()), *why),
                scale=scale.get(path, 1.0),
                field=None,
            )
    return found
