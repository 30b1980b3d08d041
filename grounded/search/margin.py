"""Whether a loop holds where a robot acts on what it knows a little late, and not exactly.

A controller of 100 Hz that takes the latest of 200 samples a second acts on one that is up to 5 ms
old, and sensors have noise. A predicted run follows its own reference and shows nothing of this; a
model with a delay, or with memory that no sensor shows, makes gains that rely on fresh samples to
the last part of a step, for its plan counts on every command under way.

So the policy is run in its model under worse conditions: with noise of a part of what the run does
in a step; on old samples, which to the controller is a robot whose inputs arrive later by as much
(samples interpolated between two steps would show little: an input that swings from step to step
moves a robot between its samples alone); and with dry friction that builds up slowly, since as it
is linearised a joint that sticks needs no gain, and once it slips it has none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from grounded.compile import Problem
from grounded.frozen import Array
from grounded.policy import Policy, z_difference
from grounded.search.planner import predicted

AGES = (0.0, 0.3, 0.6)  # of a step: how old the samples are
NOISE, SEEDS = 0.1, 3  # of what each state does in a step, rms; and how often it is drawn
WORSE = 1.5  # times what the run is to cost: worse conditions cost no more where a loop holds
LITTLE = 1.3  # times what they cost at least, on average: gentler gains bear what no model knows
CAUTIONS = (0.0, 0.25, 0.5, 0.75, 1.0, 1.25)  # of `Maker`: gains that are tried


def steadied(
    problem: Problem,
    policy: Policy,
    gently: Callable[[float], Policy],
    loose: Problem | None = None,
) -> Policy:
    """The policy where it holds; else the gentlest gains that cost little more than the best.

    Args:
        problem: that predicts its run.
        policy: as a robot runs it.
        gently: the same run with gains for inputs that are dearer, by a caution.
        loose: the problem with dry frictions that build up slowly.
    """
    models = [problem] if loose is None else [problem, loose]
    own = worse_costs(models, policy)
    if own.max() <= WORSE * -predicted(problem, policy).utility:
        return policy
    tried = [(own, policy), *((worse_costs(models, one), one) for one in map(gently, CAUTIONS))]
    on_average = [np.log(np.maximum(costs, np.finfo(float).tiny)).mean() for costs, _ in tried]
    enough = min(on_average) + np.log(LITTLE)
    if on_average[0] <= enough:
        return policy
    return next(
        one for (_, one), cost in zip(tried[::-1], on_average[::-1], strict=True) if cost <= enough
    )


def worse_costs(models: Sequence[Problem], policy: Policy) -> Array:
    """What a policy's runs cost with noise and on samples of some AGES, in each model, (M, A).

    Args:
        models: the first one predicts the run.
        policy: over their z, or fewer states, as a robot runs it.
    """
    n = len(policy.state_names)
    run = predicted(models[0], policy)
    moved = z_difference(run.states[:-1, :n], run.states[1:, :n], policy.angles[:n])
    size = NOISE * np.sqrt(np.mean(moved**2, axis=0))
    costs = np.full((len(models), len(AGES), SEEDS), np.inf)
    if policy.gain is None or not np.isfinite(size).all():
        return np.asarray(costs.mean(axis=2), np.float64)
    for seed in range(SEEDS):
        noise = size * np.random.default_rng(seed).normal(size=(policy.horizon, n))
        by_noise = np.einsum("tij,tj->ti", policy.gain[:, :, :n], noise)
        noisy = replace(policy, feedforward=policy.feedforward + by_noise)
        for i, model in enumerate(models):
            for j, age in enumerate(AGES):
                late = replace(model, delay=model.delay + age)
                costs[i, j, seed] = -predicted(late, noisy).utility
    return np.asarray(costs.mean(axis=2), np.float64)
