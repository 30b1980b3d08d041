"""Memory that follows the log: a sensor's delay is no drift of the model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from grounded.solve.bias import residuals
from grounded.trial import Trial
from grounded_trials.report.forecast import anchored, forecast
from grounded_trials.workspace.adopted import planner_of
from small_tasks import cart, cart_task

DELAY = 2  # steps by which x is logged late


def _logged(task, drag):
    """A run of the cart with another drag, its place logged late."""
    inputs = np.sin(np.arange(40) / 4)[:, None]
    states, p = np.zeros((41, 2)), cart.with_values({"drag": drag}).values
    for t in range(40):
        states[t + 1] = cart.system.step(states[t][None], inputs[t][None], p, task.dt)[0]
    late = np.r_[np.zeros(DELAY), states[:-DELAY, 0]]
    return Trial(np.column_stack([late, states[:, 1]]), inputs, task.dt, ("x", "v"), ("force",))


def test_a_late_log_is_not_taken_for_what_the_model_lacks():
    task = cart_task()
    planner = planner_of(task, [{"name": "sensor_delay:x", "d": DELAY * task.dt}])
    right, wrong = _logged(task, 0.2), _logged(task, 0.6)
    assert np.abs(residuals(planner.plan, anchored(planner, right))[:, 0]).max() < 1e-9
    free = residuals(planner.plan, planner.lift(wrong))[:, 0]
    kept = residuals(planner.plan, anchored(planner, wrong))[:, 0]
    assert np.abs(kept).max() < 0.2 * np.abs(free).max()


def _missed(planner, trial):
    """The rms error of forecasts of a trial, by state."""
    times, states = forecast(planner, trial, 1.0)
    off = states - trial.states[np.rint(times / trial.dt).astype(int)]
    return np.sqrt(np.nanmean(off**2, axis=0))


def test_a_forecast_starts_where_a_late_and_filtered_log_says_that_the_robot_was():
    task = cart_task()
    effects = [
        {"name": "sensor_delay:x", "d": DELAY * task.dt},
        {"name": "sensor_lag:v", "tau": 0.1},
    ]
    right = _logged(task, 0.2)
    v, a = [0.0], np.exp(-task.dt / 0.1)
    for mean in (right.states[1:, 1] + right.states[:-1, 1]) / 2:
        v.append(a * v[-1] + (1 - a) * mean)
    late = replace(right, states=np.column_stack([right.states[:, 0], v]))
    noisy = replace(late, states=late.states + 1e-3 * np.random.default_rng(0).normal(size=(41, 2)))
    knows, plain = (_missed(planner_of(task, some), noisy) for some in (effects, []))
    assert (knows < 0.5 * plain).all() and (knows < 0.02).all()
