"""Steps 1 and 2 of the paper: the policy that is optimal in the crude model.

A long manoeuvre is rarely solved from an open-loop start: the first rollout wanders off and DDP
never comes back. A swing-up, on the other hand, is not near its target for most of its time, and a
guess that stays there ends in a local optimum. So DDP starts from several runs, goes on from each
until it has converged, and the plan with the lowest cost wins:

    the reference    a closed-loop run of the model near the target (`first_guess`)
    zero inputs      and the inputs held before the start, where they are others
    smooth inputs    random, by fixed seeds: only where a solve takes milliseconds
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from grounded.compile import DescentOptions, Problem
from grounded.frozen import Array
from grounded.policy import Policy
from grounded.search.first_guess import first_guess
from grounded.solve import ddp
from grounded.task import Task

CAUTION = 100.0  # factor on the input penalties each time the first policy crashed
ITERATIONS = 1000  # of DDP at the most, from one start
AT_ONCE = 2e5  # control steps times iterations between two chances to interrupt: under a second
STARTS = 24  # random ones
KNOTS = (5, 8, 14)  # of a random start's inputs, in turn
AMPLITUDES = (0.05, 0.15, 0.4)  # of its knots, standard deviation as a share of an input's range
WORK = 4e7  # iterations x H x (n + m)^2 that all rivals of the reference may take
FEWEST = 10  # iterations: a rival that gets no more is not started
HOPELESS = 1e3  # times the best plan's cost: a start above it is not pursued

Tick = Callable[[str], None]


def first_policy(
    task: Task, caution: int = 0, tick: Tick | None = None
) -> tuple[Policy, ddp.Solution]:
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
) -> ddp.Solution:
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
    result = ddp.solve(problem, inputs, K, z, DescentOptions(max_iterations=piece))
    trace = list(result.trace)
    while result.status == "max iterations" and len(trace) < most:
        if tick is not None:
            tick(f"planning: {len(trace)} iterations, cost {result.cost:.4g}")
        options = DescentOptions(max_iterations=min(piece, most - len(trace)))
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
    steps = np.arange(H)
    for seed in range(STARTS):
        count, amplitude = KNOTS[seed % len(KNOTS)], AMPLITUDES[seed % len(AMPLITUDES)]
        knots = np.linspace(0, H - 1, count)
        drawn = np.random.default_rng(seed).normal(0.0, amplitude, (count, m)) * (high - low)
        smooth = [np.interp(steps, knots, column) for column in drawn.T]
        yield np.clip(zero + np.column_stack(smooth), task.low, task.high)
