"""Errors of open-loop predictions from many moments of the log at once.

Each moment may have its own hypothesis. Those of different folds differ only in their values, so
all folds are stepped together at little more than the cost of one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from grounded.diagnosis.likelihood.carried import stepper
from grounded.diagnosis.likelihood.data import Data
from grounded.diagnosis.likelihood.delays import delays_of
from grounded.diagnosis.likelihood.fitted import Fitted, leave_one_out, moved
from grounded.diagnosis.likelihood.hypothesis import Hypothesis, by_row
from grounded.diagnosis.likelihood.marching import marched
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.frozen import Array

LED = 400  # steps of predictions from which how inputs change within a step is left out
FAR = 1e6  # size of a state above which it has diverged


def by_fold(data: Data, fit: Fitted) -> tuple[list[Hypothesis], Any]:
    """Return a fit's hypothesis for each fold, with values from the others; the fold of each run.

    Without values, or a second fold, it is one hypothesis for all runs.
    """
    h, (folds, of_run) = fit.hypothesis, np.unique(data.folds, return_inverse=True)
    if len(folds) < 2 or not (h.effects or h.spread > 0):
        return [h], np.zeros_like(of_run)
    shifts = leave_one_out(fit, data.folds)
    return [moved(data, h, shift) for shift in shifts], of_run


def missed(
    predictor: Predictor,
    hypotheses: Sequence[Hypothesis],
    which: Any,
    track: Array,
    at: Any,
    run: Any,
    steps: int,
    added: Array | None = None,
) -> Array:
    """Return measurement minus prediction, 0 to `steps` steps after each of M moments.

    Args:
        predictor: evaluates hypotheses on the data.
        hypotheses: hypotheses with the same effects.
        which: index of the hypothesis that predicts from each moment, (M,) of int.
        track: states from which predictions start, (L + 1, B, n).
        at: step within the run of each moment, (M,) of int.
        run: run of each moment, (M,) of int.
        steps: number of steps ahead.
        added: added to every step within a run, (L, B, n).

    Returns:
        Errors (steps + 1, M, n), NaN where not measured.
    """
    data = predictor.data
    trial = data.trial_of[run]
    state0, step0 = (np.cumsum([0, *(data.lengths + more)])[trial] for more in (1, 0))
    step, last = data.step_at[run, 0] - step0 + at, data.lengths[trial]
    t = np.minimum(step + np.arange(steps)[:, None], last - 1)
    each = [(h, np.flatnonzero(which == i)) for i, h in enumerate(hypotheses)]
    each = [(h, own) for h, own in each if len(own)]
    sent, begin = np.empty((*t.shape, 0)), dict[int, int]()
    for h, own in each:
        by_trial = predictor.received(h, leads=steps < LED)
        if not sent.shape[-1]:
            sent = np.empty((*t.shape, by_trial.shape[-1]))
        sent[:, own] = by_trial[trial[own], t[:, own]]
        delays = delays_of(h, data)  # sensors may show states from before the start
        begin[id(h)] = 0 if delays is None else delays.oldest
    oldest = max(begin.values())
    path = [track[np.maximum(at - j, 0), run] for j in range(oldest, -1, -1)]
    together = by_row([h for h, _ in each], np.searchsorted(np.unique(which), which))
    advance = stepper(predictor, together)
    x, n = _widened(predictor, each, track, at, run), data.model.n
    if (
        added is None
        and (marched := _marched(predictor, each, x, sent, t[0] * data.dt)) is not None
    ):
        path, sent = [*path, *marched[1:, :, :n]], sent[:0]  # all steps are done
    for j, (u, now) in enumerate(zip(sent, t[: len(sent)] * data.dt, strict=True)):
        x = advance(x, u, now)
        if added is not None:
            inside = (at + j < len(added))[:, None]
            x[:, :n] += np.where(inside, added[np.minimum(at + j, len(added) - 1), run], 0.0)
        x = np.fmax(np.fmin(x, FAR), -FAR)  # NaN becomes FAR, too
        path.append(x[:, :n])
    states = np.stack(path)
    logged = np.empty_like(states[oldest:])
    for h, own in each:
        since = states[oldest - begin[id(h)] :, own]
        logged[:, own] = (since + predictor.offset(h, since))[begin[id(h)] :]
    ahead = step + np.arange(steps + 1)[:, None]
    flat = state0 + np.minimum(ahead, last)
    error = data.model.difference(data.filled[flat], logged)
    seen = np.isfinite(data.states[flat]) & (ahead <= last)[..., None]
    return np.where(seen, error, np.nan)


def _widened(
    predictor: Predictor, each: Sequence[tuple[Hypothesis, Any]], track: Array, at: Any, run: Any
) -> Array:
    """Return the states at each moment (M, n), and the memories of joints behind them."""
    last, found = len(predictor.data.time) - 1, list[Array]()
    for h, own in each:
        whole = predictor.widened(h, track[: last + 1])[np.minimum(at, last), run]
        found = found or [whole]
        found[0][own] = whole[own]
    found[0][:, : track.shape[-1]] = track[at, run]
    return found[0]


def unseen(predictor: Predictor, h: Hypothesis) -> Any:
    """Return how many steps after a moment each log first shows what the start there has not used.

    (n,) of int. A filter uses a log that is late by k whole steps with the state that it shows. So
    the log of k steps later is no prediction from there, but a part of the start.
    """
    found, delays = np.ones(predictor.data.model.n, int), delays_of(h, predictor.data)
    if delays is not None:
        found[list(delays.channel)] += np.array(delays.whole)
    return found


def at_steps(error: Array, steps: int, first: Any) -> Array:
    """Return errors (S, M, n) after some steps, of late logs not before `first` (n,), (M, n)."""
    at = np.maximum(steps, first)
    return np.asarray(error[at, :, np.arange(len(at))].T)


def _marched(
    predictor: Predictor, each: Sequence[tuple[Hypothesis, Any]], x: Array, sent: Array, t: Array
) -> Array | None:
    """Return compiled rollouts (steps + 1, M, n); None if not compiled, or one diverges.

    x (M, n), sent (steps, M, m or 2 m), t (M,): states, received inputs and times at the start.
    """
    found, whole = np.empty((len(sent) + 1, *x.shape)), sent.shape[-1] == predictor.data.model.m
    for h, own in each:
        z = predictor.marched(h, x[own], sent[:, own])
        if z is not None and not (np.abs(z) < FAR).all():
            return None
        if z is None and whole:
            z = marched(predictor, h, x[own], sent[:, own], t[own])
        if z is None:
            return None
        found[:, own] = np.fmax(np.fmin(z, FAR), -FAR)
    return found
