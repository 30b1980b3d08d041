"""Plant: a simulated real system differs from a rollout where reality does."""

import numpy as np
import pytest

from facts import holding
from grounded.errors import GroundedError
from grounded.model import Model
from grounded.plant import Noise, Plant
from small_tasks import cart, cart_task, other, rover, rover_task


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
