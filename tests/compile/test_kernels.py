"""Compiled kernels against interpreted twins: rollouts, sweeps, whole solves, the loop of DDP."""

import threading
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from grounded.compile import system_of
from grounded.compile.kernel_words import MAX_INPUTS
from grounded.compile.names import Signature
from grounded.compile.problem import Controls, DescentOptions
from grounded.compile.run.compiled import CompiledSystem, Kernels
from grounded.compile.run.differenced import DifferencedSystem
from grounded.compile.run.interpreted import System
from grounded.compile.trace.graph import TooLong
from grounded.compile.trace.tracing import Trace, trace
from grounded.engine import Engine, each, running
from grounded.solve.ddp import descended, solve
from problems import SPECS, plain, problem

TIGHT = {"rtol": 1e-10, "atol": 1e-10}


class Twin(CompiledSystem):
    """Compiled steps and slopes; rollouts, sweeps and the loop in NumPy."""

    how = "twin"
    runs, backward, descend = System.runs, System.backward, System.descend


def twin(function, *, kind, states, inputs, params, integrator="rk4"):
    signature = Signature(function, kind, tuple(states), tuple(inputs), tuple(params))
    return Twin(signature, trace(signature, None, 1.0), integrator)


def plainly(function, *, kind, states, inputs, params, integrator="rk4"):
    """The function itself, differenced."""
    signature = Signature(function, kind, tuple(states), tuple(inputs), tuple(params))
    return DifferencedSystem(signature, integrator)


def pair(name, horizon=37, **changes):
    """The same problem for the compiled and for the interpreted system."""
    return problem(name, horizon, **changes), problem(name, horizon, make=twin, **changes)


@pytest.mark.parametrize(("delay", "limit"), [(0.4, np.inf), (2.7, 0.2)])
@pytest.mark.parametrize("name", sorted(SPECS))
def test_rollout_sweep_and_solve_agree(name, delay, limit):
    m = len(SPECS[name]["inputs"])
    changes = {
        "delay": np.full(m, delay),
        "low": np.full(m, -limit),
        "high": np.full(m, limit),
        "smoothing": 0.05,
        "input_shift": 0.02 * np.random.default_rng(3).normal(size=(37, m)) if delay else None,
    }
    fast, slow = pair(name, **changes)
    assert (fast.system.how, slow.system.how) == ("compiled", "twin")
    u = np.full((37, m), 0.15)
    a, b = fast.system.rollout(fast, u), slow.system.rollout(slow, u)
    assert np.allclose(a.z, b.z, **TIGHT) and np.allclose(a.cost, b.cost, **TIGHT)
    damping = np.full(m, 0.3)
    mine = fast.system.backward(fast, b.z[0], b.u[0], damping)
    theirs = slow.system.backward(slow, b.z[0], b.u[0], damping)
    assert np.allclose(mine.k, theirs.k, **TIGHT) and np.allclose(mine.K, theirs.K, **TIGHT)
    assert np.allclose((mine.d1, mine.d2), (theirs.d1, theirs.d2), **TIGHT)
    alphas = np.array([1.0, 0.5, 0.25, 0.1, 0.01])  # more than the lanes of one call
    a = fast.system.rollout(fast, u, theirs.K, b.z[0], theirs.k, alphas)
    b = slow.system.rollout(slow, u, theirs.K, b.z[0], theirs.k, alphas)
    assert np.allclose(a.z, b.z, **TIGHT) and np.allclose(a.u, b.u, **TIGHT)
    assert np.allclose(a.cost, b.cost, **TIGHT)
    x, y = solve(fast, u), solve(slow, u)
    assert (x.status, len(x.trace)) == (y.status, len(y.trace))
    assert np.allclose(x.u, y.u, **TIGHT) and np.allclose(x.K, y.K, **TIGHT)


def test_angles_wrap_in_cost_and_feedback():
    fast, slow = pair("pendulum")
    u = np.full((37, 1), 0.2)
    gains = slow.system.backward(slow, slow.system.rollout(slow, u).z[0], u, np.zeros(1))
    zbar = slow.system.rollout(slow, u).z[0]
    zbar[:, 0] += 4 * np.pi
    a = fast.system.rollout(fast, u, gains.K, zbar)
    b = slow.system.rollout(slow, u, gains.K, zbar)
    assert np.allclose(a.u, b.u, **TIGHT) and np.allclose(a.u[0], u, atol=1e-9)
    far = replace(fast, target=fast.target + np.array([2 * np.pi, 0.0]))
    cost = fast.system.rollout(fast, u).cost
    assert np.allclose(far.system.rollout(far, u).cost, cost, **TIGHT)


