"""Trim: the inputs and free states for which the model moves as it is told, step by step.

Some states of a nominal run are prescribed (its path, its speed ...); the others and the inputs are
to be found. At each step by itself, with f the model over one control step,

    f(x_t, u_t)_i = x_{t+1, i}   for prescribed states,    f(x_t, u_t)_i = x_{t, i}   for free ones:

free states hold still while the prescribed ones move (a quasi-steady turn: steering angle, bank,
surfaces). Levenberg-Marquardt on all steps at once, inputs inside their limits. It starts from
several inputs, because a stalled motor has no slope to follow; then every step tries again with one
input set back, and tries the solutions of its neighbours, because a manoeuvre is continuous and a
bad local minimum seldom is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grounded.compile import Problem
from grounded.frozen import Array
from grounded.task import Task

STARTS = (0.0, 0.35, 0.7, -0.35)  # fractions of the way from the held input to its limit
ITERATIONS, MORE = 30, 12  # of Levenberg-Marquardt: from the starts, from a solution nearby
ROUNDS = 3
FREE_WEIGHT = 0.3  # what is prescribed goes first where both can't be had


@dataclass(frozen=True, eq=False)
class _Trim:
    x: Array  # (H, n)
    u: Array  # (H, m)
    r: Array  # (H, n) residuals as rates, weighted

    @property
    def error(self) -> Array:
        square = (self.r**2).sum(axis=1)
        return np.where(np.isfinite(square), square, np.inf)

    def take(self, other: _Trim) -> _Trim:
        """Step by step the one with the smaller error."""
        better = (other.error < self.error)[:, None]
        return _Trim(
            np.where(better, other.x, self.x),
            np.where(better, other.u, self.u),
            np.where(better, other.r, self.r),
        )


def trim(task: Task, x: Array, known: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Free states and inputs along a nominal run.

    Args:
        task: the model, the limits and the input held before the start.
        x: (H + 1, n), prescribed columns as they are to be, the others as a first guess.
        known: (n,), which columns are prescribed.

    Returns:
        x (H, n) with the free columns filled in, u (H, m).
    """
    problem = task.problem()
    held = np.tile(np.clip(task.past, task.low, task.high), (task.horizon, 1))
    best = _solve(problem, x, known, x[:-1], held, ITERATIONS)
    for part in STARTS[1:]:
        u = _toward_limit(task, held, part)
        best = best.take(_solve(problem, x, known, x[:-1], u, ITERATIONS))
    for j in range(task.model.m):
        for part in STARTS:
            u = best.u.copy()
            u[:, j] = _toward_limit(task, held, part)[:, j]
            best = best.take(_solve(problem, x, known, best.x, u, MORE))
    for _ in range(ROUNDS):
        for shift in (1, -1):
            state = np.where(known, x[:-1], np.roll(best.x, shift, axis=0))
            u = np.roll(best.u, shift, axis=0)
            best = best.take(_solve(problem, x, known, state, u, MORE))
    return best.x, best.u


def _toward_limit(task: Task, held: Array, part: float) -> Array:
    """Inputs that fraction of the way to the upper (negative: lower) limit, where there is one."""
    limit = task.high if part >= 0 else task.low
    return np.where(np.isfinite(limit), held + abs(part) * (limit - held), held)


def _residual(problem: Problem, x: Array, known: NDArray[np.bool_], s: Array, u: Array) -> Array:
    with np.errstate(all="ignore"):
        moved = problem.system.step(s, u, problem.p, problem.dt, problem.smoothing)
    weight = np.where(known, 1.0, FREE_WEIGHT)
    return np.asarray((moved - np.where(known, x[1:], s)) / problem.dt * weight)


def _solve(
    problem: Problem, x: Array, known: NDArray[np.bool_], s: Array, u: Array, iterations: int
) -> _Trim:
    """Levenberg-Marquardt from states s and inputs u, every step with its own damping."""
    now = _Trim(s.copy(), u.copy(), _residual(problem, x, known, s, u))
    damping = np.full(len(u), 1e-3)
    free = np.flatnonzero(~known)
    for _ in range(iterations):
        move = _move(problem, known, free, now, damping)
        s, u = now.x.copy(), now.u + move[:, len(free) :]
        s[:, free] += move[:, : len(free)]
        np.clip(u, problem.low, problem.high, out=u)
        new = _Trim(s, u, _residual(problem, x, known, s, u))
        better = new.error < now.error
        now = now.take(new)
        damping = np.clip(np.where(better, damping / 5, damping * 5), 1e-9, 1e6)
    return now


def _move(
    problem: Problem, known: NDArray[np.bool_], free: NDArray[np.intp], now: _Trim, damping: Array
) -> Array:
    """The Levenberg-Marquardt step in [free states, inputs], (H, len(free) + m)."""
    n = len(known)
    f_x, f_u = problem.system.linearise(now.x, now.u, problem.p, problem.dt, problem.smoothing)
    J = np.concatenate([f_x[:, :, free] - np.eye(n)[:, free], f_u], axis=2)
    J *= np.where(known, 1.0, FREE_WEIGHT)[:, None] / problem.dt
    usable = np.isfinite(J).all(axis=(1, 2)) & np.isfinite(now.r).all(axis=1)
    J[~usable] = 0.0
    r = np.where(usable[:, None], now.r, 0.0)
    normal = np.einsum("tij,tik->tjk", J, J)
    diagonal = np.einsum("tjj->tj", normal) + 1e-9
    index = np.arange(J.shape[2])
    normal[:, index, index] += damping[:, None] * diagonal + 1e-9
    gradient = np.einsum("tij,ti->tj", J, r)
    return np.asarray(-np.linalg.solve(normal, gradient[..., None])[..., 0])
