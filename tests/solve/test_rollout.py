"""A simulated run is what the runner would do; a plant differs from it where reality does."""

import numpy as np
import pytest

from facts import holding
from grounded.compile.run.interpreted import linearised
from grounded.errors import GroundedError
from grounded.model import Model, Param
from grounded.onboard import Runner
from grounded.plant import Noise, Plant
from grounded.rollout import augmented, simulate
from grounded.search.first_policy import first_policy
from grounded.solve.measured import measured_gains
from grounded_trials.workspace.adopted import planner_of
from small_tasks import cart, cart_task, other, plain_task, rover, rover_task


def feedback_policy(task, seed=0):
    problem, rng = task.problem(), np.random.default_rng(seed)
    H, m, nz = task.horizon, task.model.m, problem.nz
    low, high = np.maximum(task.low, -1), np.minimum(task.high, 1)
    return task.policy(
        rng.uniform(low, high, (H, m)),
        0.2 * rng.normal(size=(H, m, nz)),
        rng.normal(size=(H, nz)),
    )


@pytest.mark.parametrize("delay", [0.0, 0.5, 1.0, 1.3, 2.0])
def test_a_rollout_is_the_runner_in_the_model(delay):
    task = rover_task(latency=np.array([delay * 0.05, 0.02]))
    policy = feedback_policy(task)
    run = simulate(task.problem(exact=True), policy)
    runner, x = Runner(policy), task.start
    sent = [task.past, task.past, task.past]
    for t in range(task.horizon):
        np.testing.assert_allclose(run.states[t], x, atol=1e-10)
        u = runner.action(t * task.dt, x)
        np.testing.assert_allclose(run.inputs[t], u, atol=1e-9)
        sent.append(u)
        received = []
        for j, d in enumerate(task.latency / task.dt):
            whole, part = int(d), d - int(d)
            older = sent[-2 - whole][j]
            received.append((1 - part) * sent[-1 - whole][j] + part * older)
        x = rover.system.step(x[None], np.array([received]), rover.values, task.dt)[0]
    np.testing.assert_allclose(run.states[-1], x, atol=1e-10)


def test_inputs_stay_inside_the_limits():
    task = rover_task(low=np.array([-0.1, -0.2]), high=np.array([0.1, 0.2]), past=np.zeros(2))
    run = simulate(task.problem(), feedback_policy(task))
    assert (run.inputs >= task.low).all() and (run.inputs <= task.high).all()


def test_a_run_that_diverges_is_minus_infinity_and_no_exception():
    task = cart_task()
    problem = task.problem(np.full((40, 2), 1e308))
    run = simulate(problem, task.policy(np.zeros((40, 1)), None, None))
    assert run.utility == -np.inf


def test_the_inputs_already_sent_stand_beside_the_states():
    task = rover_task(latency=np.array([0.0, 0.15]))
    problem = task.problem()
    u = np.arange(8.0).reshape(4, 2)
    z = augmented(problem, np.zeros((5, 3)), u, np.array([-1.0, -2.0]))
    np.testing.assert_array_equal(z[:, 3], [-1, 0, 2, 4, 6])
    np.testing.assert_array_equal(
        z[:, 4:], [[-2, -2, -2], [1, -2, -2], [3, 1, -2], [5, 3, 1], [7, 5, 3]]
    )


def test_smoothing_never_reaches_the_exact_model():
    """Just below the dead zone the exact model stands still; the smoothed one creeps."""
    task = rover_task(latency=np.zeros(2), past=np.array([0.04, 0.0]))
    policy = task.policy(np.tile([0.04, 0.0], (60, 1)), None, None)
    assert simulate(task.problem(exact=True), policy).states[-1, 0] == 0.0
    assert simulate(task.problem(), policy).states[-1, 0] > 1e-3


def test_the_plant_with_the_models_own_latency_is_the_model():
    task = rover_task(latency=np.array([0.05, 0.10]))
    policy = feedback_policy(task)
    run = simulate(task.problem(exact=True), policy)
    plant = Plant(rover, latency={"speed": 0.05, "turn": 0.10}, substeps=1)
    trial = plant.run(policy, {}, np.random.default_rng(0))
    np.testing.assert_allclose(trial.states, run.states, atol=1e-9)
    np.testing.assert_allclose(trial.inputs, run.inputs, atol=1e-9)


def step_policy(task, at=10, value=1.0):
    u = np.zeros((task.horizon, task.model.m))
    u[at:] = value
    return task.policy(u, None, None)


@pytest.mark.parametrize(("latency", "late"), [(0.0, 0), (0.01, 1), (0.05, 5), (0.13, 13)])
def test_latency_is_resolved_finer_than_the_control_step(latency, late):
    task = cart_task()
    policy = step_policy(task)
    delayed = Plant(cart, latency={"force": latency}, substeps=5).run(
        policy, {}, np.random.default_rng(0)
    )
    v, t = delayed.states[-1, 1], 2.0 - 0.5 - late * 0.01  # v(t) = (1 - exp(-d t)) / d
    assert v == pytest.approx((1 - np.exp(-0.2 * t)) / 0.2, abs=1e-6)


def test_what_comes_back_are_commands_and_measured_states():
    task = rover_task()
    noise = Noise(measurement={"x": 0.1})
    plant = Plant(other(rover), latency={"speed": 0.2}, noise=noise)
    u = np.random.default_rng(0).uniform(-1, 1, (60, 2))
    trial = plant.run(task.policy(u, None, None), {"y": 2.0}, np.random.default_rng(1))
    np.testing.assert_array_equal(trial.inputs, u)  # not what arrived
    quiet = Plant(other(rover), latency={"speed": 0.2}).run(
        task.policy(u, None, None), {"y": 2.0}, np.random.default_rng(1)
    )
    assert trial.states[0, 1] == 2.0 and trial.start_inputs is not None
    np.testing.assert_array_equal(trial.start_inputs, task.past)
    np.testing.assert_array_equal(trial.states[:, 1:], quiet.states[:, 1:])
    assert np.std(trial.states[:, 0] - quiet.states[:, 0]) == pytest.approx(0.1, rel=0.3)


