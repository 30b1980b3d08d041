"""Check the stability margin of a loop with sensor noise and old samples, and adapt its gains.

A 100 Hz controller that uses the latest of 200 samples per second acts on data up to 5 ms old, and
sensors have noise. A predicted run follows its own reference and shows none of this. With a delay
or unmeasured memory in the model, the gains rely on fresh samples to a fraction of a step, because
the plan accounts for every command under way.

So the policy is simulated in its model under worse conditions: with noise, a fraction of the motion
in a step; with old samples, simulated as a later arrival of the inputs (interpolating samples would
hide the problem, since an input that alternates from step to step moves the robot between its
samples); and with dry friction that builds up slowly, because in the linearised model a joint that
sticks needs no gain, and would have none once it slips.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from grounded.compile import Problem
from grounded.frozen import Array
from grounded.policy import Policy, z_difference
from grounded.rollout import Rollout
from grounded.search.step.corrected import runs

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
