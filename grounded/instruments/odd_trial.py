"""A whole trial in other units than the rest: degrees for radians, milliseconds for seconds.

Where one state of a trial is in degrees, or its stamps are in milliseconds, the rate of a position
is a constant times what the velocity says. Where all angles and their rates are in degrees they
agree with each other: then commands as large as in other trials seem to move the body tens of times
as far, the model misses that by tens of times as much, and divided by 57.3 by as much as the rest.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from grounded.errors import GroundedError, NextCommand
from grounded.frozen import Array
from grounded.instruments.kinematics import Integral, integrals, over_steps, pieces
from grounded.model import Model
from grounded.trial import Trial

AHEAD = 0.25  # [s]
STARTS = 200
LARGE = 20.0  # times what the others do
SIMILAR = 3.0
STAMPS, DEGREES = 1000.0, 180 / np.pi
NEAR = 0.1  # relative, of these factors
TOGETHER = 0.9  # correlation of a rate and its velocity
FAR = 1e9

Ratios = Sequence[tuple[Integral, float]]  # of a trial's positions, see `ratios_of`


def in_degrees(
    model: Model, trials: Sequence[Trial], ratios: Sequence[Ratios], shown: Sequence[int]
) -> Iterator[tuple[int, list[int]]]:
    """Trials with states in degrees that are in radians in another trial.

    Args:
        model: however crude.
        trials: several.
        ratios: of each.
        shown: states that a sensor has.

    Yields:
        The index of the trial, and its states that are.
    """
    units = list(model.states.values())
    shown = [i for i in shown if all(np.isfinite(t.states[:, i]).any() for t in trials)]
    angular = [i for i in shown if units[i] == "rad" or units[i].startswith("rad/")]
    if len(trials) < 2 or not angular:
        return
    single = [_one_state(one) for one in ratios]
    size = [np.sqrt(np.nanmean(t.states[:, angular] ** 2, axis=0)) for t in trials]
    pushed = [_size(t.inputs) for t in trials]
    missed = [_missed(model, trial, angular, shown) for trial in trials]
    for k, trial in enumerate(trials):
        if single[k] and not all(single):
            yield k, single[k]
            continue
        rest = [j for j in range(len(trials)) if not (size[j] * LARGE > size[k]).any()]
        rest = [
            j for j in rest if 1 / SIMILAR < (pushed[k] + 1e-12) / (pushed[j] + 1e-12) < SIMILAR
        ]
        if not rest:
            continue
        usual = max(missed[j] for j in rest)
        mended = _missed(model, radians(trial, angular), angular, shown)
        if missed[k] > LARGE * max(usual, mended) and mended < SIMILAR * usual:
            yield k, angular


def _one_state(ratios: Ratios) -> list[int]:
    """The states that are in degrees beside a rate or a position that isn't."""
    found = []
    for relation, factor in ratios:
        for i, one in ((relation.i, factor), (relation.j, 1 / factor)):
            if abs(one / DEGREES - 1) < NEAR:
                found.append(i)
    return found


def radians(trial: Trial, some: Sequence[int]) -> Trial:
    """The trial with some of its states divided by 57.3."""
    states = np.array(trial.states)
    states[:, some] = np.deg2rad(states[:, some])
    return replace(trial, states=states)


def _missed(model: Model, trial: Trial, some: Sequence[int], shown: Sequence[int]) -> float:
    """Rms error of predictions a quarter of a second ahead, of the states `some` together."""
    steps = max(1, round(AHEAD / trial.dt))
    logged = np.array(trial.states)
    logged[:, [i for i in range(model.n) if i not in shown]] = 0.0  # nobody knows
    good = np.asarray(np.isfinite(logged).all(axis=1))
    at = np.flatnonzero(good[:-steps] & good[steps:])
    if len(at) < 5:
        return float("nan")
    at = at[:: max(1, len(at) // STARTS)]
    x = logged[at]
    for j in range(steps):
        x = model.system.step(x, trial.inputs[at + j], model.values, trial.dt)
        x = np.fmax(np.fmin(x, FAR), -FAR)
    return _size(model.difference(x, logged[at + steps])[:, some])


def judge_stamps(model: Model, trials: Sequence[Trial], ratios: Sequence[Ratios]) -> None:
    """Stops at a trial whose stamps are in milliseconds, or were taken for such.

    Args:
        model: however crude.
        trials: any.
        ratios: of each.

    Raises:
        GroundedError: with the trial, a state and the factor.
    """
    for k, (trial, found) in enumerate(zip(trials, ratios, strict=True)):
        for factor in (STAMPS, 1 / STAMPS):
            if found and all(abs(one / factor - 1) < NEAR for _, one in found):
                q, w = (model.state_names[i] for i in (found[0][0].i, found[0][0].j))
                name = trial.id or f"number {k + 1}"
                raise GroundedError(
                    f"trial {name}: {q} moves {found[0][1]:.3g} times as fast as {w} says, so the "
                    "stamps of its log are in another unit (milliseconds, not seconds): correct "
                    "them and take it in again, without this one",
                    then=NextCommand("discard", (trial.id,)) if trial.id else None,
                )


def ratios_of(model: Model, trials: Sequence[Trial]) -> list[Ratios]:
    """Of each trial, the rate of each position over what its velocity says; 1 where they differ."""
    relations = [one for one in integrals(model) if one.exact]
    return [_ratios(relations, trial) for trial in trials]


def _ratios(relations: Sequence[Integral], trial: Trial) -> Ratios:
    found = []
    for relation in relations:
        some = [
            (np.diff(x[:, 0])[1:-1], over_steps(relation.c * x[:, 1]) * trial.dt)
            for x in pieces([trial], (relation.i, relation.j))
        ]
        if not some:
            continue
        moved, said = (np.concatenate(parts) for parts in zip(*some, strict=True))
        if np.std(moved) > 0 and np.std(said) > 0:
            same = abs(float(np.corrcoef(moved, said)[0, 1])) > TOGETHER
            found.append((relation, _size(moved) / _size(said) if same else 1.0))
    return found


def _size(x: Array) -> float:
    return float(np.sqrt(np.nanmean(x**2))) if x.size else 0.0
