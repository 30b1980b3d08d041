"""DDP, the Riccati sweep and eq. (4) against closed forms, brute force and finite differences."""

import itertools

import numpy as np
import pytest

from grounded.compile.problem import DescentOptions
from grounded.compile.run.interpreted import box_qp
from grounded.errors import GroundedError
from grounded.model import Model, Param
from grounded.policy import Policy
from grounded.rollout import simulate
from grounded.solve.bias import ground
from grounded.solve.ddp import solve, sweep
from grounded.solve.policy_gradient import ascent, gradient
from grounded.task import Task
from grounded.trial import Trial
from grounded.utility import Reward
from problems import SPECS, linear_least_squares, problem
from small_tasks import plain_task


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
