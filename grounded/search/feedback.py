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

*Margin.* A 100 Hz controller that uses the latest of 200 samples per second acts on data up to 5 ms
old, and sensors have noise. A predicted run follows its own reference and shows none of this. With
a delay or unmeasured memory in the model, the gains rely on fresh samples to a fraction of a step,
because the plan accounts for every command under way.

So the policy is simulated in its model under worse conditions: with noise, a fraction of the motion
in a step; with old samples, simulated as a later arrival of the inputs (interpolating samples would
hide the problem, since an input that alternates from step to step moves the robot between its
samples); and with dry friction that builds up slowly, because in the linearised model a joint that
sticks needs no gain, and would have none once it slips.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from grounded.compile import Problem
from grounded.frozen import Array, median
from grounded.policy import Policy, z_difference
from grounded.rollout import Rollout
from grounded.search.candidate import Candidate, Tried
from grounded.search.corrected import runs
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
    they amplify.

    Args:
        plan: the predicted inputs (H, m).
        sent: those of the run (T, m).
        range_: of each input in the plan (m,); one with range 0 counts as never swinging.
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


# --- margin ---------------------------------------------------------------------------------------

AGES = (0.0, 0.3, 0.6)  # age of the samples, as a fraction of a step
NOISE, SEEDS = 0.1, 3  # noise, as a fraction of each state's rms motion in a step; number of draws
WORSE = 1.5  # most cost, relative to the predicted run, with which a loop counts as stable
MOST_COST = 1.3  # most mean cost relative to the best gains; gentler ones are more robust
CAUTIONS = (0.0, 0.25, 0.5, 0.75, 1.0, 1.25)  # gains that are tried, see `Maker._gently`


def steadied(
    problem: Problem,
    policy: Policy,
    run: Rollout,
    gently: Callable[[float], Policy],
    loose: Problem | None = None,
) -> Policy:
    """Return the policy if its loop is stable, else the gentlest gains of nearly the least cost.

    Args:
        problem: the problem that predicts its run.
        policy: the policy as a robot runs it.
        run: its run.
        gently: returns the same run with gains for larger input weights, given a caution.
        loose: the problem with dry friction that builds up slowly; None if there is none.
    """
    models = [problem] if loose is None else [problem, loose]
    own = worse_costs(models, policy)
    if own.max() <= WORSE * -run.utility:
        return policy
    gentler = [gently(caution) for caution in CAUTIONS]
    tried = [(own, policy), *zip(all_worse_costs(models, gentler), gentler, strict=True)]
    on_average = [np.log(np.maximum(found, np.finfo(float).tiny)).mean() for found, _ in tried]
    enough = min(on_average) + np.log(MOST_COST)
    if on_average[0] <= enough:
        return policy
    return next(
        one for (_, one), cost in zip(tried[::-1], on_average[::-1], strict=True) if cost <= enough
    )


def worse_costs(models: Sequence[Problem], policy: Policy) -> Array:
    """Return the cost of a policy with noise and old samples, (M, A) for M models and A ages.

    Args:
        models: the first one predicts the run.
        policy: the policy as a robot runs it, over the models' z or fewer states.
    """
    return np.asarray(all_worse_costs(models, [policy])[0], np.float64)


def all_worse_costs(models: Sequence[Problem], policies: Sequence[Policy]) -> Array:
    """Return the costs of policies as `worse_costs` does, (P, M, A) for P policies."""
    found = np.full((len(policies), len(models), len(AGES), SEEDS), np.inf)
    fed_back = [one for one, policy in enumerate(policies) if policy.gain is not None]
    if not fed_back:
        return np.asarray(found.mean(axis=3), np.float64)
    own = runs([models[0]] * len(fed_back), [policies[one] for one in fed_back])
    noisy = [_noisy(policies[one], run.states) for one, run in zip(fed_back, own, strict=True)]
    known = [one for one, some in zip(fed_back, noisy, strict=True) if some]
    for i, model in enumerate(models if known else ()):
        for j, age in enumerate(AGES):
            late = replace(model, delay=model.delay + age)
            tried = [run for some in noisy for run in some]
            costs = [-run.utility for run in runs([late] * len(tried), tried)]
            found[known, i, j] = np.reshape(costs, (len(known), SEEDS))
    return np.asarray(found.mean(axis=3), np.float64)


def _noisy(policy: Policy, states: Array) -> list[Policy]:
    """Return a policy with draws of noise fed back; none if its run diverges.

    Args:
        policy: with feedback.
        states: its predicted run (H + 1, n or more).
    """
    assert policy.gain is not None
    n = len(policy.state_names)
    moved = z_difference(states[:-1, :n], states[1:, :n], policy.angles[:n])
    size = NOISE * np.sqrt(np.mean(moved**2, axis=0))
    if not np.isfinite(size).all():
        return []
    found = []
    for seed in range(SEEDS):
        noise = size * np.random.default_rng(seed).normal(size=(policy.horizon, n))
        by_noise = np.einsum("tij,tj->ti", policy.gain[:, :, :n], noise)
        found.append(replace(policy, feedforward=policy.feedforward + by_noise))
    return found
