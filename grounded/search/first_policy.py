"""Where DDP starts for the first policy: from the REFERENCE, not from zero inputs.

A long manoeuvre is rarely solved from an open-loop start: the first rollout wanders off and DDP
never comes back. So the target itself is made a nominal run, in three moves:

1. Fill. The target gives some states. A heading or speed that it leaves out is read off its path
   (roles `position`, `heading`, `speed`). The other states and the inputs are TRIMMED at each step
   by itself: the values for which the model moves as the target does and the states that nobody
   prescribed hold still,

       f(x_t, u_t)_i = target_{t+1, i}  (known i),       f(x_t, u_t)_i = x_{t, i}  (unknown i)

   (`trim.py`).
2. Ground the model on the filled target, as step 4 does on a trial, and take one LQR about it.
3. Roll that policy out, closed loop, in the model as it is: the start for DDP.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grounded.frozen import Array
from grounded.rollout import augmented
from grounded.solve.bias import effective_inputs
from grounded.solve.trim import trim
from grounded.task import Task


@dataclass(frozen=True, eq=False)
class Guess:
    """A nominal run of the model: inputs (H, m), gains (H, m, nz), augmented states (H + 1, nz)."""

    inputs: Array
    gain: Array
    z: Array
    cost: float


def first_guess(task: Task) -> Guess:
    """A closed-loop run of the task's model that stays near the target.

    The cost is infinite when even this run diverges: the model can't follow the target.
    """
    x, u = filled_target(task)
    problem = task.problem()
    z = augmented(problem, x, u, task.past)
    received = effective_inputs(z, u, problem.delay, problem.depths, task.model.n)
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
    """The target with every state and input filled in: x (H + 1, n), u (H, m)."""
    x, known = _read_off_path(task)
    trimmed, u = trim(task, x, known)
    last = np.where(known, x[-1], trimmed[-1])
    return np.vstack([trimmed, last]), u


def _read_off_path(task: Task) -> tuple[Array, NDArray[np.bool_]]:
    """Target states where given, heading and speed from the path, the start state elsewhere."""
    model = task.model
    given: NDArray[np.bool_] = np.asarray(np.isfinite(task.target).all(axis=0))
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
