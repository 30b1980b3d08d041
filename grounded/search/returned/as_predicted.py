"""Check a supposed fault of a log against the states that were predicted for its candidate.

A policy's commands alone don't tell which column is wrong: feedback on an angle of the other sign
sends nearly what it sends on a speed of the other sign. But a run resembles its prediction, even
by a crude model, since feedback keeps it there: a column in another unit, of the other sign or in
another's place is far from it. So a fault is only stated if the log without it is not farther from
the prediction, and the fault that brings it nearest is stated.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from grounded.accounts.judge import contradicted
from grounded.accounts.table import Account, of_commands
from grounded.frozen import Array
from grounded.model import Model
from grounded.search.candidate import Candidate
from grounded.trial import Trial

NEAR = 0.3  # of a state's usual size: smaller differences from the prediction are alike
NEARER = 1.5  # [nats] by which a factor must bring a column nearer to be stated for it alone
ALIKE = 1.0  # largest difference of the column after that; unrelated motion differs by 1.4
TELLS = 0.7  # median difference of the other states in a run like its prediction, at most
GROSS = 10.0  # smallest factor, or its inverse, that the prediction alone tells


def far(own: Candidate, trial: Trial) -> Array:
    """Return each state's rms difference from its prediction, relative to its size, (n,).

    The size is the geometric mean of the standard deviations, so that a column that is too small is
    as far as one that is too large. NaN for a state that is predicted not to move, or of which
    nothing is finite.
    """
    T = min(trial.finite_steps, len(own.predicted_states) - 1)
    if T < 0:
        return np.full(trial.states.shape[1], np.nan)
    seen, said = trial.states[: T + 1], own.predicted_states[: T + 1]
    off = np.sqrt(((seen - said) ** 2).mean(axis=0))
    moves, shown = said.std(axis=0), seen.std(axis=0)
    with np.errstate(all="ignore"):
        found: Array = off / np.sqrt(np.where(moves > 0, moves, np.nan) * (shown + 1e-6 * moves))
    return found


def apart(own: Candidate, trial: Trial, but: Sequence[str] = ()) -> float:
    """Return how far a trial is from its prediction [nats], summed over the states `but` some."""
    counts = ~np.isin(trial.state_names, but)
    return float(np.nansum(np.log(np.fmax(far(own, trial), NEAR))[counts]))


def like_predicted(own: Candidate, trial: Trial) -> bool:
    """Return whether most states of a trial are near their prediction, as far as one is known."""
    known = far(own, trial)
    known = known[np.isfinite(known)]
    return not len(known) or bool(np.median(known) < ALIKE)


def multiplied(trial: Trial, names: Sequence[str], factor: float) -> Trial:
    """Return a trial with some columns multiplied by a factor."""
    every = (*trial.state_names, *trial.input_names)
    columns = tuple(every.index(name) for name in names)
    return Account("unit", columns, 1 / factor).mended(trial) if columns else trial


def odd_columns(
    model: Model, own: Candidate, trial: Trial, logged: Sequence[str] | None = None
) -> tuple[tuple[str, ...], float]:
    """Return states in another unit or of the other sign that commands don't tell; (), 1 if none.

    A policy that hardly uses a speed sends the same commands whatever its unit. A real motion may
    be opposite to a small predicted one: a sign must also be wrong by the model's motion.

    Args:
        model: with the states.
        own: the candidate that was run.
        trial: a run that resembles its prediction in most states.
        logged: the states that a column holds; None: all.
    """
    as_it_is = far(own, trial)
    if (known := np.isfinite(as_it_is)).sum() < 2:
        return (), 1.0
    best: tuple[tuple[str, ...], float] = (), 1.0
    least = apart(own, trial) - NEARER
    shown = range(model.n) if logged is None else [model.state_names.index(n) for n in logged]
    for account in of_commands(model):
        if not {*account.columns} <= {*shown}:
            continue
        names, by = tuple(model.state_names[k] for k in account.columns), 1 / account.factor
        which = [i for i in account.columns if known[i]]
        rest = [i for i in np.flatnonzero(known) if i not in which]
        if not which or not rest or (by != -1 and 1 / GROSS < abs(by) < GROSS):
            continue
        mended = multiplied(trial, names, by)
        nearer, now = apart(own, mended), far(own, mended)
        if not (nearer < least and now[which].max() < ALIKE and np.median(as_it_is[rest]) < TELLS):
            continue
        fault = Account("sign", tuple(which), -1.0)
        if by == -1 and not contradicted(model, mended, range(model.n), fault):
            continue
        best, least = (names, by), nearer
    return best
