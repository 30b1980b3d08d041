"""Forecasts: the crude model is set on the real state again and again, and runs on its own between.

This is the gap as one feels it: started from what was measured, with the inputs that were sent,
where is the model a second later? Every start is simulated at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from grounded.frozen import Array
from grounded.rollout import augmented
from grounded.search.planner import Planner
from grounded.solve.bias import residuals
from grounded.trial import Trial

SECONDS = 1.0


@dataclass(frozen=True, eq=False)
class Forecast:
    """States (W, k + 1, n) of W windows; steps (W, k + 1) of the trial, -1 beyond its end."""

    states: Array
    steps: np.ndarray

    def curve(self, column: int, dt: float) -> tuple[Array, Array]:
        """Times [s] and values of one state, windows in a row with NaN between."""
        values = np.where(self.steps >= 0, self.states[:, :, column], np.nan)
        steps = np.hstack([self.steps, self.steps[:, -1:]]).reshape(-1)
        gap = np.full((len(values), 1), np.nan)
        return np.maximum.accumulate(steps) * dt, np.hstack([values, gap]).reshape(-1)

    def along(self, trial: Trial) -> Array:
        """States (T + 1, n) of the trial as it was forecast; NaN where it was not.

        Where a window ends and the next one starts, it is the end that counts.
        """
        found = np.full_like(trial.states, np.nan)
        found[self.steps[:, 0]] = self.states[:, 0]
        for k in range(1, self.steps.shape[1]):
            known = self.steps[:, k] >= 0
            found[self.steps[known, k]] = self.states[known, k]
        return found


def forecast(planner: Planner, trial: Trial, seconds: float = SECONDS) -> Forecast | None:
    """The planner's model along a trial, started anew every `seconds`; None for less than a step.

    Args:
        planner: of the crude model, or of one with effects.
        trial: its finite part is used.
        seconds: between two starts.
    """
    whole, n = trial.finite_steps, planner.task.model.n
    if whole < 1:
        return None
    part = trial.until(whole)
    lifted, plan = anchored(planner, part), planner.plan
    problem = plan.problem(exact=True)
    past = plan.past if part.start_inputs is None else part.start_inputs
    z = augmented(problem, lifted.states, lifted.inputs, past)
    received = problem.queue.effective(z[:-1], lifted.inputs)
    length = max(1, min(round(seconds / trial.dt), whole))
    starts = np.arange(0, whole, length)
    x = lifted.states[starts]
    states, steps = [x[:, :n]], [starts]
    with np.errstate(all="ignore"):
        for k in range(length):
            at = np.minimum(starts + k, whole - 1)
            x = problem.system.step(x, received[at], problem.p, problem.dt)
            states.append(x[:, :n])
            steps.append(np.where(starts + k + 1 <= whole, starts + k + 1, -1))
    return Forecast(np.stack(states, axis=1), np.stack(steps, axis=1))


def anchored(planner: Planner, trial: Trial) -> Trial:
    """A finite trial with the planning model's memory, which keeps to the log where it can.

    The true value behind an old or lagging log is carried on by the model alone and drifts. What
    the model then misses of the log is that drift: it is added to the memory.
    """
    from grounded.effects.memory import true_values

    lifted, n = planner.lift(trial), planner.task.model.n
    names = planner.plan.model.state_names
    behind = true_values(names, names[n:])
    if not behind:
        return lifted
    drift, states = residuals(planner.plan, lifted), np.array(lifted.states)
    states[1:, list(behind)] += drift[:, list(behind.values())]
    return replace(lifted, states=states)


def forecast_error(planner: Planner, trial: Trial, seconds: float = SECONDS) -> Array:
    """Rms error (n,) at the end of whole windows; NaN where no window is whole."""
    found, n = forecast(planner, trial, seconds), planner.task.model.n
    if found is None:
        return np.full(n, np.nan)
    ends = found.steps[:, -1]
    kept = ends >= 0
    if not kept.any():
        return np.full(n, np.nan)
    real = trial.states[ends[kept]]
    off = planner.task.model.difference(found.states[kept, -1], real)
    return np.asarray(np.sqrt(np.mean(off**2, axis=0)))
