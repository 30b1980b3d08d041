"""The start of DDP for the first policy: a run near the REFERENCE instead of zero inputs.

A long manoeuvre is rarely solved from an open-loop start: the first rollout drifts away from the
target and DDP does not recover. So the target is turned into a nominal run in three steps:

1. Fill in. The target gives the states that the running reward weighs. A heading or speed that it
   lacks is derived from its path (roles `position`, `heading`, `speed`). The other states and the
   inputs are trimmed separately at each step, with f the model over one control step:

       f(x_t, u_t)_i = target_{t+1, i}  (known i),       f(x_t, u_t)_i = x_{t, i}  (free i)

   Free states stay constant while the known ones move (a quasi-steady turn: steering angle, bank,
   control surfaces).
2. Ground the model on the filled target, as step 4 does on a trial, and design one LQR about it.
3. Simulate that policy, closed loop, in the original model: the start for DDP.

The trim is solved by Levenberg-Marquardt for many steps at once, with inputs inside their limits.
It starts from several inputs, because a stalled motor has no slope, and each step keeps its best.

A simulator takes milliseconds a step. There few steps are solved, each once; the inputs of the
others are those of its own inverse dynamics, where it has them, plus interpolated corrections.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grounded.frozen import Array
from grounded.rollout import augmented
from grounded.solve.levenberg_marquardt import LeastSquares, Minimum, Rows, solve
from grounded.task import Task

STARTS = (0.0, 0.35, 0.7, -0.35)  # fractions of the way from the held input to its limit
ITERATIONS, MORE = 30, 12  # of Levenberg-Marquardt: from the starts, from a solution nearby
FREE_WEIGHT = 0.3  # weight of the equations of free states, below that of prescribed ones
KNOTS = 250  # steps that are solved from scratch; the others start from their neighbours
FEW_KNOTS, FEW_STARTS = 12, 2  # KNOTS and STARTS of a simulator
EXACT_OF_SIMULATOR = 1e-2  # EXACT for a simulator
EXACT = 1e-12  # squared error, relative to the mean squared rate, at which a trim is accepted


@dataclass(frozen=True, eq=False)
class Guess:
    """A nominal run of the model: inputs (H, m), gains (H, m, nz), augmented states (H + 1, nz)."""

    inputs: Array
    gain: Array
    z: Array
    cost: float


def first_guess(task: Task) -> Guess:
    """Return a closed-loop run of the task's model near the target.

    The cost is infinite if even this run diverges: the model can't follow the target.
    """
    x, u = filled_target(task)
    problem = task.problem()
    z = augmented(problem, x, u, task.past)
    received = problem.queue.effective(z[:-1], u)
    moved = problem.system.step(x[:-1], received, problem.p, problem.dt, problem.smoothing)
    about = dataclasses.replace(problem, bias=x[1:] - moved, start=x[0])
    sweep = problem.system.backward(about, z, u, np.zeros(task.model.m))
    if sweep.failed_at >= 0 or not np.isfinite(sweep.K).all():
        sweep = problem.system.backward(about, z, u, problem.change_weight + problem.input_weight)
    swarm = problem.system.rollout(
        problem, u, K=sweep.K, zbar=z[:-1], k=sweep.k, alphas=np.array([1.0, 0.5, 0.0])
    )
    cost = np.where(np.isfinite(swarm.cost), swarm.cost, np.inf)
    best = int(np.argmin(cost))
    return Guess(swarm.u[best], sweep.K, swarm.z[best], float(cost[best]))


def filled_target(task: Task) -> tuple[Array, Array]:
    """Return the target with every state and input filled in: x (H + 1, n), u (H, m)."""
    x, known = _read_off_path(task)
    trimmed, u = trim(task, x, known)
    last = np.where(known, x[-1], trimmed[-1])
    return np.vstack([trimmed, last]), u


def _read_off_path(task: Task) -> tuple[Array, NDArray[np.bool_]]:
    """Return x (H + 1, n) and which columns are prescribed (n,).

    Columns are the target where given, heading and speed from the path, else the start state.
    """
    model = task.model
    weighed = task.reward.state if task.reward.state.any() else task.reward.terminal
    given: NDArray[np.bool_] = np.isfinite(task.target).all(axis=0) & (weighed > 0)
    x = np.where(given, task.target, task.start)
    names = list(model.state_names)
    position = model.roles.get("position", ())
    columns = [names.index(p) for p in position if p in names] if len(position) >= 2 else []
    if len(columns) < 2 or not given[columns[:2]].all():
        return x, given
    velocity = np.gradient(x[:, columns], task.dt, axis=0)
    speed = np.linalg.norm(velocity, axis=1)
    heading, rate = model.roles.get("heading"), model.roles.get("speed")
    if isinstance(heading, str) and heading in names and not given[names.index(heading)]:
        column = names.index(heading)
        moving = speed > 1e-3 * max(float(speed.max()), 1e-12)
        angle = np.arctan2(velocity[:, 1], velocity[:, 0])
        first = angle[np.argmax(moving)] if moving.any() else task.start[column]
        last_moving = np.maximum.accumulate(np.where(moving, np.arange(len(x)), -1))
        angle = np.where(last_moving >= 0, angle[last_moving], first)
        start = task.start[column]
        turns = 2 * np.pi * np.rint((start - angle[0]) / (2 * np.pi))
        x[:, column] = np.unwrap(angle) + turns
        given[column] = True
    if isinstance(rate, str) and rate in names and not given[names.index(rate)]:
        x[:, names.index(rate)] = speed  # a first value; the trim may change it
    return x, given


def trim(task: Task, x: Array, known: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return x (H, n) with free columns solved for, and u (H, m), along a nominal run.

    Columns of x (H + 1, n) that are not known (n,) are a first guess.
    """
    H, free = task.horizon, np.flatnonzero(~known)
    batch, simulated = _steps(task, x, known), task.model.system.simulated
    most = FEW_KNOTS if simulated else KNOTS
    knots = np.linspace(0, H - 1, min(H, most)).round().astype(int)  # at least a step apart
    some, each = _distinct(x, knots) if simulated else (knots, np.arange(len(knots)))
    known_inputs = _inverse(task, x)
    starts = _starts(task, known_inputs, some)
    coarse = _from_scratch(batch, x[some][:, free], some, starts)
    w = coarse.w[each]
    at, base = np.arange(H), np.zeros((H, w.shape[1]))
    if known_inputs is not None:
        base[:, len(free) :] = known_inputs
    w = base + np.column_stack([np.interp(at, knots, c) for c in (w - base[knots]).T])
    w[:, len(free) :] = np.clip(w[:, len(free) :], task.low, task.high)
    if len(knots) < H and not simulated:
        w = solve(batch, w, at, MORE).w
    filled = x[:-1].copy()
    filled[:, free] = w[:, : len(free)]
    return filled, w[:, len(free) :]


