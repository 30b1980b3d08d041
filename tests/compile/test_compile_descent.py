"""The compiled loop of DDP against the loop in NumPy; long sweeps; memory that is used again."""

import numpy as np
import pytest

from grounded.compile import DescentOptions, Problem, system_of
from grounded.compile.problem import Controls
from grounded.solve.ddp import descended
from problems import problem


def swing_up(H):
    weight = np.zeros((H + 1, 2))
    weight[-1] = 100.0
    return problem(
        "pendulum", H, start=np.zeros(2), bias=np.zeros((H, 2)),
        target=np.tile([np.pi, 0.0], (H + 1, 1)), state_weight=weight,
        input_target=np.zeros((H, 1)), input_weight=np.array([0.01]),
        change_weight=np.array([0.001]), low=np.array([-2.0]), high=np.array([2.0]),
    )  # fmt: skip


def car():
    return problem("car", 60, delay=np.array([1.3, 0.0]))


@pytest.mark.parametrize("halvings", [0, 2, 11])
def test_the_compiled_loop_takes_the_decisions_of_the_loop_in_numpy(halvings):
    """Bit for bit: shorter steps, failed searches, a growing mu, the end of the iterations."""
    seen = set()
    tasks = (swing_up(60), 0.5, 100), (swing_up(200), 3.0, 20), (car(), 0.9, 100)
    for task, u0, most in tasks:
        H, m = task.horizon, task.system.m
        u = u0 * np.cos(np.arange(H * m) * 0.1).reshape(H, m)
        options = DescentOptions(max_iterations=most, halvings=halvings, accept=0.3)
        fast = task.system.descend(task, Controls(u), options)
        slow = descended(task, Controls(u), options)
        assert (fast.status, fast.cost, fast.failed_at) == (slow.status, slow.cost, slow.failed_at)
        for one in ("lines", "z", "u", "k", "K"):
            assert np.array_equal(getattr(fast, one), getattr(slow, one)), one
        seen |= set(slow.lines[:, 2]) | {slow.status}
    assert {0.0, 1.0, "converged", "max iterations"} < seen
    assert halvings == 0 or 0.5 in seen


def test_a_sweep_of_an_unstable_model_stays_symmetric_over_a_long_horizon():
    """What rounding leaves unsymmetric grows where the model is faster than its control."""
    from scipy.linalg import solve_discrete_are

    rates, H, dt = np.array([[3.0, 1.0], [0.0, -0.1]]), 6000, 0.02

    def rate(s, a, p):
        x = np.array([s["x0"], s["x1"]])
        return dict(zip(("x0", "x1"), rates @ x + np.array([1.0, 1e-3]) * a["u"], strict=True))

    names = {"states": ("x0", "x1"), "inputs": ("u",), "params": ()}
    system = system_of(rate, kind="derivative", integrator="euler", **names)
    free, ones = np.array([np.inf]), np.ones(1)
    task = Problem(
        system, p=np.zeros(0), dt=dt, start=np.ones(2), past=np.zeros(1), delay=np.zeros(1),
        bias=np.zeros((H, 2)), target=np.zeros((H + 1, 2)), state_weight=np.ones((H + 1, 2)),
        input_target=np.zeros((H, 1)), input_weight=ones, change_weight=0 * ones,
        low=-free, high=free, angles=np.zeros(2, bool),
    )  # fmt: skip
    found = system.backward(task, np.zeros((H + 1, 3)), np.zeros((H, 1)), np.zeros(1))
    assert found.failed_at == -1
    A, B = np.eye(2) + dt * rates, dt * np.array([[1.0], [1e-3]])
    V = solve_discrete_are(A, B, np.eye(2), np.eye(1))
    K = -np.linalg.solve(np.eye(1) + B.T @ V @ B, B.T @ V @ A)
    assert np.allclose(found.K[0, :, :2], K, rtol=1e-7)
