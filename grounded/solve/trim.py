"""Trim: the inputs and free states for which the model moves as it is told, step by step.

Some states of a nominal run are prescribed (its path, its speed ...); the others and the inputs are
to be found. At each step by itself, with f the model over one control step,

    f(x_t, u_t)_i = x_{t+1, i}   for prescribed states,    f(x_t, u_t)_i = x_{t, i}   for free ones:

free states hold still while the prescribed ones move (a quasi-steady turn: steering angle, bank,
surfaces). Levenberg-Marquardt on many steps at once, inputs inside their limits. It starts from
several inputs, because a stalled motor has no slope to follow; then every step tries again with one
input set back, and tries the solutions of its neighbours, because a manoeuvre is continuous and a
bad local minimum seldom is.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grounded.frozen import Array
from grounded.solve.levenberg_marquardt import Batch, Rows, Solution, solve
from grounded.task import Task

STARTS = (0.0, 0.35, 0.7, -0.35)  # fractions of the way from the held input to its limit
ITERATIONS, MORE = 30, 12  # of Levenberg-Marquardt: from the starts, from a solution nearby
ROUNDS = 3
FREE_WEIGHT = 0.3  # what is prescribed goes first where both can't be had
KNOTS = 250  # steps that are solved from scratch; those between start from their neighbours
EXACT = 1e-12  # of the mean squared rate: a trim this good is not tried again


def trim(task: Task, x: Array, known: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Free states and inputs along a nominal run.

    Args:
        task: the model, the limits and the input held before the start.
        x: (H + 1, n), prescribed columns as they are to be, the others as a first guess.
        known: (n,), which columns are prescribed.

    Returns:
        x (H, n) with the free columns filled in, u (H, m).
    """
    H, free = task.horizon, np.flatnonzero(~known)
    batch = _steps(task, x, known)
    knots = np.linspace(0, H - 1, min(H, KNOTS)).round().astype(int)  # at least a step apart
    coarse = _from_scratch(task, batch, x[knots][:, free], knots)
    at = np.arange(H)
    w = np.column_stack([np.interp(at, knots, column) for column in coarse.w.T])
    if len(knots) < H:
        w = solve(batch, w, at, MORE).w
    filled = x[:-1].copy()
    filled[:, free] = w[:, : len(free)]
    return filled, w[:, len(free) :]


def _steps(task: Task, x: Array, known: NDArray[np.bool_]) -> Batch:
    """The equations of every step in w = [free states, inputs], as rates."""
    problem, free, n = task.problem(), np.flatnonzero(~known), x.shape[1]
    weight = np.where(known, 1.0, FREE_WEIGHT) / problem.dt
    settings = (problem.p, problem.dt, problem.smoothing)

    def split(w: Array, rows: Rows) -> tuple[Array, Array]:
        state = x[rows]
        state[:, free] = w[:, : len(free)]
        return state, np.ascontiguousarray(w[:, len(free) :])

    def residual(w: Array, rows: Rows) -> Array:
        state, u = split(w, rows)
        with np.errstate(all="ignore"):
            moved = problem.system.step(state, u, *settings)
        return np.asarray((moved - np.where(known, x[rows + 1], state)) * weight)

    def jacobian(w: Array, rows: Rows) -> Array:
        state, u = split(w, rows)
        f_x, f_u = problem.system.linearise(state, u, *settings)
        J = np.concatenate([f_x[:, :, free] - np.eye(n)[:, free], f_u], axis=2)
        return np.asarray(J * weight[:, None])

    rate = np.diff(x, axis=0)[:, known] / problem.dt
    nowhere = np.full(len(free), np.inf)
    return Batch(
        residual,
        jacobian,
        low=np.append(-nowhere, task.low),
        high=np.append(nowhere, task.high),
        solved=EXACT * (float(np.mean(rate**2)) + 1e-12),
    )


def _from_scratch(task: Task, batch: Batch, states: Array, knots: Rows) -> Solution:
    """From several inputs, then with one input set back, then from the neighbours' solutions."""
    held = np.tile(np.clip(task.past, task.low, task.high), (len(knots), 1))
    starts = [_toward_limit(task, held, part) for part in STARTS]
    best = solve(batch, np.hstack([states, starts[0]]), knots, ITERATIONS)

    def again(w: Array, iterations: int) -> Solution:
        open_ = np.flatnonzero(best.error > batch.solved)
        if not len(open_):
            return best
        return best.better_of(solve(batch, w[open_], knots[open_], iterations), open_)

    for start in starts[1:]:
        best = again(np.hstack([states, start]), ITERATIONS)
    for j in range(task.model.m):
        for start in starts:
            w = best.w.copy()
            w[:, states.shape[1] + j] = start[:, j]
            best = again(w, MORE)
    for _ in range(ROUNDS):
        for shift in (1, -1):
            best = again(np.roll(best.w, shift, axis=0), MORE)
    return best


def _toward_limit(task: Task, held: Array, part: float) -> Array:
    """Inputs that fraction of the way to the upper (negative: lower) limit, where there is one."""
    limit = task.high if part >= 0 else task.low
    return held + abs(part) * (np.where(np.isfinite(limit), limit, held) - held)
