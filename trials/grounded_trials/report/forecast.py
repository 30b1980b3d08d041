"""Forecasts: rollouts of a model along a trial, restarted from the measured state periodically.

They show the gap between model and reality: from a measured state, with the inputs that were sent,
where does the model predict the robot a second later? All rollouts are simulated at once.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from grounded.frozen import Array
from grounded.places import true_values
from grounded.rollout import augmented
from grounded.search.planner import Planner
from grounded.solve.bias import residuals
from grounded.trial import Trial

SECONDS = 1.0


def forecast(planner: Planner, trial: Trial, seconds: float = SECONDS) -> tuple[Array, Array]:
    """Forecast a trial with the planner's model, restarted every `seconds`.

    Args:
        planner: planner of the crude model, or of one with effects.
        trial: the trial, of which the finite part is used: a complete step or more.
        seconds: length of a rollout [s]; each starts where the last one ends.

    Returns:
        Times (K,) [s] and states (K, n), with a row of NaN after each rollout.
    """
    whole, n, plan = trial.finite_steps, planner.task.model.n, planner.plan
    part = trial.until(whole)
    lifted, problem = anchored(planner, part), plan.problem(exact=True)
    past = plan.past if part.start_inputs is None else part.start_inputs
    z = augmented(problem, lifted.states, lifted.inputs, past)
    received = problem.queue.effective(z[:-1], lifted.inputs)
    length = max(1, min(round(seconds / trial.dt), whole))
    starts = np.arange(0, whole, length)
    x = lifted.states[starts]
    states = np.full((len(starts), length + 2, n), np.nan)
    states[:, 0] = x[:, :n]
    with np.errstate(all="ignore"):
        for k in range(length):
            at, inside = np.minimum(starts + k, whole - 1), starts + k < whole
            x = problem.system.step(x, received[at], problem.p, problem.dt)
            states[inside, k + 1] = x[inside, :n]
    steps = np.minimum(starts[:, None] + np.minimum(np.arange(length + 2), length), whole)
    return steps.reshape(-1) * trial.dt, states.reshape(-1, n)


def anchored(planner: Planner, trial: Trial) -> Trial:
    """Extend a finite trial by the planning model's memory states, without their drift.

    The true value of a state that is logged late or with a lag follows from the model alone, and
    drifts. The model's residual of that state is the drift, and is added to the memory.
    """
    lifted, n = planner.lift(trial), planner.task.model.n
    names = planner.plan.model.state_names
    behind = true_values(names, names[n:])
    if not behind:
        return lifted
    drift, states = residuals(planner.plan, lifted), np.array(lifted.states)
    states[1:, list(behind)] += drift[:, list(behind.values())]
    return replace(lifted, states=states)