def test_the_same_seed_gives_the_same_trial():
    task = cart_task()
    plant = Plant(cart, noise=Noise(start={"x": 0.1}, process={"v": 0.1}, measurement={"x": 0.01}))
    runs = [plant.run(step_policy(task), {}, np.random.default_rng(s)) for s in (3, 3, 4)]
    np.testing.assert_array_equal(runs[0].states, runs[1].states)
    assert np.abs(runs[0].states - runs[2].states).max() > 0.01


def test_the_real_system_may_have_states_of_its_own():
    hidden = Model(
        states={"battery": "1", "v": "m/s", "x": "m"},
        inputs={"light": "1", "force": "N"},
        derivative=lambda s, a, p: {
            "x": s.v,
            "v": a.force * s.battery,
            "battery": -0.1 * s.battery,
        },
    )
    task = cart_task()
    trial = Plant(hidden).run(step_policy(task, 0), {"battery": 1.0}, np.random.default_rng(0))
    assert trial.state_names == ("x", "v") and trial.input_names == ("force",)
    assert trial.states[-1, 1] == pytest.approx(10 * (1 - np.exp(-0.2)), abs=1e-6)


def test_a_run_that_diverges_ends_early():
    explosive = Model(
        states={"x": "m", "v": "m/s"},
        inputs={"force": "N"},
        derivative=lambda s, a, p: {"x": s.v, "v": s.v * s.v * 10 + a.force},
    )
    task = cart_task()
    trial = Plant(explosive).run(step_policy(task, 5, 3.0), {}, np.random.default_rng(0))
    assert 5 < trial.steps < 40 and np.isfinite(trial.states).all()
    assert task.utility(trial) == -np.inf


def test_names_that_the_system_does_not_have():
    task = cart_task()
    with pytest.raises(GroundedError, match=holding("'v'")):
        Plant(rover).run(step_policy(task), {}, np.random.default_rng(0))
    with pytest.raises(GroundedError, match=holding("'speeed'", "'speed'")):
        Plant(rover, latency={"speeed": 0.1}).run(
            step_policy(rover_task()), {}, np.random.default_rng(0)
        )
    with pytest.raises(GroundedError, match=holding("'xx'")):
        Plant(cart, noise=Noise(start={"xx": 0.1})).run(
            step_policy(task), {}, np.random.default_rng(0)
        )


def roll(s, a, p):
    return {"q": s.w, "w": a.moment / p.inertia}


@pytest.fixture(scope="module")
def lagging():
    """A body turned by a moment that lags by 80 ms, with inputs that cost next to nothing."""
    model = Model(
        states={"q": "rad", "w": "rad/s"},
        inputs={"moment": "N m"},
        params={"inertia": Param(0.01, "kg m^2")},
        derivative=roll,
    )
    target, ends = np.tile([1.0, 0.0], (81, 1)), [100.0, 1.0]
    task = plain_task(model, 0.02, target, [10.0, 0.0], 20.0, terminal=ends, effort=1e-4)
    return planner_of(task, [{"name": "first_order_lag:moment", "tau": 0.08}])


def disturbed(problem, run, K, measured=2):
    """How large disturbances of the measured states have grown by the end of the loop."""
    q, noise = linearised(problem.system, problem, run.z, run.inputs), np.zeros(problem.nz)
    noise[:measured] = 1e-4
    S = np.diag(noise)
    for t in range(len(K)):
        loop = q.A[t] + q.B[t] @ K[t]
        S = loop @ S @ loop.T + np.diag(noise)
    return float(np.sqrt(np.trace(S[:measured, :measured])))


def test_a_loop_without_the_lags_output_stays_stable(lagging):
    problem = lagging.plan.problem()
    policy, found = first_policy(lagging.plan)
    run = simulate(problem, policy)
    known = np.arange(problem.nz) != 2
    K = measured_gains(problem, found.z, found.u, found.K, 2)
    assert not K[:, :, 2].any() and found.K[:, :, 2].any()
    full, dropped = (disturbed(problem, run, k) for k in (found.K, np.where(known, found.K, 0.0)))
    made = disturbed(problem, run, K)
    assert dropped > 1e3 * full and made < 4 * full


def test_the_planner_hands_over_such_gains(lagging):
    policy, found = lagging.first_policy()
    narrow = lagging.narrowed(policy)
    assert not policy.gain[:, :, 2].any()
    np.testing.assert_array_equal(narrow.gain[:, :, :2], policy.gain[:, :, :2])
    np.testing.assert_array_equal(policy.feedforward, found.u)


def test_nothing_changes_where_everything_is_measured(lagging):
    problem = lagging.plan.problem()
    _, found = first_policy(lagging.plan)
    K = measured_gains(problem, found.z, found.u, found.K, problem.system.n)
    np.testing.assert_array_equal(K, found.K)


def test_a_clamped_input_keeps_no_gain(lagging):
    problem = lagging.plan.problem()
    _, found = first_policy(lagging.plan)
    clamped = found.K.copy()
    clamped[3:6] = 0.0
    K = measured_gains(problem, found.z, found.u, clamped, 2)
    assert not K[3:6].any() and K[10].any()
