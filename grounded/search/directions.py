"""Step 5: the direction in which a policy improves in the model that replays a trial."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from grounded.compile import DescentOptions, Problem
from grounded.frozen import Array
from grounded.policy import Policy
from grounded.search.standing import SearchOptions
from grounded.solve import ddp
from grounded.solve.measured import measured_gains
from grounded.task import Task

if TYPE_CHECKING:
    from grounded.search.corrected import Corrected
    from grounded.solve.bias import Grounding

PLANNING = DescentOptions(max_iterations=30, tolerance=1e-6)  # a direction needs no more digits


def direction(
    task: Task,
    policy: Policy,
    grounding: Grounding,
    options: SearchOptions,
    damping: float = 1.0,
    corrected: Corrected | None = None,
    measured: int | None = None,
) -> Policy:
    """Step 5: theta' such that d = theta' - theta improves the policy in the biased model.

    Args:
        task: the manoeuvre, with the ORIGINAL model.
        policy: theta, the policy that ran the trial.
        grounding: the trial as the biased model replays it (step 4).
        options: which algorithm A.
        damping: lambda of `step_size`, the share of mu that leaving the trial's inputs costs.
        corrected: the model with slopes that trials have corrected; None: with its own.
        measured: how many of the first states the robot measures; None: all of the task's. Gains
            on an adopted effect's memory are made up for by those (`measured_gains`); on a
            corrected model's alone they are dropped (`feedback` weighs that).
    """
    if options.method == "policy-gradient":
        from grounded.solve.policy_gradient import ascent

        return ascent(task, policy, grounding)
    problem = grounding.on(task.problem())
    if options.step == "damped":
        problem = damped(problem, grounding.inputs, damping)
    z = grounding.z
    if corrected is not None:
        problem, z = corrected.on(problem), corrected.along(z)
    gains = ddp.sweep(problem, z, grounding.inputs).gains
    found = ddp.solve(problem, grounding.inputs, gains.K, z[:-1], PLANNING)
    K = found.K
    if measured is not None and measured < task.model.n:
        K = measured_gains(problem, found.z, found.u, K, measured)
    columns = base_columns(problem, task)
    return task.policy(found.u, K[:, :, columns], found.z[:-1, columns])


def base_columns(problem: Problem, task: Task) -> list[int]:
    """The columns of the problem's z that are the task's too."""
    own = map(problem.system.states.index, task.model.state_names)
    return [*own, *range(problem.system.n, problem.nz)]


def damped(problem: Problem, inputs: Array, factor: float = 1.0) -> Problem:
    """The problem with a price mu |u_t - inputs_t|^2 on leaving the trial's inputs (H, m).

    The fully converged step goes to the optimum of the biased MODEL, and that need not be uphill in
    the real system; with mu it turns towards the gradient, which is uphill while the
    model's derivatives are within 90 degrees (section 3). mu = R + S, the problem's own weights on
    inputs: the same idea as norm-optimal iterative learning control. Both quadratic penalties on
    u_t are one: weight R + mu about (R u_target + mu inputs) / (R + mu).
    """
    mu = factor * (problem.input_weight + problem.change_weight)
    weight = problem.input_weight + mu
    mixed = problem.input_weight * problem.input_target + mu * inputs
    safe = np.where(weight > 0, weight, 1.0)
    return replace(problem, input_weight=weight, input_target=mixed / safe)
