"""Steps 1 and 2 of the paper: the policy that is optimal in the crude model.

A long manoeuvre is rarely solved from an open-loop start: the first rollout drifts away from the
target and DDP does not recover. A swing-up, on the other hand, is far from its target most of the
time, and a guess near the target ends in a local optimum. So DDP runs to convergence from several
starts, and the plan with the lowest cost is taken:

    reference        a closed-loop run of the model near the target (`first_guess`)
    constant inputs  zero, and the inputs held before the start if they differ
    smooth inputs    random, with fixed seeds; only for compiled models, which solve in milliseconds
    early plans      if those found several local optima of similar cost: plans from random inputs
                     that reach the final state early and stay there. The optimum of a quick
                     swing-up is too narrow to be found by chance

A simulator (`System.simulated`) takes a second an iteration. There a plan is improved until an
iteration promises less than ROUGH of its cost or gains less than ROUGH^2 of what standing still
costs (an error of a thousandth of the way). The start that costs least is first, and a rival gets
as many iterations as that took. Slopes are differences, which a joint that sticks or a contact
makes wrong: smaller promises are often not kept, and such a search would go on for as long again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from grounded.compile.problem import DescentOptions, Problem
from grounded.compile.run.interpreted import tracking_error
from grounded.frozen import Array
from grounded.policy import Policy
from grounded.search.first_guess import first_guess
from grounded.solve import ddp
from grounded.task import Task

CAUTION = 100.0  # factor on the input penalties for each crash of the first policy
ITERATIONS = 1000  # most iterations of DDP from one start
AT_ONCE = 2e5  # control steps times iterations between two chances to interrupt: under a second
STARTS = 24  # random starts
FURTHER_STARTS = 150  # further starts if there are local optima
KNOTS = (5, 8, 14)  # knots of a random start's inputs, in turn
AMPLITUDES = (0.05, 0.15, 0.4)  # standard deviation of the knots, as a share of the input's range
EARLY = (0.3, 0.8)  # shares of the task after which an early plan has to be in the final state
STAYED = 100  # iterations for such a plan
WORSE = 1.01  # factor of the best cost above which a plan counts as another optimum
WORK = 4e7  # budget for all rivals of the reference: iterations x H x (n + m)^2
SKETCH, PROMISING = 40, 1.3  # after so many iterations, a plan above this factor is dropped
MORE_WORK = 2e8  # budget for FURTHER_STARTS, in the same units
ROUGH = 1e-3  # relative gain of an iteration below which a simulator's plan is done
DAMPED = 4  # halvings of a simulator's damped step: more damping costs it less than more runs
FEWEST = 10  # a rival is not started with fewer iterations than this
CHECKED = 4  # steps of the plan at which the model's code is evaluated again to check it
HOPELESS, HOPELESS_SLOW = 1e6, 1e3  # factor of the best cost above which a start is dropped

Tick = Callable[[str], None]
Start = tuple[Array, Array | None, Array | None]  # inputs, feedback and its reference, see `solve`


def first_policy(
    task: Task, caution: int = 0, tick: Tick | None = None
) -> tuple[Policy, ddp.Solution]:
    """Return the best converged plan of the crude model, as a policy.

    Args:
        task: the manoeuvre and the crude model.
        caution: how often a first policy has crashed; each crash multiplies the input penalties by
            CAUTION.
        tick: called with a line of progress about once a second.

    Returns:
        The policy, and the DDP result that it is made from; its `status` says whether the plan has
        converged.

    Raises:
        GroundedError: if the model's output differs from when it was compiled (random numbers).
    """
    task = cautious(task, caution)
    problem, guess = task.problem(), first_guess(task)
    reference = (guess.inputs, guess.gain, guess.z[:-1])
    starts: list[Start] = [reference, *((inputs, None, None) for inputs in _rivals(task))]
    if problem.system.simulated:
        starts.sort(key=lambda start: _start_cost(problem, start))
    best, rivals = finished(problem, *starts[0], tick=tick), starts[1:]
    size = problem.horizon * (problem.nz + task.model.m) ** 2
    share = WORK / (len(rivals) * size)
    if problem.system.simulated:
        share = len(best.trace)
    most = int(np.clip(share, FEWEST, ITERATIONS))
    elsewhere = False
    for start in rivals if share >= FEWEST else rivals[:2]:
        found = _pursued(problem, start, best, most, tick)
        elsewhere |= _other_optimum(found, best)
        best = _better(found, best)
    if elsewhere and share >= FEWEST and task.model.system.how == "compiled":
        best = _hopped(task, problem, best, most, tick)
    if best.status == "max iterations" and len(best.trace) < ITERATIONS:
        more = finished(problem, best.u, best.K, best.z[:-1], tick=tick)
        best = replace(more, trace=(*best.trace, *more.trace))
    model, some = task.model, np.linspace(0, len(best.u) - 1, CHECKED).astype(int)
    if np.isfinite(best.z).all():
        model.system.check(best.z[some, : model.n], best.u[some], model.values, task.dt)
    return task.policy(best.u, best.K, best.z[:-1]), best


def cautious(task: Task, caution: int) -> Task:
    """Return the task with input weights CAUTION times larger for each crash of a first policy."""
    if not caution:
        return task
    width = task.high - task.low
    least = np.minimum(1e-3, np.where(np.isfinite(width), 4e-3 / width**2, 1e-3))  # in any unit
    reward = replace(
        task.reward,
        input=task.reward.input * CAUTION**caution,
        input_change=np.maximum(task.reward.input_change, least) * CAUTION**caution,
    )
    return replace(task, reward=reward)


def _hopped(
    task: Task, problem: Problem, best: ddp.Solution, most: int, tick: Tick | None
) -> ddp.Solution:
    """Return the best of many early plans; most are dropped before they converge."""
    rng, size = np.random.default_rng(STARTS), problem.horizon * (problem.nz + task.model.m) ** 2
    work = MORE_WORK
    for i in range(FURTHER_STARTS):
        early = _early(task, problem, rng, i)
        work -= size * len(early.trace)
        start = (early.u, early.K, early.z[:-1])
        found = finished(problem, *start, most=SKETCH, tick=tick) if early.ok else early
        work -= size * len(found.trace)
        if found.status == "max iterations":
            if found.cost > PROMISING * best.cost:
                continue
            found = finished(problem, found.u, found.K, found.z[:-1], most=most, tick=tick)
            work -= size * len(found.trace)
        best = _better(found, best)
        if work < 0:
            break
    return best


def finished(
    problem: Problem,
    inputs: Array,
    K: Array | None = None,
    z: Array | None = None,
    *,
    most: int = ITERATIONS,
    tick: Tick | None = None,
) -> ddp.Solution:
    """Run DDP from inputs (H, m) to convergence, in pieces short enough for Ctrl-C.

    Args:
        problem: what to solve.
        inputs: initial inputs.
        K: (H, m, nz) feedback of the first rollout, about z (H, nz).
        z: see K.
        most: most iterations.
        tick: called with a line of progress after each piece, of a simulator each iteration.
    """

    def told(count: int, cost: float) -> None:
        if tick is not None:
            tick(f"planning: {count} iterations, cost {cost:.4g}")

    piece = int(np.clip(AT_ONCE / problem.horizon, 1, most))
    options = DescentOptions(max_iterations=piece)
    if problem.system.simulated:
        still = tracking_error(problem, np.tile(problem.z_start(), (problem.horizon + 1, 1)))
        enough = ROUGH**2 * float(np.sum(problem.state_weight * still**2))
        options = DescentOptions(most, ROUGH, damped=DAMPED, enough=enough)
    result = ddp.solve(problem, inputs, K, z, options, told)
    trace = list(result.trace)
    while result.status == "max iterations" and len(trace) < most:
        told(len(trace), result.cost)
        options = replace(options, max_iterations=min(piece, most - len(trace)))
        result = ddp.solve(problem, result.u, result.K, result.z[:-1], options)
        trace += result.trace
    return replace(
        result,
        trace=tuple(trace),
        sentence=ddp.ending(result.status, len(trace)) or result.sentence,
    )


def _pursued(
    problem: Problem, start: Start, best: ddp.Solution, most: int, tick: Tick | None
) -> ddp.Solution | None:
    """Run DDP from a start; return None if the initial cost is hopelessly high."""
    cost = _start_cost(problem, start)
    cheap = problem.system.how == "compiled" and most > FEWEST
    most_cost = HOPELESS if cheap else HOPELESS_SLOW
    if not np.isfinite(cost) or (best.ok and cost > most_cost * best.cost):
        return None
    return finished(problem, *start, most=most, tick=tick)


def _start_cost(problem: Problem, start: Start) -> float:
    """Return the cost of the run that DDP starts from; infinite if it diverges."""
    cost = float(problem.system.rollout(problem, *start).cost[0])
    return cost if np.isfinite(cost) else np.inf


def _better(found: ddp.Solution | None, best: ddp.Solution) -> ddp.Solution:
    if found is None or not found.ok or (best.ok and found.cost >= best.cost * (1 - 1e-6)):
        return best
    return found


def _other_optimum(found: ddp.Solution | None, best: ddp.Solution) -> bool:
    """Return whether two plans have converged to different optima of similar cost."""
    if found is None or (found.status, best.status) != ("converged", "converged"):
        return False
    low, high = sorted((found.cost, best.cost))
    return WORSE * low < high < PROMISING * low


def _rivals(task: Task) -> Iterator[Array]:
    """Yield inputs (H, m) from which DDP may find a better plan than from the reference."""
    H, m = task.horizon, task.model.m
    zero = np.clip(np.zeros(m), task.low, task.high)
    yield np.tile(zero, (H, 1))
    held = np.clip(task.past, task.low, task.high)
    if not np.array_equal(held, zero):
        yield np.tile(held, (H, 1))
    if task.model.system.how != "compiled":
        return
    for seed in range(STARTS):
        count, amplitude = KNOTS[seed % len(KNOTS)], AMPLITUDES[seed % len(AMPLITUDES)]
        smooth = _smooth(task, np.random.default_rng(seed), count, amplitude)
        yield np.clip(zero + smooth, task.low, task.high)


def _early(task: Task, problem: Problem, rng: np.random.Generator, i: int) -> ddp.Solution:
    """Return a plan in which all states from a random step on have at least the final weights."""
    weight, begin = problem.state_weight.copy(), int(task.horizon * rng.uniform(*EARLY))
    weight[begin:] = np.maximum(weight[begin:], weight[-1])
    smooth = _smooth(task, rng, KNOTS[1 + i % 2], AMPLITUDES[1 + i // 2 % 2])
    inputs = np.clip(smooth, task.low, task.high)
    return finished(replace(problem, state_weight=weight), inputs, most=STAYED)


def _smooth(task: Task, rng: np.random.Generator, count: int, amplitude: float) -> Array:
    """Return random inputs (H, m) about zero, piecewise linear between `count` knots."""
    knots = np.linspace(0, task.horizon - 1, count)
    drawn = rng.normal(0.0, amplitude, (count, task.model.m)) * _range(task)
    steps = np.arange(task.horizon)
    return np.column_stack([np.interp(steps, knots, column) for column in drawn.T])


def _range(task: Task) -> Array:
    """Return the range of each input (m,); without a limit, one unit from zero to that side."""
    zero = np.clip(np.zeros(task.model.m), task.low, task.high)
    low = np.where(np.isfinite(task.low), task.low, zero - 1.0)
    return np.asarray(np.where(np.isfinite(task.high), task.high, zero + 1.0) - low)
