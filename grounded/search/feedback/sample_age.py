"""Find how old the samples are that a robot's policy acts on, and allow for it.

A program commands from the last sample that has reached it, while its log has the states at the
time of the command. It sees itself further back than it is, and so leads its reference. A model
that replays the recorded inputs replays that lead; but a policy that is planned about the replayed
run, and run on such samples again, leads by as much again, which no model promised.

So a policy pi is taken to see x - age dx/dt. The age is that of the incumbent's runs,

    age = argmin sum_t |u_t - pi_t(x_t - age dx_t/dt)|^2

to first order, from the commands and states in its logs. Predicted runs see the states so late
(`Problem.age`), and the reference of a new policy is late by as much, so that it runs on the robot
as planned. Logs of what the policy itself saw (all simulated ones) give an age of 0.

A timer that starts at random against the sensor's gives each run another age. The incumbent's is
then one draw, and a plan for it is off by as much as the next run's differs: plan for the mean.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from grounded.frozen import Array
from grounded.search.candidate import Candidate, Tried
from grounded.solve.bias import WINDOW, hann_smoothed
from grounded.task import Task
from grounded.trial import Trial

PROBED = 0.1  # age for the derivative of the commands, in steps
OLDEST = 2.0  # largest age, in steps; a program that acts on older samples needs another remedy
# smallest share of the squares of the commands' differences that an age explains
EXPLAINED_SHARE = 0.25
# ages differ if by more than both, in s and in steps: less costs little, and noise gives it too
DIFFERENT_S, DIFFERENT = 3e-3, 0.1
ROUNDING_OF_COMMANDS = 1e-6  # rms difference of commands, relative to their size, that is rounding


def sample_age(task: Task, candidate: Candidate, trials: Sequence[Trial]) -> float:
    """Return the age of the samples that a candidate's policy acted on [s]; 0 if none is clear.

    It is negative if the policy had newer samples than its logs, whose states are then late.

    Args:
        task: the manoeuvre, whose states the robot measures.
        candidate: the one whose policy acted.
        trials: its trials; of one that ended early, what there is counts.
    """
    policy = candidate.policy
    if policy.gain is None:
        return 0.0
    angles = tuple(map(bool, task.model.angle_mask))
    policy = policy.laid_out(task.model.state_names, angles, policy.depths)
    size = np.abs(policy.feedforward).max(axis=0) + 1e-12
    off, by_age = list[Array](), list[Array]()
    for trial in trials:
        T = min(task.horizon, trial.finite_steps)
        if T < WINDOW:
            continue
        x, sent = trial.states[:T], trial.inputs[:T]
        past = policy.past if trial.start_inputs is None else trial.start_inputs
        probed = PROBED * task.dt
        seen = np.stack([x, x - probed * rates(task, trial.until(T))])
        now, later = policy.commands(seen, past, sent[None])
        off.append((sent - now) / size)
        by_age.append((later - now) / probed / size)
    if not off:
        return 0.0
    e, g = np.concatenate(off), np.concatenate(by_age)
    squares = float(np.vdot(e, e))
    if not squares > ROUNDING_OF_COMMANDS**2 * e.size or not (steep := float(np.vdot(g, g))) > 0:
        return 0.0
    explains = float(np.vdot(g, e)) ** 2 / steep
    age = float(np.vdot(g, e)) / steep
    clear = explains > EXPLAINED_SHARE * squares and abs(age) <= OLDEST * task.dt
    return age if clear else 0.0


def planned_age(task: Task, incumbent: Tried, ages: Sequence[float]) -> float:
    """Return the age of samples to plan for [s]: that of the incumbent's runs, or of all runs.

    Args:
        task: the manoeuvre.
        incumbent: the best candidate, with its trials.
        ages: those of all runs [s], see `run_ages`.
    """
    if ages and different(task, min(ages), max(ages)):
        return float(np.mean(ages))
    return sample_age(task, incumbent.candidate, incumbent.trials)


def run_ages(task: Task, history: Sequence[Tried]) -> list[float]:
    """Return the age of the samples in each whole run of a policy with feedback [s]."""
    return [
        sample_age(task, one.candidate, [trial])
        for one in history
        for trial in one.trials
        if one.candidate.policy.gain is not None and trial.finite_steps >= task.horizon
    ]


def different(task: Task, age: float, other: float) -> bool:
    """Return whether two ages [s] differ by so much that it matters."""
    return abs(age - other) > max(DIFFERENT_S, DIFFERENT * task.dt)


def rates(task: Task, trial: Trial) -> Array:
    """Return the rate of each state along a trial's first H steps, (H, n), or all that it has.

    Its noise does not correlate with that of the state itself, which would give an age.
    """
    moved = task.model.difference(trial.states[1:], trial.states[:-1])[: task.horizon]
    mean = 0.5 * (moved + np.vstack([moved[:1], moved[:-1]])) / task.dt
    return np.column_stack([hann_smoothed(column, WINDOW - 1) for column in mean.T])
