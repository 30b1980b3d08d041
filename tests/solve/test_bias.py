"""Step 4: the biased model replays its trial; a rollout is what the runner would do."""

from dataclasses import replace

import numpy as np
import pytest

from facts import holding
from grounded.compile.problem import queue_of
from grounded.compile.run.interpreted import linearised
from grounded.errors import GroundedError
from grounded.experiments.car_tasks import car_task
from grounded.experiments.figure8 import flight_task, perturbed
from grounded.experiments.pendulum import pendulum_task
from grounded.experiments.real_car import real_plant
from grounded.model import Model, Param
from grounded.models import aircraft, car, pendulum
from grounded.models.car import model as car_model
from grounded.onboard import Runner
from grounded.plant import Noise, Plant
from grounded.rollout import augmented, simulate
from grounded.search.first_policy import first_policy
from grounded.search.improve import propose
from grounded.search.step_size import SearchOptions
from grounded.solve.bias import ground, residuals
from grounded.solve.levenberg_marquardt import LeastSquares, solve
from grounded.solve.measured import measured_gains
from grounded.trial import Trial
from grounded_trials.workspace.adopted import planner_of
from small_tasks import black_box, cart, cart_task, drive, other, plain_task, rover, rover_task


def run_of(task, model, seed=0, substeps=1, latency=None):
    """A trial of random inputs about the target's, in another model."""
    rng = np.random.default_rng(seed)
    m, H = task.model.m, task.horizon
    low = np.where(np.isfinite(task.low), task.low, -1.0)
    high = np.where(np.isfinite(task.high), task.high, 1.0)
    middle, span = 0.5 * (low + high), 0.2 * (high - low)
    u = np.clip(middle + span * rng.uniform(-1, 1, (H, m)), low, high)
    policy = task.policy(u, None, None)
    start = dict(zip(task.model.state_names, map(float, task.start), strict=True))
    plant = Plant(model, latency=latency or {}, substeps=substeps)
    return policy, plant.run(policy, start, rng)


def short(task, H):
    """The same task, cut to H steps."""
    assert task.input_target is not None
    return replace(task, target=task.target[: H + 1], input_target=task.input_target[:H])


TASKS = {
    "cart": (cart_task, other(cart_task().model)),
    "rover": (rover_task, other(rover_task().model)),
    "black box": (lambda: cart_task(model=black_box), other(black_box)),
    "car": (lambda: car_task("figure8", car.model), other(car.model, 1.1)),
    "pendulum": (lambda: pendulum_task(pendulum.model), other(pendulum.model, 1.02)),
    "aircraft": (
        lambda: short(flight_task(aircraft.model), 60),
        perturbed(aircraft.model, np.random.default_rng(0)),
    ),
}


@pytest.mark.parametrize("matched", [False, True], ids=["plain", "matched"])
@pytest.mark.parametrize("exact", [True, False], ids=["exact", "smoothed"])
@pytest.mark.parametrize("name", TASKS)
def test_the_biased_model_replays_the_trial(name, exact, matched):
    make, real = TASKS[name]
    task = make()
    policy, trial = run_of(task, real)
    assert trial.steps == task.horizon
    found = ground(task, trial, exact=exact, match_inputs=matched)
    run = simulate(found.on(task.problem(exact=exact)), policy)
    scale = np.maximum(np.abs(trial.states).max(axis=0), 1.0)
    assert (np.abs(run.states - trial.states) / scale).max() < 1e-9
    np.testing.assert_array_equal(run.inputs, trial.inputs)
    assert run.utility == pytest.approx(task.utility(trial), rel=1e-9, abs=1e-9)
    if not matched:  # there was something to learn, and all of it is in the bias
        assert not exact or np.abs(found.bias).max() > 1e-6
        assert found.shift is None


@pytest.mark.parametrize("exact", [True, False])
@pytest.mark.parametrize("delay", [0.3, 1.0, 3.75])
def test_any_fraction_of_latency_is_replayed(delay, exact):
    task = rover_task(latency=np.array([delay * 0.05, 0.01]))
    policy, trial = run_of(
        task, other(task.model), latency={"speed": 0.08, "turn": 0.03}, substeps=5
    )
    for matched in (False, True):
        found = ground(task, trial, exact=exact, match_inputs=matched)
        run = simulate(found.on(task.problem(exact=exact)), policy)
        assert np.abs(run.states - trial.states).max() < 1e-9


def test_a_feedback_policy_replays_its_own_trial():
    """The policy that ran the trial gives the trial's states AND inputs in the biased model."""
    task = rover_task()
    first = propose(task, [], [], SearchOptions()).candidate
    plant = Plant(other(task.model, 1.15), latency={"speed": 0.05, "turn": 0.05}, substeps=5)
    trial = drive(task, plant, first)
    run = simulate(task.problem(ground(task, trial, exact=True).bias, exact=True), first.policy)
    assert np.abs(run.states - trial.states).max() < 1e-9
    assert np.abs(run.inputs - trial.inputs).max() < 1e-9


def test_angles_logged_wrapped_are_replayed_too():
    """A log may jump by 2 pi: the replay lands on the recorded number itself."""
    task = rover_task()
    policy, trial = run_of(task, other(task.model))
    turned = np.array(trial.states)
    turned[:, 2] += 3.0 * 0.05 * np.arange(61)
    jumps = turned.copy()
    jumps[:, 2] = (turned[:, 2] + np.pi) % (2 * np.pi) - np.pi
    wrapped = replace(trial, states=jumps)
    assert np.abs(np.diff(jumps[:, 2])).max() > 6
    run = simulate(task.problem(ground(task, wrapped).bias), policy)
    assert np.abs(run.states - jumps).max() < 1e-9
    smooth = replace(trial, states=turned)
    np.testing.assert_allclose(residuals(task, wrapped), residuals(task, smooth), atol=1e-9)
    assert task.utility(wrapped) == pytest.approx(task.utility(smooth), rel=1e-9)


