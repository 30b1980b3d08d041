"""Decide which number is which input by the steps of the model, where names and units don't.

A model skeleton has neither correct masses nor gravity, so the size of its error is meaningless:
the smaller of two torques fits anywhere. What is compared is the part of each state's motion that
remains after removing everything that the states may explain (drag, springs, gravity) and after
giving every input its best gain, with the model's sign.

An assignment is taken if it is clearly better than every other one; else all of them are named.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice

import numpy as np

from grounded.findings import Finding, found
from grounded.frozen import Array
from grounded.model import Model
from grounded.places import probe
from grounded_trials.formats.messages import Floats
from grounded_trials.logs.inspection.guess import Guess
from grounded_trials.logs.inspection.relations import COMBINATIONS, Signals

WINDOW = 0.05  # [s] length of a step: in shorter ones noise dominates
PIECES = 8  # pieces of the log, evaluated separately
PIECE_STEPS = 20  # steps of a piece; short logs have fewer pieces
BETTER = 0.2  # [nats] lead of the best in a state's squared error: 10 % of the error
USE = 0.1  # [nats] lead over no input at all
SCATTER = 2.0  # standard errors over the pieces by which the lead must be significant
PIECES_AGREE = 0.75  # share of the pieces that must agree
TELLS = 0.05  # [nats] with less difference a state does not distinguish assignments


def _better(gain: float) -> Finding:
    """Return by how much an assignment fits better than the next best, by the log of its error."""
    return found("start.steps", share=float(1 - np.exp(-gain)), nats=gain)


Paths = tuple[str, ...]


def by_inputs(model: Model, guesses: Mapping[str, Guess], signals: Signals) -> dict[str, Guess]:
    """Decide unsure inputs by the model's steps if they are conclusive; else list the rivals.

    Inputs that no name fits, such as two thrusters in an unnamed array, are assigned only if all
    unsure ones can be decided.

    Args:
        model: however crude.
        guesses: of all its states and inputs.
        signals: the samples of all candidates.
    """
    unsure = [n for n in model.input_names if guesses[n].others]
    known = [*model.state_names, *model.input_names]
    if not unsure or not all(guesses[name].path for name in known if name not in unsure):
        return {}
    units = {**model.states, **model.inputs}
    fixed = {guesses[name].path for name in known if name not in unsure}
    choices = [
        [p for p in (guesses[n].path, *guesses[n].others) if p in signals.found and p not in fixed]
        for n in unsure
    ]
    left: dict[Paths, Array] = {}
    tried = list(islice(_apart(choices), COMBINATIONS + 1))
    for chosen in tried[:COMBINATIONS]:
        paths = {n: guesses[n].path for n in known} | dict(zip(unsure, chosen, strict=True))
        gridded = signals.grid(list(paths.values()))
        if gridded is not None:
            own = signals.stated
            scales = [guesses[name].scale * own.factor(paths[name], units[name]) for name in known]
            left[chosen] = _left(model, gridded[0], np.column_stack(gridded[1]) * scales)
    if len(left) < 2:
        return {}
    best = min(left, key=lambda one: float(left[one][..., 0].sum()))
    rivals = [one for one in left if one != best and not _clearly(left[best], left[one])]
    if len(tried) > COMBINATIONS:  # not all could be tried
        rivals = [one for one in left if one != best]
    if rivals and not all(guesses[n].path for n in unsure):
        return {}
    if rivals:
        first = tuple(guesses[n].path for n in unsure)
        said = first if first in left else best
        return _open(guesses, unsure, said, [one for one in (best, *rivals) if one != said])
    gain = min(float((left[o] - left[best])[..., 0].mean(axis=0).sum()) for o in left if o != best)
    taken = {n: moved_to(guesses[n], path) for n, path in zip(unsure, best, strict=True)}
    return {n: one.because(_better(gain / 2), sure=True) for n, one in taken.items()}


def moved_to(guess: Guess, path: str) -> Guess:
    """Return the guess moved to another of its candidates."""
    if path == guess.path:
        return guess
    rest = tuple(p for p in (guess.path, *guess.others) if p not in ("", path))
    return replace(guess, path=path, others=rest, field=None, reasons=())


def _apart(choices: Sequence[Sequence[str]], taken: Paths = ()) -> Iterator[Paths]:
    """Yield combinations with one path of each list, all different."""
    if len(taken) == len(choices):
        yield taken
        return
    for path in choices[len(taken)]:
        if path not in taken:
            yield from _apart(choices, (*taken, path))


def _open(
    guesses: Mapping[str, Guess], unsure: Sequence[str], said: Paths, rivals: Sequence[Paths]
) -> dict[str, Guess]:
    """Return the guesses with paths `said`, and rivals from assignments that fit about as well."""
    open_ = {}
    for k, name in enumerate(unsure):
        others = tuple(dict.fromkeys(one[k] for one in rivals if one[k] != said[k]))
        open_[name] = moved_to(guesses[name], said[k])
        if others:
            doubted = open_[name].because(found("start.steps"), sure=False)
            open_[name] = replace(doubted, others=others)
    return open_


def _left(model: Model, step: float, values: Floats) -> Array:
    """Return the log squared error per piece and state, with inputs and without, (P, n, 2)."""
    k, n = max(1, round(WINDOW / step)), model.n
    x, sums = values[:, :n], np.cumsum(np.vstack([np.zeros(model.m), values[:, n:]]), axis=0)
    u, dt = ((sums[k:] - sums[:-k]) / k)[: len(x) - k], probe(model, k * step)
    with np.errstate(all="ignore"):
        none = model.system.step(x[:-k], 0 * u, model.values, dt)
        moved = model.difference(x[k:], none)
        each = [
            model.difference(model.system.step(x[:-k], u * one, model.values, dt), none)
            for one in np.eye(model.m)
        ]
    good = np.isfinite(np.column_stack([moved, *each])).all(axis=1)
    moved, does = moved[good], np.stack(each)[:, good]
    own = _explained(model, x[:-k][good])
    pieces = np.array_split(np.arange(len(moved)), max(1, min(PIECES, len(moved) // PIECE_STEPS)))
    squared = np.empty((len(pieces), n, 2))
    for i in range(n):
        both = np.column_stack([moved[:, i], *does[:, :, i]])
        both = both - own @ np.linalg.lstsq(own, both, rcond=None)[0]
        y, effects = both[:, 0], both[:, 1:]
        after = y - effects @ _gains(effects, y)
        for p, at in enumerate(pieces):
            squares = [float(r[at] @ r[at]) + 1e-24 for r in (after, y)]
            squared[p, i] = np.log(squares)
    return squared


def _explained(model: Model, x: Array) -> Array:
    """Return regressors (N, k) for motion without inputs: the states, and sines of angles."""
    turns = [i for i, unit in enumerate(model.states.values()) if unit == "rad"]
    columns = [np.ones(len(x)), x, np.sin(x[:, turns]), np.cos(x[:, turns])]
    own = np.column_stack(columns)
    size: Array = own / np.maximum(np.abs(own).max(axis=0, initial=0.0), 1e-12)
    return size


def _gains(effects: Array, y: Array) -> Array:
    """Return the best gains, none below 0, since exchanged wheels would need negative ones."""
    from scipy.optimize import nnls

    size = np.sqrt((effects**2).sum(axis=0))
    used = size > 1e-9 * max(float(np.sqrt(y @ y)), 1e-12)
    gains = np.zeros(len(size))
    if used.any():
        gains[used] = nnls(effects[:, used] / size[used], y)[0] / size[used]
    return gains


def _clearly(best: Array, other: Array) -> bool:
    """Check whether one assignment leaves less of every state that distinguishes the two.

    Two thrusters exchanged turn a boat the other way, but push it ahead alike: of its speed, only
    what their own gains explain differs.
    """
    if best.shape != other.shape:
        return False
    gained, used = other[..., 0] - best[..., 0], best[..., 1] - best[..., 0]
    error = gained.std(axis=0) / np.sqrt(max(len(gained) - 1, 1))
    mean = gained.mean(axis=0)
    tells = (np.abs(mean) > TELLS) | (mean < -SCATTER * np.maximum(error, 1e-9))
    if not tells.any():
        return False
    gained, used, error = gained[:, tells], used[:, tells], error[tells]
    sure = (gained.mean(axis=0) > SCATTER * error) & ((gained > 0).mean(axis=0) >= PIECES_AGREE)
    return bool(sure.all() and gained.mean(axis=0).min() > BETTER and used.mean(axis=0).min() > USE)