def _steps(task: Task, x: Array, known: NDArray[np.bool_]) -> LeastSquares:
    """Return the equations of every step in w = [free states, inputs], as rates."""
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
        f_x, f_u = problem.system.linearise(state, u, *settings, problem.limits)
        J = np.concatenate([f_x[:, :, free], f_u], axis=2)
        J[:, :, : len(free)] -= np.eye(n)[:, free]
        J *= weight[:, None]
        return J

    rate = np.diff(x, axis=0)[:, known] / problem.dt
    nowhere, enough = (
        np.full(len(free), np.inf),
        EXACT_OF_SIMULATOR if problem.system.simulated else EXACT,
    )
    return LeastSquares(
        residual,
        jacobian,
        low=np.append(-nowhere, task.low),
        high=np.append(nowhere, task.high),
        solved=enough * (float(np.mean(rate**2)) + 1e-12),
    )


def _distinct(x: Array, knots: Rows) -> tuple[Rows, Rows]:
    """Return the knots whose steps differ, and where in them each knot's step is."""
    pairs = np.hstack([x[knots], x[knots + 1]])
    _, first, each = np.unique(pairs, axis=0, return_index=True, return_inverse=True)
    order = np.sort(first)
    return knots[order], np.searchsorted(order, first[each.reshape(-1)])


def _inverse(task: Task, x: Array) -> Array | None:
    """Return the inputs (H, m) of the model's own inverse dynamics along x (H + 1, n), if any."""
    found = task.model.system.inverse(x[:-1], x[1:], task.model.values, task.dt)
    return None if found is None else np.clip(found, task.low, task.high)


def _starts(task: Task, known: Array | None, knots: Rows) -> list[Array]:
    """Return several inputs (len(knots), m) from which the steps at the knots are solved."""
    held = np.tile(np.clip(task.past, task.low, task.high), (len(knots), 1))
    parts = STARTS[:FEW_STARTS] if task.model.system.simulated else STARTS
    starts = [_toward_limit(task, held, part) for part in parts]
    return starts if known is None else [known[knots], starts[0]]


def _from_scratch(
    batch: LeastSquares, states: Array, knots: Rows, starts: Sequence[Array]
) -> Minimum:
    """Solve from several inputs; each step keeps its best solution."""
    best = solve(batch, np.hstack([states, starts[0]]), knots, ITERATIONS)
    for start in starts[1:]:
        open_ = np.flatnonzero(best.error > batch.solved)
        if len(open_):
            w = np.hstack([states, start])[open_]
            best = best.better_of(solve(batch, w, knots[open_], ITERATIONS), open_)
    return best


def _toward_limit(task: Task, held: Array, part: float) -> Array:
    """Move inputs by a fraction of the way to the upper (if negative: lower) limit, if any."""
    limit = task.high if part >= 0 else task.low
    return held + abs(part) * (np.where(np.isfinite(limit), limit, held) - held)
