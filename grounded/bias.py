"""Step 4: the ORIGINAL model plus a time-dependent bias, so that it replays a trial exactly.

    f_t^(i+1)(s, a) = f_t(s, a) + s_{t+1}^(i) - f_t(s_t^(i), a_t^(i))

The bias is measured on one trial (or on the mean of repeated ones) and added to the model that was
never changed by an earlier trial: errors do not pile up. With an input shift rho (`matching.py`)
the model is asked about s, a - rho_t and still replays the trial; rho = 0 is the paper's. In the
biased model the trial's own policy gives the trial's own states, so derivatives are taken along the
true states (section 4.1).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from grounded.compile import Problem
from grounded.errors import GroundedError
from grounded.frozen import Array
from grounded.matching import input_shift
from grounded.rollout import augmented
from grounded.task import Task
from grounded.trial import Trial


@dataclass(frozen=True, eq=False)
class Grounding:
    """A trial as the biased model sees it: bias (H, n), z (H + 1, nz), inputs and shift (H, m)."""

    bias: Array
    z: Array
    inputs: Array
    shift: Array | None = None  # rho of `matching`, None for none

    def on(self, problem: Problem) -> Problem:
        """The problem with a model that replays the trial."""
        return replace(problem, bias=self.bias, input_shift=self.shift)


def effective_inputs(
    z: Array, inputs: Array, delay: Array, depths: tuple[int, ...], n: int
) -> Array:
    """What the actuators receive, (T, m): commands after their transport delay (in steps)."""
    received = np.empty_like(inputs)
    first = n
    for j, depth in enumerate(depths):
        queue = np.column_stack([inputs[:, j], z[: len(inputs), first : first + depth]])
        whole = int(np.floor(delay[j] + 1e-9))
        part = delay[j] - whole
        received[:, j] = queue[:, whole]
        if part > 1e-9:
            received[:, j] = (1 - part) * queue[:, whole] + part * queue[:, whole + 1]
        first += depth
    return received


def ground(
    task: Task,
    trial: Trial,
    *,
    exact: bool = False,
    match_inputs: bool = False,
    shift: Array | None = None,
) -> Grounding:
    """The bias that makes the task's model replay a trial (step 4).

    Args:
        task: gives the original model, with its latency.
        trial: a whole trial, finite for H steps; what follows is not used.
        exact: measure the bias of the exact model, not of the smoothed planning model.
        match_inputs: book on the inputs what inputs can explain (`matching.py`).
        shift: rho (H, m), where it is known already.

    Raises:
        GroundedError: if the trial is short or not finite: its bias is not known to the end.
    """
    trial = trial.until(task.horizon)
    if trial.steps < task.horizon or trial.finite_steps < trial.steps:
        raise GroundedError(
            f"a bias needs a whole trial of {task.horizon} steps; this one is finite for "
            f"{trial.finite_steps}"
        )
    problem = task.problem(exact=exact)
    z, received = _along(problem, trial)
    if match_inputs and shift is None:
        shift = input_shift(task.problem(), trial.states, received)
    asked = received if shift is None else received - shift
    predicted = problem.system.step(
        trial.states[:-1], asked, problem.p, problem.dt, problem.smoothing
    )
    # s_{t+1} - f(s_t, a_t); NOT wrapped: replay must land on the recorded number itself.
    return Grounding(trial.states[1:] - predicted, z, trial.inputs, shift)


def _along(problem: Problem, trial: Trial) -> tuple[Array, Array]:
    """A trial's z (T + 1, nz), and what the actuators received (T, m)."""
    past = problem.past if trial.start_inputs is None else trial.start_inputs
    z = augmented(problem, trial.states, trial.inputs, past)
    n = trial.states.shape[1]
    return z, effective_inputs(z, trial.inputs, problem.delay, problem.depths, n)


def residuals(task: Task, trial: Trial) -> Array:
    """One-step residuals of the exact model on a trial, (T, n), angles wrapped."""
    problem = task.problem(exact=True)
    _, received = _along(problem, trial)
    predicted = problem.system.step(trial.states[:-1], received, problem.p, problem.dt)
    return task.model.difference(trial.states[1:], predicted)
