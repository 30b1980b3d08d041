"""Detect two exchanged state columns by the model's predictions.

`swapped` needs positions beside their velocities. An x that is exchanged with a heading or a speed
contradicts no such pair: only the model shows it. With the columns as logged, the calibrated model
predicts neither of the two states; with them swapped back it predicts both, and all errors together
fall by a large factor. Missing physics does not have that effect: none of the logs of real systems
in the tests, and no case of the challenge, shows it.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from grounded.instruments.finding import unusable
from grounded.instruments.kinematics.swapped import swapped_columns
from grounded.instruments.predictions.mistaken import (
    FEWER,
    HALF,
    HINT,
    SWAP_BACK,
    TRIALS,
    Mistake,
    Told,
    described,
)
from grounded.instruments.predictions.short_runs import Ahead, Fit
from grounded.model import Model
from grounded.places import integrals
from grounded.trial import Trial

CLEAR = 3.0  # [nats] by which all errors together must fall
MOVED = 0.8  # of a state's motion over a quarter of a second: errors above it predict nothing
OPPOSITE = 1.2  # the same: errors above it predict the opposite motion
ALIKE = 1.0  # [nats] within which another exchange explains the log as well


def exchanged_states(model: Model, trial: Trial, shown: Sequence[int]) -> Told | None:
    """Return the exchange of two states that explains a trial; None if it needs none.

    Args:
        model: however crude.
        trial: of its states and inputs.
        shown: indices of the states with a sensor.
    """
    known = [i for i in shown if np.isfinite(trial.states[:, i]).any()]
    logged = Ahead(model, trial, known, FEWER)
    if not logged.enough or not np.isfinite(trial.inputs).all():
        return None
    gains = np.ones(model.m)
    with np.errstate(all="ignore"):
        plain = logged.plain(gains)
        lost = plain.rms > HALF * logged.moved
        found, before = [], None
        for pair in combinations(known, 2):
            if not lost[list(pair)].any():
                continue
            change = Mistake(states=(pair,))
            mended = Ahead(model, change.mended(trial), known, FEWER)
            if not mended.enough or plain.score - mended.plain(gains).score < HINT:
                continue
            before = before or logged.best([gains, -gains])
            after = mended.best([gains])
            both = (after.rms < MOVED * mended.moved)[list(pair)].all()
            clear = before.score - after.score > CLEAR
            better = clear and both and bool((after.rms < HALF * before.rms).any())
            if better and not _mirrored(mended, after):
                found.append((after, change))
    if before is None or not found:
        return None
    found.sort(key=lambda one: one[0].score)
    (after, change), *others = found
    near = tuple(other for fit, other in others if fit.score < after.score + ALIKE)
    i = int(np.argmin(after.rms / before.rms))
    return Told(change, i, float(before.rms[i]), float(after.rms[i]), near)


def _mirrored(mended: Ahead, fit: Fit) -> bool:
    """Check whether a log remains a mirror image of the model's motion after the exchange.

    A compass heading also fits the path with x and y exchanged, but then the robot turns away from
    its steering, or its heading from its rate. `way` corrects such a log.
    """
    m = mended.model.m
    turned = mended.best([np.where(np.arange(m) == j, -1.0, 1.0) for j in range(m)])
    against = turned.score < fit.score - ALIKE and bool((turned.gains < 0).any())
    return against or bool((fit.rms > OPPOSITE * mended.moved).any())


def judge_exchanged(model: Model, trials: Sequence[Trial], hidden: Sequence[str] = ()) -> None:
    """Raise an error for trials in which two state columns look exchanged.

    Trials whose positions and velocities show it without the model are left to `judge_columns`.

    Args:
        model: however crude.
        trials: of its states and inputs, as logged.
        hidden: states without a sensor.

    Raises:
        GroundedError: naming the trials and the columns.
    """
    shown = [i for i, name in enumerate(model.state_names) if name not in hidden]
    relations = integrals(model)
    some = range(0, len(trials), max(1, -(-len(trials) // TRIALS)))
    found: dict[int, Told] = {}
    for part in (some, [k for k in range(len(trials)) if k not in some]):
        for k in part:
            if swapped_columns(model, trials[k], shown, relations):
                return
            if (told := exchanged_states(model, trials[k], shown)) is not None:
                found[k] = told
        if not found:
            return
    first = next(iter(found.values()))
    odd = sorted(k for k, told in found.items() if told.mistake == first.mistake)
    raise unusable(trials, odd, described(model, first), SWAP_BACK)