def test_the_held_input_of_the_trial_is_used_not_the_tasks():
    task = cart_task(latency=np.array([0.05]))
    u = np.zeros((40, 1))
    states = np.zeros((41, 2))
    early = Trial(states, u, 0.05, ("x", "v"), ("force",), start_inputs=np.array([2.0]))
    found = ground(task, early)
    assert found.z[0, 2] == 2.0 and abs(found.bias[0, 1]) > 1e-3  # a force of 2 N, yet no motion
    assert np.abs(found.bias[1:]).max() == 0.0
    quiet = Trial(states, u, 0.05, ("x", "v"), ("force",))
    assert np.abs(ground(task, quiet).bias).max() == 0.0


def test_the_model_itself_needs_no_bias():
    task = rover_task(latency=np.array([0.05, 0.1]))
    _, trial = run_of(task, task.model, latency={"speed": 0.05, "turn": 0.1})
    assert np.abs(ground(task, trial, exact=True).bias).max() < 1e-12
    assert np.abs(residuals(task, trial)).max() < 1e-12


def test_effective_inputs_by_hand():
    u = np.arange(6.0).reshape(6, 1)
    problem = cart_task(latency=np.array([0.05 * 1.25])).problem()
    z = augmented(problem, np.zeros((7, 2)), u, np.array([-1.0]))
    np.testing.assert_array_equal(z[:, 2], [-1, 0, 1, 2, 3, 4, 5])  # u[t-1]
    np.testing.assert_array_equal(z[:, 3], [-1, -1, 0, 1, 2, 3, 4])  # u[t-2]
    received = queue_of(2, np.array([1.25]), (2,)).effective(z[: len(u)], u)
    # over step t: three quarters of it under u[t-1], the first quarter still under u[t-2]
    np.testing.assert_allclose(received[:, 0], [-1.0, -0.25, 0.75, 1.75, 2.75, 3.75])


def test_a_short_or_unfinite_trial_has_no_bias_and_says_so():
    task = cart_task()
    cut = Trial(np.zeros((31, 2)), np.zeros((30, 1)), 0.05, ("x", "v"), ("force",))
    with pytest.raises(GroundedError, match=holding(40, 30)):
        ground(task, cut)
    states = np.zeros((41, 2))
    states[7, 1] = np.nan
    with pytest.raises(GroundedError, match=holding(40, 6)):
        ground(task, Trial(states, np.zeros((40, 1)), 0.05, ("x", "v"), ("force",)))


@pytest.fixture(scope="module")
def trial():
    task = car_task("circle", car_model)
    policy, _ = first_policy(task)
    start = dict(zip(car_model.state_names, task.start, strict=True))
    return task, policy, real_plant().run(policy, start, np.random.default_rng(0))


def test_matched_inputs_leave_less_to_the_bias(trial):
    task, _, run = trial
    plain = ground(task, run, exact=True).bias
    matched = ground(task, run, exact=True, match_inputs=True).bias
    speed = car_model.state_names.index("v")
    assert np.abs(matched[20:, speed]).mean() < 0.2 * np.abs(plain[20:, speed]).mean()


def test_a_model_that_is_right_needs_no_shift(trial):
    task, policy, _ = trial
    from grounded.plant import Plant

    plant = Plant(car_model, latency=dict.fromkeys(car_model.input_names, 0.1), substeps=1)
    start = dict(zip(car_model.state_names, task.start, strict=True))
    run = plant.run(policy, start, np.random.default_rng(0))
    still = replace(task, smoothing=0.0)
    assert np.abs(ground(still, run, match_inputs=True).shift).max() < 1e-6


def test_levenberg_marquardt_solves_each_row_and_keeps_bounds():
    goals = np.array([[0.5, -0.2], [3.0, 0.1], [-0.9, 0.7]])

    def residual(w, rows):
        return np.column_stack([w[:, 0] ** 3 + w[:, 1], w[:, 1]]) - np.column_stack(
            [goals[rows, 0] ** 3 + goals[rows, 1], goals[rows, 1]]
        )

    def jacobian(w, rows):
        J = np.zeros((len(w), 2, 2))
        J[:, 0, 0], J[:, 0, 1], J[:, 1, 1] = 3 * w[:, 0] ** 2, 1.0, 1.0
        return J

    bounds = np.array([1.0, 1.0])
    batch = LeastSquares(residual, jacobian, -bounds, bounds, solved=1e-20)
    found = solve(batch, np.full((3, 2), 0.3), np.arange(3), 60)
    np.testing.assert_allclose(found.w[[0, 2]], goals[[0, 2]], atol=1e-6)
    assert found.w[1, 0] == 1.0 and found.error[1] > 1.0


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


def test_a_run_that_diverges_is_minus_infinity_and_no_exception():
    task = cart_task()
    problem = task.problem(np.full((40, 2), 1e308))
    run = simulate(problem, task.policy(np.zeros((40, 1)), None, None))
    assert run.utility == -np.inf


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
    return planner_of(task, {"first_order_lag:moment": {"tau": 0.08}})


def disturbed(problem, run, K):
    """How large disturbances of the measured states have grown by the end of the loop."""
    q, noise = linearised(problem.system, problem, run.z, run.inputs), np.zeros(problem.nz)
    noise[:2] = 1e-4
    S = np.diag(noise)
    for t in range(len(K)):
        loop = q.A[t] + q.B[t] @ K[t]
        S = loop @ S @ loop.T + np.diag(noise)
    return float(np.sqrt(np.trace(S[:2, :2])))


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
