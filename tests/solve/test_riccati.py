"""The Riccati sweep against closed forms, brute force and its own predictions."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from grounded.compile.run.interpreted import box_qp
from grounded.solve.ddp import sweep
from problems import linear_least_squares, problem

DELAYS = [0.0, 0.4, 1.0, 2.3]


def brute_force_box(H, g, low, high):
    best, value = None, np.inf
    for pattern in itertools.product((-1, 0, 1), repeat=len(g)):
        side = np.array(pattern)
        k = np.where(side < 0, low, np.where(side > 0, high, 0.0))
        free = side == 0
        if free.any():
            k[free] = -np.linalg.solve(
                H[np.ix_(free, free)], g[free] + H[np.ix_(free, ~free)] @ k[~free]
            )
        if np.all((k >= low - 1e-12) & (k <= high + 1e-12)):
            J = g @ k + 0.5 * k @ H @ k
            if value > J:
                best, value = k, J
    return best


@pytest.mark.parametrize("m", [1, 2, 4])
def test_box_qp_is_the_brute_force_minimum(m):
    rng = np.random.default_rng(m)
    for _ in range(100):
        M = rng.normal(size=(m, m))
        H, g = M @ M.T + 0.01 * np.eye(m), 3 * rng.normal(size=m)
        low, high = -rng.uniform(0, 1, m), rng.uniform(0, 1, m)
        k, free = box_qp(H, g, low, high)
        assert np.allclose(k, brute_force_box(H, g, low, high), atol=1e-9)
        inside = (k > low) & (k < high)
        assert np.all(free[inside])


def test_infinite_horizon_gain_is_the_algebraic_riccati_solution():
    from scipy.linalg import solve_discrete_are

    H = 400
    task = problem(
        "double_integrator",
        H,
        bias=np.zeros((H, 2)),
        target=np.zeros((H + 1, 2)),
        state_weight=np.tile([2.0, 0.3], (H + 1, 1)),
        input_target=np.zeros((H, 1)),
        input_weight=np.array([0.5]),
        change_weight=np.zeros(1),
        start=np.zeros(2),
        past=np.zeros(1),
    )
    f_x, f_u = task.system.linearise(np.zeros((1, 2)), np.zeros((1, 1)), task.p, task.dt)
    A, B = f_x[0], f_u[0]
    X = solve_discrete_are(A, B, np.diag([2.0, 0.3]), np.array([[0.5]]))
    K = -np.linalg.solve(0.5 + B.T @ X @ B, B.T @ X @ A)
    gains = sweep(task, np.zeros((H + 1, 3)), np.zeros((H, 1))).gains
    assert np.allclose(gains.K[0, :, :2], K, atol=1e-7)
    assert np.allclose(gains.K[0, :, 2], 0, atol=1e-12)


@pytest.mark.parametrize("delay", DELAYS)
def test_one_sweep_solves_a_linear_problem(delay):
    task = problem("double_integrator", 25, delay=np.array([delay]))
    M, r = linear_least_squares(task)
    best = np.linalg.lstsq(M, r, rcond=None)[0].reshape(25, 1)
    run = task.system.rollout(task, np.zeros((25, 1)))
    gains = sweep(task, run.z[0], run.u[0]).gains
    new = task.system.rollout(task, run.u[0], gains.K, run.z[0], gains.k)
    assert np.allclose(new.u[0], best, atol=1e-6)
    # what the sweep predicts is what happens, at any alpha
    for alpha in (1.0, 0.3):
        some = task.system.rollout(task, run.u[0], gains.K, run.z[0], gains.k, np.array([alpha]))
        change = some.cost[0] - run.cost[0]
        assert change == pytest.approx(alpha * gains.d1 + alpha**2 * gains.d2, rel=1e-6)


@pytest.mark.parametrize("name", ["pendulum", "car"])
def test_heavy_damping_points_along_the_gradient(name):
    task = problem(name, 30, delay=np.full(2 if name == "car" else 1, 0.7))
    m = task.system.m
    u = 0.3 + np.zeros((30, m))
    run = task.system.rollout(task, u)
    gains = task.system.backward(task, run.z[0], u, np.full(m, 1e9))
    gradient = np.empty_like(u)
    for i in np.ndindex(*u.shape):
        up, down = u.copy(), u.copy()
        up[i] += 1e-5
        down[i] -= 1e-5
        J = [float(task.system.rollout(task, v).cost[0]) for v in (up, down)]
        gradient[i] = (J[0] - J[1]) / 2e-5
    assert np.allclose(-1e9 * gains.k, gradient, rtol=1e-4, atol=1e-4 * np.abs(gradient).max())


def test_clamped_inputs_get_no_feedback():
    task = problem("car", 30, low=np.array([-0.05, 0.2]), high=np.array([0.05, 0.6]))
    u = np.tile([0.05, 0.4], (30, 1))
    run = task.system.rollout(task, u)
    gains = sweep(task, run.z[0], u).gains
    new = u + gains.k
    assert np.all((new >= task.low) & (new <= task.high))
    clamped = (new == task.low) | (new == task.high)
    assert clamped.any() and not clamped.all()
    assert np.all(gains.K[clamped] == 0)


def test_a_cost_without_input_weights_is_regularised_not_raised():
    zero = np.zeros(1)
    task = problem("double_integrator", 5, input_weight=zero, change_weight=zero)
    task = replace(task, state_weight=np.zeros((6, 2)))
    found = sweep(task, np.zeros((6, 3)), np.zeros((5, 1)))
    assert found.ok and found.mu > 0
    bad = sweep(task, np.full((6, 3), np.nan), np.zeros((5, 1)))
    assert not bad.ok
