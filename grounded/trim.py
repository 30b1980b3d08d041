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

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from grounded.compile import Problem
from grounded.frozen import Array
from grounded.task import Task

STARTS = (0.0, 0.35, 0.7, -0.35)  # fractions of the way from the held input to its limit
ITERATIONS, MORE = 30, 12  # of Levenberg-Marquardt: from the starts, from a solution nearby
ROUNDS = 3
FREE_WEIGHT = 0.3  # what is prescribed goes first where both can't be had
KNOTS = 250  # steps that are solved from scratch; those between start from their neighbours
EXACT = 1e-12  # of the mean squared rate: a trim this good is not tried again


@dataclass(frozen=True, eq=False)
class _Steps:
    """Some steps of the run: prescribed states now and next (N, n), and what counts as solved."""

    problem: Problem
    known: NDArray[np.bool_]
    now: Array
    next: Array
    solved: float

    def some(self, chosen: NDArray[np.bool_]) -> _Steps:
        return replace(self, now=self.now[chosen], next=self.next[chosen])

    def residual(self, x: Array, u: Array) -> Array:
        problem = self.problem
        with np.errstate(all="ignore"):
            moved = problem.system.step(x, u, problem.p, problem.dt, problem.smoothing)
        weight = np.where(self.known, 1.0, FREE_WEIGHT)
        return np.asarray((moved - np.where(self.known, self.next, x)) / problem.dt * weight)


@dataclass(frozen=True, eq=False)
class _Trim:
    x: Array  # (N, n)
    u: Array  # (N, m)
    r: Array  # (N, n) residuals as rates, weighted

    @property
    def error(self) -> Array:
        square = np.einsum("ti,ti->t", self.r, self.r)
        return np.where(np.isfinite(square), square, np.inf)

    def some(self, chosen: NDArray[np.bool_]) -> _Trim:
        return _Trim(self.x[chosen], self.u[chosen], self.r[chosen])

    def take(self, other: _Trim, chosen: NDArray[np.bool_]) -> _Trim:
        """The chosen steps from `other` where its error is smaller."""
        rows = np.flatnonzero(chosen)
        better = other.error < self.error[rows]
        x, u, r = self.x.copy(), self.u.copy(), self.r.copy()
        rows, source = rows[better], np.flatnonzero(better)
        x[rows], u[rows], r[rows] = other.x[source], other.u[source], other.r[source]
        return _Trim(x, u, r)


def trim(task: Task, x: Array, known: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Free states and inputs along a nominal run.

    Args:
        task: the model, the limits and the input held before the start.
        x: (H + 1, n), prescribed columns as they are to be, the others as a first guess.
        known: (n,), which columns are prescribed.

    Returns:
        x (H, n) with the free columns filled in, u (H, m).
    """
    H = task.horizon
    rate = np.diff(x, axis=0)[:, known] / task.dt
    solved = EXACT * (float(np.mean(rate**2)) + 1e-12)
    steps = _Steps(task.problem(), known, x[:-1], x[1:], solved)
    knots = np.unique(np.linspace(0, H - 1, min(H, KNOTS)).round().astype(int))
    chosen = np.zeros(H, dtype=bool)
    chosen[knots] = True
    coarse = _from_scratch(task, steps.some(chosen))
    if len(knots) == H:
        return coarse.x, coarse.u
    at = np.arange(H)
    state = np.column_stack([np.interp(at, knots, column) for column in coarse.x.T])
    state[:, known] = x[:-1][:, known]
    u = np.column_stack([np.interp(at, knots, column) for column in coarse.u.T])
    fine = _solve(steps, state, u, MORE)
    return fine.x, fine.u


def _from_scratch(task: Task, steps: _Steps) -> _Trim:
    """From several inputs, then with one input set back, then from the neighbours' solutions."""
    held = np.tile(np.clip(task.past, task.low, task.high), (len(steps.now), 1))
    best = _solve(steps, steps.now, held, ITERATIONS)
    for part in STARTS[1:]:
        best = _again(steps, best, steps.now, _toward_limit(task, held, part), ITERATIONS)
    for j in range(task.model.m):
        for part in STARTS:
            u = best.u.copy()
            u[:, j] = _toward_limit(task, held, part)[:, j]
            best = _again(steps, best, best.x, u, MORE)
    for _ in range(ROUNDS):
        for shift in (1, -1):
            x = np.where(steps.known, steps.now, np.roll(best.x, shift, axis=0))
            best = _again(steps, best, x, np.roll(best.u, shift, axis=0), MORE)
    return best


def _again(steps: _Steps, best: _Trim, x: Array, u: Array, iterations: int) -> _Trim:
    """Tries other starts for the steps that are not solved yet."""
    open_ = best.error > steps.solved
    if not open_.any():
        return best
    return best.take(_solve(steps.some(open_), x[open_], u[open_], iterations), open_)


def _toward_limit(task: Task, held: Array, part: float) -> Array:
    """Inputs that fraction of the way to the upper (negative: lower) limit, where there is one."""
    limit = task.high if part >= 0 else task.low
    return np.where(np.isfinite(limit), held + abs(part) * (limit - held), held)


def _solve(steps: _Steps, x: Array, u: Array, iterations: int) -> _Trim:
    """Levenberg-Marquardt from states x and inputs u, every step with its own damping."""
    now = _Trim(x.copy(), u.copy(), steps.residual(x, u))
    damping = np.full(len(u), 1e-3)
    free = np.flatnonzero(~steps.known)
    problem = steps.problem
    for _ in range(iterations):
        active = now.error > steps.solved
        if not active.any():
            break
        part = now.some(active)
        move = _move(steps, free, part, damping[active])
        s, v = part.x.copy(), part.u + move[:, len(free) :]
        s[:, free] += move[:, : len(free)]
        np.clip(v, problem.low, problem.high, out=v)
        new = _Trim(s, v, steps.some(active).residual(s, v))
        better = new.error < part.error
        now = now.take(new, active)
        factor = np.where(better, 0.2, 5.0)
        damping[active] = np.clip(damping[active] * factor, 1e-9, 1e6)
    return now


def _move(steps: _Steps, free: NDArray[np.intp], now: _Trim, damping: Array) -> Array:
    """The Levenberg-Marquardt step in [free states, inputs], (N, len(free) + m)."""
    problem, n = steps.problem, len(steps.known)
    f_x, f_u = problem.system.linearise(now.x, now.u, problem.p, problem.dt, problem.smoothing)
    J = np.concatenate([f_x[:, :, free] - np.eye(n)[:, free], f_u], axis=2)
    J *= np.where(steps.known, 1.0, FREE_WEIGHT)[:, None] / problem.dt
    usable = np.isfinite(J).all(axis=(1, 2)) & np.isfinite(now.r).all(axis=1)
    J[~usable] = 0.0
    r = np.where(usable[:, None], now.r, 0.0)
    normal = J.swapaxes(1, 2) @ J
    index = np.arange(J.shape[2])
    diagonal = normal[:, index, index] + 1e-9
    normal[:, index, index] += damping[:, None] * diagonal + 1e-9
    gradient = (r[:, None, :] @ J)[:, 0]
    return np.asarray(-np.linalg.solve(normal, gradient[..., None])[..., 0])
