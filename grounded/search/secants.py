"""What earlier trials say about the slopes: those of the model are wrong where a promise failed.

The biased model replays the incumbent, so its VALUE is right there; its SLOPES are the crude
model's. Every other trial j is a difference quotient of the real system about the incumbent. What
the grounded model mispredicts of it is, to first order in the change of inputs u_j - u,

    e_j = sum_t  dU/ds_t (s_t^j - s_t^model) + dU/du_t (u_t^j - u_t^model)  =  lambda . (u_j - u),

with the real slope of the utility that of the grounded model plus lambda (H, m). Trials that lost
say as much as those that won. They are fewer than the numbers in lambda, so it is a Gaussian
process: smooth in time over SMOOTH steps, every e_j with an error that grows with the square of its
distance, as a first-order expansion's does, with the second-order part of what was mispredicted
(known, since the utility is quadratic) and with the scatter of repeated trials. The direction is
then taken for the utility plus lambda . (u - u_incumbent): the modifiers of Marchetti, Chachuat &
Bonvin, "Modifier-adaptation methodology for real-time optimization", Ind. Eng. Chem. Res. 48, 2009.

It is asked only where a step has lost, or has given less than half its promise: where the model's
slopes hold, they need no correction, and fewer trials. The cart-pole with an actuator lag of 50 ms
stops 2.3 % short of its optimum, without it 3.2 % (docs/foreign.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from grounded.compile import Problem
from grounded.frozen import Array
from grounded.rollout import simulate
from grounded.search.candidate import Tried
from grounded.search.planner import Planner
from grounded.solve.bias import input_span
from grounded.trial import Trial, mean_trial

SMOOTH = 6.0  # steps: standard deviation of the kernel in time
ERROR = 0.1  # variance of the nearest trial's e_j, as a share of what the prior expects of it
BEYOND = 0.3  # standard deviation of e_j, as a share of the second-order part
NEAREST = 12  # trials that count
PREDICTED = 100  # trials at the most that are run in the model to find them


def slope_error(
    planner: Planner, incumbent: Tried, history: Sequence[Tried], grounded: Problem
) -> Array:
    """Lambda (H, m): the real slope of the utility by the inputs, less the grounded model's.

    Args:
        planner: the task, and the task as it is planned.
        incumbent: whose trial the model replays.
        history: all candidates with their trials.
        grounded: the exact model with the incumbent's bias.
    """
    task, H = planner.task, planner.task.horizon
    own = mean_trial(incumbent.trials, task.model.angle_mask)
    gradient = _Gradient(planner, own, grounded)
    moves: list[Array] = []
    errors: list[float] = []
    beyond: list[float] = []  # of second order
    noise: list[float] = []
    for tried in history[-PREDICTED:]:
        if tried is incumbent or not np.isfinite(tried.utility) or not tried.trials:
            continue
        trial = mean_trial(tried.trials, task.model.angle_mask)
        run = simulate(grounded, planner.widened(tried.candidate.policy))
        if trial.finite_steps < H or not np.isfinite(run.utility):
            continue
        moves.append((trial.inputs[:H] - own.inputs[:H]) / gradient.span)
        error = gradient.along(trial, run.states[:, : task.model.n], run.inputs)
        errors.append(error)
        beyond.append(tried.utility - run.utility - error)
        noise.append(1 / len(tried.trials) + 1 / len(incumbent.trials))
    if not moves:
        return np.zeros((H, task.model.m))
    scatter = [gradient.along(t, own.states, own.inputs) for t in incumbent.trials]
    variance = float(np.var(scatter, ddof=1)) if len(scatter) > 1 else 0.0
    noisy = variance * np.array(noise) + (BEYOND * np.array(beyond)) ** 2
    return _smoothest(np.array(moves), np.array(errors), noisy) / gradient.span


def _smoothest(moves: Array, errors: Array, noise: Array) -> Array:
    """The mean of lambda given errors (k,) along moves (k, H, m); noise (k,) variances."""
    distance = np.sqrt((moves**2).sum(axis=(1, 2)))
    near = np.argsort(distance, kind="stable")[:NEAREST]
    near = near[distance[near] > 1e-9]
    if not len(near):
        return np.zeros(moves.shape[1:])
    moves, errors, distance = moves[near], errors[near], distance[near]
    reach = int(4 * SMOOTH)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / SMOOTH) ** 2)
    kernel /= kernel.sum()
    H = moves.shape[1]
    smooth = np.empty_like(moves)
    for index in np.ndindex(len(moves), moves.shape[2]):
        column = (index[0], slice(None), index[1])
        smooth[column] = np.convolve(moves[column], kernel)[reach : reach + H]
    gram = np.tensordot(moves, smooth, axes=([1, 2], [1, 2]))
    own = np.diag(gram).copy()
    # the prior's scale is the size of the errors themselves, beyond their noise
    scale = float(np.median(np.maximum(errors**2 - noise[near], 0.0) / own))
    if scale == 0.0:
        return np.zeros(moves.shape[1:])
    spread = ERROR * own * (distance / distance[0]) ** 2 + noise[near] / scale
    weights = np.linalg.solve((gram + gram.T) / 2 + np.diag(spread), errors)
    return np.asarray(np.tensordot(weights, smooth, axes=1))


class _Gradient:
    """The slope of the utility by states and inputs along the incumbent's mean trial."""

    def __init__(self, planner: Planner, own: Trial, problem: Problem) -> None:
        self.model, n, H = planner.task.model, planner.task.model.n, problem.horizon
        inputs = own.inputs[:H]
        self.span = input_span(problem, inputs)
        error = self.model.difference(own.states[: H + 1], problem.target[:, :n])
        weight = problem.state_weight[:, :n]
        self.by_state = np.where(weight > 0, -2 * weight * np.nan_to_num(error), 0.0)
        change = np.diff(np.vstack([problem.past, inputs]), axis=0)
        self.by_input = -2 * problem.input_weight * (inputs - problem.input_target)
        self.by_input -= 2 * problem.change_weight * change
        self.by_input[:-1] += 2 * problem.change_weight * change[1:]

    def along(self, trial: Trial, states: Array, inputs: Array) -> float:
        """First-order change of the utility from states (H + 1, n), inputs (H, m) to a trial."""
        H = len(self.by_input)
        moved = self.model.difference(trial.states[: H + 1], states[: H + 1])
        by_inputs = np.sum(self.by_input * (trial.inputs[:H] - inputs[:H]))
        return float(np.sum(self.by_state * moved) + by_inputs)


def with_slope(problem: Problem, slope: Array) -> Problem:
    """The problem with the utility plus slope (H, m) . u, for inputs that have a price."""
    weight = problem.input_weight
    shift = np.where(weight > 0, slope / (2 * np.where(weight > 0, weight, 1.0)), 0.0)
    return replace(problem, input_target=problem.input_target + shift)
