"""DDP solves what is known, replays its own policy, and says why it stopped."""

import numpy as np
import pytest

from grounded.compile import DescentOptions
from grounded.errors import GroundedError
from grounded.model import Model
from grounded.solve.ddp import solve, sweep
from grounded.task import Task
from grounded.utility import Reward
from problems import linear_least_squares, problem


@pytest.mark.parametrize("delay", [0.0, 0.5, 2.0])
def test_linear_problem_with_limits_reaches_the_bounded_optimum(delay):
    from scipy.optimize import lsq_linear

    low, high = np.array([-0.1]), np.array([0.1])
    task = problem("double_integrator", 25, low=low, high=high, delay=np.array([delay]))
    M, r = linear_least_squares(
        problem("double_integrator", 25, delay=np.array([delay]))
    )  # same seed, no limits
    exact = lsq_linear(M, r, (low[0], high[0]), tol=1e-14)
    found = solve(task, np.zeros((25, 1)), options=DescentOptions(tolerance=1e-13))
    assert found.status == "converged"
    assert found.cost == pytest.approx(2 * exact.cost, rel=1e-9)
    assert np.allclose(found.u.ravel(), exact.x, atol=1e-4)
    assert np.any(found.u == high[0]) or np.any(found.u == low[0])


def test_pendulum_swings_up_and_the_policy_replays():
    H = 60
    weight = np.zeros((H + 1, 2))
    weight[-1] = 100.0
    task = problem(
        "pendulum",
        H,
        start=np.zeros(2),
        bias=np.zeros((H, 2)),
        target=np.tile([np.pi, 0.0], (H + 1, 1)),
        state_weight=weight,
        input_target=np.zeros((H, 1)),
        input_weight=np.array([0.01]),
        change_weight=np.array([0.001]),
    )
    found = solve(task, np.full((H, 1), 0.5))
    assert found.ok and found.cost < 12
    up = np.abs((found.z[-1, 0] - np.pi + np.pi) % (2 * np.pi) - np.pi)
    assert up < 0.1
    costs = [line.cost for line in found.trace]
    assert costs == sorted(costs, reverse=True)
    again = task.system.rollout(task, found.u, found.K, found.z)
    assert np.array_equal(again.z[0], found.z)


def test_solution_is_stationary():
    task = problem("car", 30, delay=np.array([1.3, 0.0]))
    found = solve(task, np.tile([0.1, 0.5], (30, 1)))
    assert found.ok
    rng = np.random.default_rng(1)
    for _ in range(5):
        d = rng.normal(size=found.u.shape) * 1e-3
        assert task.system.rollout(task, found.u + d).cost[0] >= found.cost


def test_a_damped_sweep_descends_and_shrinks_with_damping():
    task = problem("car", 30)
    u = np.tile([0.1, 0.5], (30, 1))
    run = task.system.rollout(task, u)
    size = np.inf
    for factor in (0.1, 1.0, 10.0):
        gains = sweep(task, run.z[0], u, factor).gains
        assert gains.d1 < 0 <= gains.d2
        assert np.abs(gains.k).sum() < size
        size = np.abs(gains.k).sum()
    new = task.system.rollout(task, u, gains.K, run.z[0], gains.k)
    assert new.cost[0] < run.cost[0]


def test_a_search_without_improvement_hands_out_the_gains_of_the_least_regularised_sweep():
    def friction(s, a, p):
        return {"x": s.v, "v": a.u - 2.0 * np.tanh(s.v / 0.005)}

    cart = Model({"x": "m", "v": "m/s"}, {"u": "N"}, {}, derivative=friction)
    target = np.full((151, 2), np.nan)
    target[:, 0] = 0.3 * (1 - np.cos(2 * np.pi * np.arange(151) * 0.02 / 3))
    small, free = np.full(1, 1e-3), np.zeros(2)
    reward, limit = Reward(np.array([10.0, 0.0]), free, small, small), np.full(1, 2.0)
    task = Task(cart, 0.02, target, reward, free, np.zeros(1), -limit, limit, smoothing=0.0)
    found = solve(task.problem(), np.zeros((150, 1)))
    assert found.status == "no improvement"
    least = sweep(task.problem(), found.z, found.u).gains
    np.testing.assert_allclose(found.K, least.K, rtol=0.1, atol=0.1 * np.abs(least.K).max())


def test_not_finite_is_a_status_that_names_the_step():
    task = problem("double_integrator", 10)
    u = np.zeros((10, 1))
    u[4] = np.nan
    found = solve(task, u)
    assert found.status == "not finite" and "step 5" in found.sentence and not found.ok


def test_wrong_shapes_are_errors():
    task = problem("double_integrator", 10)
    with pytest.raises(GroundedError, match=r"\(10, 1\)"):
        solve(task, np.zeros((9, 1)))
    with pytest.raises(GroundedError, match="reference"):
        solve(task, np.zeros((10, 1)), K=np.zeros((10, 1, 3)))
