"""Step 5: the direction that improves a policy in the model that replays its trial."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from grounded.compile import DescentOptions, Problem
from grounded.frozen import Array
from grounded.policy import Policy
from grounded.search.step.step_size import SearchOptions
from grounded.solve import ddp
from grounded.solve.measured import measured_gains
from grounded.task import Task

if TYPE_CHECKING:
    from grounded.search.step.corrected import Corrected
    from grounded.solve.bias import Grounding

PLANNING = DescentOptions(max_iterations=30, tolerance=1e-6)  # precise enough for a direction


def direction(
    task: Task,
    policy: Policy,
    grounding: Grounding,
    options: SearchOptions,
    damping: float = 1.0,
    corrected: Corrected | None = None,
    measured: int | None = None,
) -> Policy:
    """Step 5: return theta' such that d = theta' - theta improves the policy in the biased model.

    Args:
        task: the manoeuvre, with the ORIGINAL model.
        policy: theta, the policy that ran the trial.
        grounding: the trial as the biased model replays it (step 4).
        options: selects algorithm A.
        damping: lambda of `step_size`, factor on the penalty mu for leaving the trial's inputs.
        corrected: the model with derivatives corrected by trials; None for the original model.
        measured: number of leading states that the robot measures; None for all of the task's.
            Gains on the memory of an adopted effect are replaced by gains on those
            (`measured_gains`). Gains on the memory of a corrected model are dropped
            (`feedback.margin` checks the effect).
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
        K = measured_gains(problem, found.z, found.u, K, measured, task.model.states)
    columns = base_columns(problem, task)
    return task.policy(found.u, K[:, :, columns], found.z[:-1, columns])


def base_columns(problem: Problem, task: Task) -> list[int]:
    """Return the columns of the problem's z that the task's z has as well."""
    own = map(problem.system.states.index, task.model.state_names)
    return [*own, *range(problem.system.n, problem.nz)]


def damped(problem: Problem, inputs: Array, factor: float = 1.0) -> Problem:
    """Add a penalty mu |u_t - inputs_t|^2 on leaving the trial's inputs (H, m) to the problem.

    A fully converged step goes to the optimum of the biased MODEL, which need not improve the real
    system. The penalty turns the step towards the gradient, which does as long as it is within 90
    degrees of the true one (section 3). mu is `factor` times R + S, the problem's own weights on
    inputs and their changes, as in norm-optimal iterative learning control. The two quadratic
    penalties on u_t combine to the weight R + mu about (R u_target + mu inputs) / (R + mu).
    """
    mu = factor * (problem.input_weight + problem.change_weight)
    weight = problem.input_weight + mu
    mixed = problem.input_weight * problem.input_target + mu * inputs
    safe = np.where(weight > 0, weight, 1.0)
    return replace(problem, input_weight=weight, input_target=mixed / safe)
