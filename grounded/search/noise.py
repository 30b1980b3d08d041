"""Noise of the sensors, estimated from trials, and what it costs in utility.

Sensor noise lowers every utility, since logged states are judged (`noise_cost`). A model that has
seen no trial predicts a run without it (`noise_missed`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from grounded.frozen import MEDIAN, Array, median
from grounded.policy import Policy
from grounded.search.candidate import Candidate
from grounded.task import Task
from grounded.trial import Trial

LATEST, ROWS = 9, 10_000  # trials from which the noise of the sensors is estimated; rows of each
HUGE = 1e100  # bound on the noise of a diverged run, in the state's unit
CHANCE = 3.0  # standard deviations of sensor noise by which one sample may differ
SLOW_S, SLOWER = 0.1, 3.0  # [s] of second differences; times the white noise, at most
WHITE = MEDIAN * 6**0.5  # median of absolute second differences of white noise of std 1
FEWEST = 10  # least number of second differences
SAME_START = 1e-9  # difference treated as zero, in the state's unit or relative to its value


def beyond_noise(trials: Sequence[Trial], off: Array, start: Array, predicted: Array) -> Array:
    """Return which start states differ from s_0 by more than the sensor noise, (n,) bool.

    `off` (N, n) is the first state of each trial of a candidate less s_0, its `start` (n,).
    """
    each = [sample_noise(trial, predicted) ** 2 for trial in trials]
    noise = np.sqrt(np.mean(each, axis=0) / len(trials))
    least = np.maximum(CHANCE * noise, SAME_START * np.maximum(1.0, np.abs(start)))
    return np.asarray(np.abs(np.mean(off, axis=0)) > least)


def sample_noise(trial: Trial, predicted: Array) -> Array:
    """Return the noise (std) of single samples of a run, (n,), also of filtered signals.

    The noise of a filtered speed changes little from sample to sample, so that second differences
    of neighbours don't show it. Those over SLOW_S show it, of what differs from the prediction, as
    the motion bends, too. They are bounded, since an error of the model bends as well.
    """
    white, lag = trial.noise(), max(1, round(SLOW_S / trial.dt))
    T = min(len(predicted), trial.finite_steps + 1)
    if 2 * lag + FEWEST > T:
        return white
    off = trial.states[:T] - predicted[:T]
    bends = np.abs(off[2 * lag :] - 2 * off[lag:-lag] + off[: -2 * lag])
    return np.asarray(np.clip(median(bends) / WHITE, white, SLOWER * white))


def sensor_noise(trials: Sequence[Trial], n: int) -> Array:
    """Return the noise (std) of a sample of each state's sensor, (n,); 0 without a trial.

    It is the median over the latest trials. The estimate of a single short run is off by a third
    either way. Of a long log its first rows are enough.
    """
    each = [trial.noise(ROWS) for trial in trials[-LATEST:]]
    return median(np.minimum(each, HUGE)) if each else np.zeros(n)


def noise_cost(task: Task, policy: Policy, noise: Array) -> float:
    """Return the mean loss of utility of a logged run due to sensor noise; >= 0.

    It counts the noise of weighted states and the inputs that the gains derive from it. The motion
    that these inputs cause is neglected: robots are slow compared with white noise. `noise` (n,)
    are standard deviations in the states' units.
    """
    reward, steps = task.reward, task.horizon
    cost = float(noise**2 @ ((steps + 1) * reward.state + reward.terminal))
    if policy.gain is None:
        return cost
    moved = policy.gain[:, :, : task.model.n] ** 2 @ noise**2  # (H, m): variances of inputs
    changes = moved + np.vstack([np.zeros_like(moved[:1]), moved[:-1]])
    return cost + float((moved @ reward.input + changes @ reward.input_change).sum())


def noise_missed(task: Task, made: Candidate, noise: Array) -> float:
    """Return how much of the cost of sensor noise in a log a candidate's prediction lacks; >= 0.

    All of it, if the model that predicted it replays no trial. Otherwise its bias contains the
    noise of the trial that it replays, and the predicted run shows it.
    """
    whole = noise_cost(task, made.policy, noise)
    return max(0.0 if made.grounded else whole, whole + made.predicted_utility)
