"""Steps 1 and 2 of the paper: the policy that is optimal in the crude model.

A long manoeuvre is rarely solved from an open-loop start: the first rollout wanders off and DDP
never comes back. A swing-up, on the other hand, is not near its target for most of its time, and a
guess that stays there ends in a local optimum. So DDP starts from several runs, goes on from each
until it has converged, and the plan with the lowest cost wins:

    the reference    a closed-loop run of the model near the target (`first_guess`)
    zero inputs      and the inputs held before the start, where they are others
    smooth inputs    random, by fixed seeds: only where a solve takes milliseconds

The reference run is made in three moves:

1. Fill. The target gives the states that the running reward weighs. A heading or speed that it
   leaves out is read off its path (roles `position`, `heading`, `speed`). The other states and the
   inputs are TRIMMED at each step by itself: the values for which the model moves as the target
   does and the states that nobody prescribed hold still,

       f(x_t, u_t)_i = target_{t+1, i}  (known i),       f(x_t, u_t)_i = x_{t, i}  (unknown i)

   (`solve/trim.py`).
2. Ground the model on the filled target, as step 4 does on a trial, and take one LQR about it.
3. Roll that policy out, closed loop, in the model as it is: the start for DDP.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from grounded.compile import Problem
from grounded.frozen import Array
from grounded.policy import Policy
from grounded.rollout import augmented
from grounded.solve import ddp
from grounded.solve.bias import effective_inputs
from grounded.solve.trim import trim
from grounded.task import Task

CAUTION = 100.0  # factor on the input penalties each time the first policy crashed
ITERATIONS = 1000  # of DDP at the most, from one start
AT_ONCE = 2e5  # control steps times iterations between two chances to interrupt: under a second
STARTS = 12  # random ones
KNOTS = 8  # of a random start's inputs
AMPLITUDE = 0.075  # of its knots, standard deviation as a share of an input's range
WORK = 2e7  # iterations x H x (n + m)^2 that all rivals of the reference may take
FEWEST = 10  # iterations: a rival that gets no more is not started
HOPELESS = 1e3  # times the best plan's cost: a start above it is not pursued

Tick = Callable[[str], None]


def first_policy(
    task: Task, caution: int = 0, tick: Tick | None = None
) -> tuple[Policy, ddp.Result]:
    """The best converged plan of the crude model, as a policy.

    Args:
        task: the manoeuvre and the crude model.
        caution: how often a first policy has crashed; each time penalises inputs CAUTION x more.
        tick: told what is going on, about once a second.

    Returns:
        The policy, and the result of DDP that it is made of: its `status` says whether the plan
        has converged.
    """
    if caution:
        reward = replace(
            task.reward,
            input=task.reward.input * CAUTION**caution,
            input_change=np.maximum(task.reward.input_change, 1e-3) * CAUTION**caution,
        )
        task = replace(task, reward=reward)
    problem, guess = task.problem(), first_guess(task)
    best = finished(problem, guess.inputs, guess.gain, guess.z[:-1], tick=tick)
    rivals = list(_rivals(task))
    share = WORK / (max(len(rivals), 1) * problem.horizon * (problem.nz + task.model.m) ** 2)
    most = int(np.clip(share, FEWEST, ITERATIONS))
    for inputs in rivals if share >= FEWEST else rivals[:2]:
        cost = float(problem.system.rollout(problem, inputs).cost[0])
        if not np.isfinite(cost) or (best.ok and cost > HOPELESS * best.cost):
            continue
        found = finished(problem, inputs, most=most, tick=tick)
        if found.ok and (not best.ok or found.cost < best.cost * (1 - 1e-6)):
            best = found
    if best.status == "max iterations" and len(best.trace) < ITERATIONS:
        more = finished(problem, best.u, best.K, best.z[:-1], tick=tick)
        best = replace(more, trace=(*best.trace, *more.trace))
    return task.policy(best.u, best.K, best.z[:-1]), best


def finished(
    problem: Problem,
    inputs: Array,
    K: Array | None = None,
    z: Array | None = None,
    *,
    most: int = ITERATIONS,
    tick: Tick | None = None,
) -> ddp.Result:
    """DDP until it has converged, in pieces short enough for Ctrl-C.

    Args:
        problem: what to solve.
        inputs: (H, m) the first inputs.
        K: (H, m, nz) feedback of the first rollout, about `z`.
        z: (H, nz), see `K`.
        most: iterations at the most.
        tick: told how far it is, after each piece.
    """
    piece = int(np.clip(AT_ONCE / problem.horizon, 1, most))
    result = ddp.solve(problem, inputs, K, z, ddp.Options(max_iterations=piece))
    trace = list(result.trace)
    while result.status == "max iterations" and len(trace) < most:
        if tick is not None:
            tick(f"planning: {len(trace)} iterations, cost {result.cost:.4g}")
        options = ddp.Options(max_iterations=min(piece, most - len(trace)))
        result = ddp.solve(problem, result.u, result.K, result.z[:-1], options)
        trace += result.trace
    return replace(
        result,
        trace=tuple(trace),
        sentence=ddp.ending(result.status, len(trace)) or result.sentence,
    )


def _rivals(task: Task) -> Iterator[Array]:
    """Inputs (H, m) from which DDP may find a better plan than from the reference."""
    H, m = task.horizon, task.model.m
    zero = np.clip(np.zeros(m), task.low, task.high)
    yield np.tile(zero, (H, 1))
    held = np.clip(task.past, task.low, task.high)
    if not np.array_equal(held, zero):
        yield np.tile(held, (H, 1))
    if task.model.system.how != "compiled":
        return
    low = np.where(np.isfinite(task.low), task.low, zero - 1.0)
    high = np.where(np.isfinite(task.high), task.high, zero + 1.0)
    steps, knots = np.arange(H), np.linspace(0, H - 1, KNOTS)
    for seed in range(STARTS):
        drawn = np.random.default_rng(seed).normal(0.0, AMPLITUDE, (KNOTS, m)) * (high - low)
        smooth = [np.interp(steps, knots, column) for column in drawn.T]
        yield np.clip(zero + np.column_stack(smooth), task.low, task.high)


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
