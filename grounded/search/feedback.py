"""Feedback gains that a real robot bears, though no prediction shows that it does not.

*Oscillation.* An input swings about its plan, by the plan's range or more. What a loop lacks to be
stable (a delay, a filter) is not in the model, so no prediction shows it; runs do.

*Old samples.* A program commands from the last sample that has reached it, while its log has the
states at the time of the command. It sees itself further back than it is, and so leads its
reference. A model that replays the recorded inputs replays that lead; but a policy that is planned
about the replayed run, and run on such samples again, leads by as much again.

So a policy pi is taken to see x - age dx/dt. The age is the mean over all runs of

    argmin sum_t |u_t - pi_t(x_t - age dx_t/dt)|^2

to first order, from the commands and states in its logs. Predicted runs see the states so late
(`Problem.age`), and the reference of a new policy is late by as much, so that it runs on the robot
as planned. Logs of what the policy itself saw (all simulated ones) give an age of 0.

A timer that starts at random against the sensor's gives each run another age. The incumbent's is
then one draw, and a plan for it is off by as much as the next run's differs: plan for the mean.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from grounded.frozen import Array, median
from grounded.search.candidate import Candidate, Tried
from grounded.solve.bias import WINDOW, hann_smoothed
from grounded.task import Task
from grounded.trial import Trial

# --- oscillation ----------------------------------------------------------------------------------

# fraction of an input's range within which it counts as at its limit; share of steps that is often
NEAR_LIMIT, OFTEN_AT_LIMIT = 0.01, 0.3
SWINGS = 6  # swings of an input about its plan by at least the plan's range: a limit cycle


def limit_cycle(tried: Tried, task: Task) -> bool:
    """Return whether feedback made an input oscillate in a candidate's trials, see `swings`."""
    plan = tried.candidate.predicted_inputs
    range_ = np.minimum(np.ptp(plan, axis=0), task.high - task.low)
    return any((swings(plan, trial.inputs, range_) >= SWINGS).any() for trial in tried.trials)


def swings(plan: Array, sent: Array, range_: Array) -> Array:
    """Count the swings of each input about its plan in a run, (m,) int.

    Each swing is at least as large as the plan's range. It must also exceed the median offset from
    the plan: a sagging load, or friction that holds a joint, needs its gains despite the noise that
    they amplify. An input whose range in the plan is 0 counts as never swinging.
    """
    T = min(len(plan), len(sent))  # a log may be longer
    if T < SWINGS:
        return np.zeros(len(range_), int)
    off = sent[:T] - plan[:T]
    sizes = np.maximum(range_, np.abs(median(off)))
    each = zip(off.T, sizes, range_, strict=True)
    return np.array([_swings(one, size) if of > 0 else 0 for one, size, of in each])


def between_limits(tried: Tried, task: Task) -> bool:
    """Return whether an input was at its limits, at both of them, for much of a trial."""
    range_ = task.high - task.low
    near = np.where(np.isfinite(range_), NEAR_LIMIT * range_, 0.0)
    for trial in tried.trials:
        at_low, at_high = trial.inputs <= task.low + near, trial.inputs >= task.high - near
        both = at_low.any(axis=0) & at_high.any(axis=0)
        if np.any(both & ((at_low | at_high).mean(axis=0) > OFTEN_AT_LIMIT)):
            return True
    return False


def _swings(values: Array, size: float) -> int:
    """Count how often a signal reverses and moves by `size` or more."""
    if not (np.abs(values - values[0]) >= size).any():  # as a rule
        return 0
    count, way, last = 0, 0.0, float(values[0])
    for value in values.tolist():  # Python's own numbers: three times as fast
        if (value - last) * way > 0:
            last = value
        elif abs(value - last) >= size:
            count, way, last = count + 1, math.copysign(1.0, value - last), value
    return count


# --- old samples ----------------------------------------------------------------------------------

PROBED = 0.1  # age for the derivative of the commands, in steps
OLDEST = 2.0  # largest age, in steps; a program that acts on older samples needs another remedy
# smallest share of the squares of the commands' differences that an age explains
EXPLAINED_SHARE = 0.25
ROUNDING_OF_COMMANDS = 1e-6  # rms difference of commands, relative to their size, that is rounding


def sample_age(task: Task, candidate: Candidate, trials: Sequence[Trial]) -> float:
    """Return the age of the samples that a candidate's policy acted on [s]; 0 if none is clear.

    It is negative if the policy had newer samples than its logs, whose states are then late. Of a
    trial that ended early, what there is counts.
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


def planned_age(task: Task, history: Sequence[Tried]) -> float:
    """Return the age of samples to plan for [s]: the mean of the whole runs with feedback, or 0."""
    each = [
        sample_age(task, one.candidate, [trial])
        for one in history
        for trial in one.trials
        if one.candidate.policy.gain is not None and trial.finite_steps >= task.horizon
    ]
    return float(np.mean(each)) if each else 0.0


def rates(task: Task, trial: Trial) -> Array:
    """Return the rate of each state along a trial's first H steps, (H, n), or all that it has.

    Its noise does not correlate with that of the state itself, which would give an age.
    """
    moved = task.model.difference(trial.states[1:], trial.states[:-1])[: task.horizon]
    mean = 0.5 * (moved + np.vstack([moved[:1], moved[:-1]])) / task.dt
    return np.column_stack([hann_smoothed(column, WINDOW - 1) for column in mean.T])
