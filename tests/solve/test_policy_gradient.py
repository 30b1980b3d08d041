"""Eq. (4) against finite differences, for both kinds of theta, and that its steps ascend."""

import numpy as np
import pytest

from grounded.model import Model, Param
from grounded.policy import Policy
from grounded.rollout import simulate
from grounded.solve.bias import ground
from grounded.solve.ddp import solve
from grounded.solve.policy_gradient import (
    ascent,
    gradient,
)
from grounded.trial import Trial
from problems import SPECS, problem
from small_tasks import plain_task

CASES = [(name, delay) for name in sorted(SPECS) for delay in (0.0, 1.4)]


def policy_of(task, u, K=None, zbar=None):
    spec = {spec["states"]: spec for spec in SPECS.values()}[task.system.states]
    return Policy(
        feedforward=u,
        low=task.low,
        high=task.high,
        dt=task.dt,
        state_names=task.system.states,
        input_names=spec["inputs"],
        depths=task.depths,
        angles=tuple(bool(a) for a in task.angles),
        past=task.past,
        gain=K,
        reference=zbar,
    )


def differences(cost, theta, h=1e-6):
    slope = np.empty_like(theta)
    for i in np.ndindex(theta.shape):
        up, down = theta.copy(), theta.copy()
        up[i] += h
        down[i] -= h
        slope[i] = (cost(up) - cost(down)) / (2 * h)
    return slope


@pytest.mark.parametrize(("name", "delay"), CASES)
def test_open_loop(name, delay):
    m = len(SPECS[name]["inputs"])
    shift = np.full((15, m), 0.05)
    task = problem(name, 15, delay=np.full(m, delay), smoothing=0.1, input_shift=shift)
    u = 0.4 + 0.1 * np.random.default_rng(1).normal(size=(15, m))
    z = task.system.rollout(task, u).z[0]
    near = differences(lambda v: float(task.system.rollout(task, v).cost[0]), u)
    found = gradient(task, z, u)
    assert found.gain is None
    assert np.allclose(found.inputs, near, rtol=1e-5, atol=1e-6 * np.abs(near).max())


@pytest.mark.parametrize(("name", "delay"), CASES)
def test_feedback_with_limits(name, delay):
    m = len(SPECS[name]["inputs"])
    task = problem(
        name, 8, delay=np.full(m, delay), smoothing=0.1, low=np.full(m, 0.2), high=np.full(m, 0.6)
    )
    rng = np.random.default_rng(2)
    u, K = rng.uniform(0.1, 0.7, (8, m)), 0.2 * rng.normal(size=(8, m, task.nz))
    zbar = 0.2 * rng.normal(size=(8, task.nz))
    run = task.system.rollout(task, u, K, zbar)

    def cost(v, gain):
        return float(task.system.rollout(task, v, gain, zbar).cost[0])

    found = gradient(task, run.z[0], run.u[0], policy_of(task, u, K, zbar))
    by_u, by_K = differences(lambda v: cost(v, K), u), differences(lambda L: cost(u, L), K)
    held = (run.u[0] == 0.2) | (run.u[0] == 0.6)
    assert held.any() and not held.all() and np.all(found.inputs[held] == 0)
    assert np.allclose(found.inputs, by_u, rtol=1e-5, atol=1e-6 * np.abs(by_u).max())
    assert np.allclose(found.gain, by_K, rtol=1e-5, atol=1e-6 * np.abs(by_K).max())


def cart(feedback):
    """A cart whose real mass is half of the model's."""
    spec = SPECS["double_integrator"]
    model = Model(
        states={"x": "m", "v": "m/s"},
        inputs={"force": "N"},
        params={name: Param(value) for name, value in spec["params"].items()},
        derivative=spec["function"],
    )
    target = np.column_stack([np.linspace(0, 1, 31), np.full(31, np.nan)])
    weights = {"effort": 0.01, "change": 0.1}
    task = plain_task(model, 0.1, target, [1.0, 0.0], 2.0, feedback=feedback, **weights)
    return task, task.with_model(model.with_values({"mass": 0.75}))


@pytest.mark.parametrize("feedback", [False, True])
def test_ascent_climbs_the_real_utility(feedback):
    task, real = cart(feedback)
    H, nz = 30, 3
    K = np.tile([-0.5, -0.4, 0.0], (H, 1, 1)) if feedback else None
    zbar = np.zeros((H, nz)) if feedback else None
    policy = task.policy(np.full((H, 1), 0.2), K, zbar)
    utilities = [simulate(real.problem(), policy).utility]
    for _ in range(40):
        run = simulate(real.problem(), policy)
        names = task.model.state_names, task.model.input_names
        d = ascent(task, policy, ground(task, Trial(run.states, run.inputs, task.dt, *names)))
        for alpha in 0.5 ** np.arange(8):  # steps 6 and 7: halving on the real system
            better = policy.toward(d, float(alpha))
            if simulate(real.problem(), better).utility > utilities[-1]:
                policy = better
                break
        utilities.append(simulate(real.problem(), policy).utility)
    best = -solve(real.problem(), np.zeros((H, 1))).cost
    assert utilities[-1] > utilities[0] + 0.9 * (best - utilities[0])
