"""Step 4: the biased model replays its trial exactly, also with matched inputs."""

from dataclasses import replace

import numpy as np
import pytest

from facts import holding
from grounded.compile.problem import queue_of
from grounded.errors import GroundedError
from grounded.experiments.car_tasks import car_task
from grounded.experiments.figure8 import flight_task, perturbed
from grounded.experiments.pendulum import pendulum_task
from grounded.experiments.real_car import real_plant
from grounded.models import aircraft, car, pendulum
from grounded.models.car import model as car_model
from grounded.plant import Plant
from grounded.rollout import augmented, simulate
from grounded.search.first_policy import first_policy
from grounded.search.improve import propose
from grounded.search.step_size import SearchOptions
from grounded.solve.bias import ground, residuals
from grounded.solve.levenberg_marquardt import LeastSquares, solve
from grounded.trial import Trial
from small_tasks import black_box, cart_task, drive, other, rover_task


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


@pytest.mark.parametrize("exact", [True, False])
def test_the_model_with_matched_inputs_replays_the_trial(trial, exact):
    task, policy, run = trial
    grounding = ground(task, run, exact=exact, match_inputs=True)
    problem = grounding.on(task.problem(exact=exact))
    assert np.abs(grounding.shift).max() > 0.01
    swarm = problem.system.rollout(problem, policy.feedforward, policy.gain, policy.reference)
    np.testing.assert_allclose(swarm.z[0][:, : car_model.n], run.states, atol=1e-9)
    np.testing.assert_allclose(swarm.u[0], run.inputs, atol=1e-9)


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