def test_step_kind_and_many_sizes():
    def step(s, a, p, dt):
        return {"x": s.x + dt * s.v, "v": s.v + dt * (a.f - p.c * s.v * abs(s.v)), "w": a.g * dt}

    names = {"states": ("x", "v", "w"), "inputs": ("f", "g", "h"), "params": ("c",)}
    fast = system_of(step, kind="step", **names)
    slow = plainly(step, kind="step", **names)
    rng = np.random.default_rng(0)
    for N in (0, 1, 2, 7, 8, 9, 33):
        x, u, p = rng.normal(size=(N, 3)), rng.normal(size=(N, 3)), np.array([0.4])
        assert fast.step(x, u, p, 0.1).shape == (N, 3)
        if N:
            assert np.allclose(fast.step(x, u, p, 0.1), slow.step(x, u, p, 0.1), **TIGHT)
        for mine, theirs in zip(
            fast.sensitivities(x, u, p, 0.1), slow.sensitivities(x, u, p, 0.1), strict=True
        ):
            assert mine.shape == theirs.shape and np.allclose(mine, theirs, rtol=1e-8, atol=1e-8)


def wide(n, m, make=system_of):
    """A random stable network of n states and m inputs as a problem of 12 steps."""
    rng = np.random.default_rng(n)
    A = rng.normal(size=(n, n)) / n
    B = rng.normal(size=(n, m))
    states, inputs = [f"x{i}" for i in range(n)], [f"u{j}" for j in range(m)]

    def network(s, a, p):
        x, u = np.array([s[k] for k in states]), np.array([a[k] for k in inputs])
        return dict(zip(states, A @ np.sin(x) - p.c * x + B @ u, strict=True))

    names = {"states": states, "inputs": inputs, "params": ("c",)}
    system = make(network, kind="derivative", integrator="rk4", **names)
    start, delay = rng.normal(size=n), rng.uniform(0, 1.5, m)
    bounds = {"low": np.full(m, -0.3), "high": np.full(m, 0.3)}
    return plain(system, np.array([0.5]), 12, 0.1, start=start, delay=delay, **bounds)


@pytest.mark.slow
@pytest.mark.parametrize(("n", "m"), [(1, 1), (6, 9)])
def test_sizes_written_out_and_looped(n, m):
    fast, slow = wide(n, m), wide(n, m, twin)
    assert fast.system.how == "compiled"
    u = np.zeros((12, m))
    run = slow.system.rollout(slow, u)
    mine = fast.system.backward(fast, run.z[0], u, np.zeros(m))
    theirs = slow.system.backward(slow, run.z[0], u, np.zeros(m))
    assert np.allclose(mine.k, theirs.k, **TIGHT) and np.allclose(mine.K, theirs.K, **TIGHT)
    assert (m > MAX_INPUTS) == (m == 9)  # beyond, the sweep is NumPy's
    if n > 1:
        assert np.any(np.isin(u + theirs.k, (-0.3, 0.3)))  # limits were met
    assert np.allclose(solve(fast, u).u, solve(slow, u).u, **TIGHT)


def test_many_models_in_threads():
    task, rng = problem("car", 50), np.random.default_rng(0)
    values = [task.p * rng.uniform(0.9, 1.1, len(task.p)) for _ in range(24)]

    def cost(p):
        return solve(replace(task, p=p), np.full((50, 2), 0.3)).cost

    with running(Engine(4), copied=False):
        assert each(cost, values) == [cost(p) for p in values]
        with pytest.raises(ZeroDivisionError):
            each(lambda i: 1 / i, [1, 0, 2])
    assert threading.stack_size() == 0


def test_too_many_operations_are_not_compiled(monkeypatch):
    from grounded.compile.run import compiled as package

    monkeypatch.setattr(package, "MAX_COMPILED", 20)
    monkeypatch.setattr("grounded.compile.run.compiled.UNCOUNTED", 0)
    assert problem("car").system.how == "compiled steps"
    monkeypatch.setattr(package, "MAX_STEPS", 20)
    task = problem("car")
    assert task.system.how == "differenced" and "operations" in task.system.note
    with pytest.raises(TooLong):
        from grounded.compile.trace.graph import Graph

        graph = Graph(limit=3)
        for i in range(5):
            graph.const(float(i))


def too_long(*args):
    raise TooLong("more than 10 operations")


