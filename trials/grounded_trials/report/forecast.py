"""Forecasts: rollouts of a model along a trial, restarted from the measured state periodically.

They show the gap between model and reality: from a measured state, with the inputs that were sent,
where does the model predict the robot a second later? Of a sensor that is late they start from the
true value, as a filter tells it. All rollouts are simulated at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from grounded.estimate import NoiseStd, batch_of, first_noise, record_of, smoothed
from grounded.frozen import Array
from grounded.places import true_values
from grounded.rollout import augmented
from grounded.search.planner import Planner
from grounded.solve.bias import residuals
from grounded.trial import Trial

SECONDS = 1.0
STARTS = 500  # most rollouts of which an rms error is taken


@dataclass(frozen=True, eq=False)
class Forecast:
    """W rollouts: states (W, k + 1, n) and steps of the trial (W, k + 1), -1 beyond its end."""

    states: Array
    steps: np.ndarray

    def curve(self, column: int, dt: float) -> tuple[Array, Array]:
        """Return times [s] and values of one state, with NaN between rollouts."""
        values = np.where(self.steps >= 0, self.states[:, :, column], np.nan)
        steps = np.hstack([self.steps, self.steps[:, -1:]]).reshape(-1)
        gap = np.full((len(values), 1), np.nan)
        return np.maximum.accumulate(steps) * dt, np.hstack([values, gap]).reshape(-1)


def forecast(
    planner: Planner, trial: Trial, seconds: float = SECONDS, every: int = 0
) -> Forecast | None:
    """Forecast a trial with the planner's model, restarted every `seconds`.

    Args:
        planner: planner of the crude model, or of one with effects.
        trial: the trial, of which the finite part is used.
        seconds: length of a rollout [s].
        every: steps between two starts; 0: a rollout starts where the last one ends.

    Returns:
        The forecast; None if the trial has no complete step.
    """
    whole, n = trial.finite_steps, planner.task.model.n
    if whole < 1:
        return None
    part = trial.until(whole)
    lifted, plan = _known(planner, part), planner.plan
    problem = plan.problem(exact=True)
    past = plan.past if part.start_inputs is None else part.start_inputs
    z = augmented(problem, lifted.states, lifted.inputs, past)
    received = problem.queue.effective(z[:-1], lifted.inputs)
    length = max(1, min(round(seconds / trial.dt), whole))
    starts = np.arange(0, whole, every or length)
    x = lifted.states[starts]
    states, steps = [x[:, :n]], [starts]
    with np.errstate(all="ignore"):
        for k in range(length):
            at = np.minimum(starts + k, whole - 1)
            x = problem.system.step(x, received[at], problem.p, problem.dt)
            states.append(x[:, :n])
            steps.append(np.where(starts + k + 1 <= whole, starts + k + 1, -1))
    return Forecast(np.stack(states, axis=1), np.stack(steps, axis=1))


def _known(planner: Planner, trial: Trial) -> Trial:
    """Extend a finite trial by the planning model's memory states, as past samples tell them.

    Of a sensor that is late, a filter estimates the true value. Its motion is as uncertain as a
    tenth of its change in a step, see `first_noise`.
    """
    lifted, model, n = anchored(planner, trial), planner.plan.model, planner.task.model.n
    behind = true_values(model.state_names, model.state_names[n:])
    if not behind:
        return lifted
    seen = np.where(np.arange(model.n) < n, lifted.states, np.nan)
    seen[0] = lifted.states[0]  # before the start they were settled
    logged = record_of(model, replace(lifted, states=seen))
    latency = planner.plan.latency
    assert latency is not None
    noise = first_noise(batch_of([logged], latency))
    known = noise.measurement.copy()
    for memory, log in behind.items():
        known[memory] = known[log]
    noise = NoiseStd(noise.process, known, noise.dt)
    [found] = smoothed(model, [logged], noise, latency=latency, forward=True)
    states = np.array(lifted.states)
    states[:, list(behind)] = found.states[:, list(behind)]
    return replace(lifted, states=states) if np.isfinite(states).all() else lifted


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


def forecast_error(planner: Planner, trial: Trial, seconds: float = SECONDS) -> Array:
    """Return the rms error (n,) at the end of complete rollouts; NaN if none is complete.

    They start at every step, of a long trial at every few: those that are drawn are too few, one in
    a trial of 1.5 s, which may by chance end near the log.
    """
    every, n = math.ceil(max(trial.finite_steps, 1) / STARTS), planner.task.model.n
    found = forecast(planner, trial, seconds, every)
    if found is None:
        return np.full(n, np.nan)
    ends = found.steps[:, -1]
    kept = ends >= 0
    if not kept.any():
        return np.full(n, np.nan)
    real = trial.states[ends[kept]]
    off = planner.task.model.difference(found.states[kept, -1], real)
    return np.asarray(np.sqrt(np.mean(off**2, axis=0)))