def test_derivatives_too_long_to_be_written_out_are_differences(monkeypatch):
    whole, rng = problem("car").system, np.random.default_rng(0)
    x, u = rng.uniform(0.2, 0.9, (5, whole.n)), rng.uniform(0.2, 0.9, (5, whole.m))
    at = (x, u, problem("car").p, 0.05, 0.05)
    expected = whole.sensitivities(*at)

    with monkeypatch.context() as patch:  # by its parameters alone
        patch.setattr(Kernels, "full", too_long)
        system = problem("car").system
        assert system.how == "compiled"
        for _ in range(2):
            for mine, theirs in zip(system.sensitivities(*at), expected, strict=True):
                np.testing.assert_allclose(mine, theirs, rtol=1e-6, atol=1e-8)

    monkeypatch.setattr("grounded.compile.run.compiled.UNCOUNTED", 0)
    monkeypatch.setattr(Trace, "entries", too_long)
    system = problem("car").system
    assert system.how == "compiled steps" and "more than 10 operations" in system.note
    for mine, theirs in zip(system.sensitivities(*at), expected, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-6, atol=1e-8)


def test_steps_one_after_the_other_are_those_steps():
    from grounded.models.pendulum import model

    rng = np.random.default_rng(0)
    x, u = rng.standard_normal((7, model.n)), rng.standard_normal((30, 7, model.m))
    found = model.system.march(x, u, model.values, 0.02)
    for t in range(30):
        x = model.system.step(x, u[t], model.values, 0.02)
        assert (found[t + 1] == x).all()
    assert model.system.march(x, u[:0], model.values, 0.02).shape == (1, 7, model.n)


def test_functions_agree_with_numpy_where_they_branch():
    """Small angles and others, steep, behind and at the origin share vectors, or do not."""

    def step(s, a, p, dt):
        angle = np.arctan2(s.y, s.x)
        ratio = s.y / np.sqrt(1.0 + s.x**2 + s.y**2)
        return {
            "x": angle,
            "y": np.sin(angle) + np.cos(angle),
            "z": np.arcsin(ratio),
            "w": np.exp(s.x * p.c),
        }

    names = {"states": ("x", "y", "z", "w"), "inputs": ("u",), "params": ("c",)}
    fast, slow = (make(step, kind="step", **names) for make in (system_of, plainly))
    edge = np.tan(np.pi / 8)
    some = np.array([0.0, 1e-300, 0.1, edge, np.nextafter(edge, 1), 0.5, 0.6, 1.0, 3.0, 700.0])
    x, y = (v.ravel() for v in np.meshgrid(np.r_[-some, some], np.r_[-some, some]))
    rng, p = np.random.default_rng(0), np.array([1.02])
    for order in (np.arange(len(x)), rng.permutation(len(x))):
        states = np.column_stack([x[order], y[order], x[order], y[order]])
        u = np.zeros((len(x), 1))
        mine, theirs = (system.step(states, u, p, 0.1) for system in (fast, slow))
        assert np.allclose(mine, theirs, rtol=1e-14, atol=1e-15)


def test_a_failed_sweep_names_the_same_step():
    zero = np.zeros(1)
    fast, slow = pair("double_integrator", 9, input_weight=zero, change_weight=zero)
    weight = np.zeros((10, 2))
    weight[6:] = 1.0  # nothing to be minimised before step 5 but the future
    z, u = np.zeros((10, 3)), np.zeros((9, 1))
    for task in (fast, slow):
        task = replace(task, state_weight=np.zeros((10, 2)))
        assert task.system.backward(task, z, u, zero).failed_at == 8
        bad = z.copy()
        bad[4] = np.nan
        found = task.system.backward(replace(task, state_weight=weight), bad, u, np.ones(1))
        assert found.failed_at >= 0


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
    rates, H, dt = np.array([[3.0, 1.0], [0.0, -0.1]]), 6000, 0.02

    def rate(s, a, p):
        x = np.array([s["x0"], s["x1"]])
        return dict(zip(("x0", "x1"), rates @ x + np.array([1.0, 1e-3]) * a["u"], strict=True))

    names = {"states": ("x0", "x1"), "inputs": ("u",), "params": ()}
    system = system_of(rate, kind="derivative", integrator="euler", **names)
    task = plain(system, np.zeros(0), H, dt, start=np.ones(2), change_weight=np.zeros(1))
    found = system.backward(task, np.zeros((H + 1, 3)), np.zeros((H, 1)), np.zeros(1))
    assert found.failed_at == -1
    A, B = np.eye(2) + dt * rates, dt * np.array([[1.0], [1e-3]])
    V = solve_discrete_are(A, B, np.eye(2), np.eye(1))
    K = -np.linalg.solve(np.eye(1) + B.T @ V @ B, B.T @ V @ A)
    assert np.allclose(found.K[0, :, :2], K, rtol=1e-7)
