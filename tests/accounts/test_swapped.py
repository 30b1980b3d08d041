"""Columns of a log in each other's place, by positions and their velocities."""

from dataclasses import replace

import numpy as np
import pytest
from grounded.accounts.sound_trials import sound_trials as preflight

from facts import holding
from grounded import Model, Param
from grounded.errors import GroundedError
from grounded.trial import Trial

PLANE = Model(
    name="plane",
    states={"x": "m", "y": "m", "vx": "m/s", "vy": "m/s"},
    inputs={"F": "N", "G": "N"},
    params={"m": Param(1.0, "kg")},
    derivative=lambda s, a, p: {"x": s.vx, "y": s.vy, "vx": a.F / p.m, "vy": a.G / p.m},
)
SLED = Model(
    name="sled",
    states={"x": "m", "v": "m/s"},
    inputs={"F": "N"},
    params={"m": Param(1.0, "kg")},
    derivative=lambda s, a, p: {"x": s.v, "v": (a.F - 0.3 * s.v) / p.m},
)


def driven(model: Model, seed: int = 0, noise: float = 1e-3) -> Trial:
    """20 s under commands that change every 0.4 s and hold the position."""
    rng, x, states, inputs = np.random.default_rng(seed), np.zeros(model.n), [], []
    for k in range(400):
        if k % 8 == 0:
            push = rng.uniform(-2, 2, model.m)
        u = push - 0.4 * x[: model.m]
        states.append(x)
        inputs.append(u)
        x = model.system.step(x[None], u[None], model.values, 0.05)[0]
    logged = np.array([*states, x])
    logged += noise * rng.normal(size=logged.shape) * np.std(logged, axis=0)
    names = (model.state_names, model.input_names)
    return Trial(logged, np.array(inputs), 0.05, *names, id=f"t{seed:04}")


def with_columns(trial: Trial, a: int, b: int) -> Trial:
    both = np.hstack([trial.states, np.vstack([trial.inputs, trial.inputs[-1:]])])
    both[:, [a, b]] = both[:, [b, a]]
    n = trial.states.shape[1]
    return Trial(
        both[:, :n], both[:-1, n:], trial.dt, trial.state_names, trial.input_names, id=trial.id
    )


@pytest.mark.parametrize(
    ("a", "b", "said"), [(0, 1, "x and v"), (1, 2, "v and F"), (0, 2, "x and F")]
)
@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_exchanged_columns_are_named(a, b, said, noise):
    trial = driven(SLED, 3, noise)
    assert swapped_columns(SLED, trial) == ""
    assert swapped_columns(SLED, with_columns(trial, a, b)) == said


def test_two_pairs_that_would_mend_it_are_both_named():
    """Nothing but the place tells x and y exchanged from their velocities exchanged."""
    found = swapped_columns(PLANE, with_columns(driven(PLANE), 2, 3))
    assert found == "x and y (or vx and vy)"


def side_by_side(ratio: float) -> Trial:
    """Two joints on their way together, one further, and then on by itself for a little."""
    rng, t = np.random.default_rng(0), np.linspace(0, 1, 101)
    way = 10 * t**3 - 15 * t**4 + 6 * t**5
    turn = 0.3 * np.sin(2 * np.pi * t) * way
    x = np.column_stack([way + turn, ratio * way])
    states = np.hstack([x, np.gradient(x, 0.02, axis=0)])
    states += rng.normal(size=states.shape) * [5e-4, 5e-4, 0.01, 0.01]
    return Trial(states, np.zeros((100, 2)), 0.02, PLANE.state_names, PLANE.input_names)


@pytest.mark.parametrize("ratio", [0.4, 0.8, 2.5])
@pytest.mark.parametrize("pair", [(0, 1), (2, 3)])
def test_joints_that_move_alike_are_told_by_both(ratio, pair):
    """Each goes roughly as the other's velocity says, but half as far."""
    trial = side_by_side(ratio)
    assert swapped_columns(PLANE, trial) == ""
    assert swapped_columns(PLANE, with_columns(trial, *pair)) == "x and y (or vx and vy)"


def test_one_joint_that_moves_further_than_its_velocity_says_is_no_exchange():
    trial = side_by_side(0.5)
    for factor in (0.5, 2.0, -1.0):
        states = trial.states * [factor, 1.0, 1.0, 1.0]
        other = Trial(states, trial.inputs, 0.02, PLANE.state_names, PLANE.input_names)
        assert swapped_columns(PLANE, other) == ""


def test_a_sign_a_scale_a_delay_or_a_drifting_position_are_no_exchange():
    trial = driven(SLED, 1)
    x, v = np.array(trial.states).T
    others = [
        (x, -v),
        (x, 57.3 * v),
        (x, np.concatenate([np.zeros(4), v[:-4]])),
        (x + 0 * v, 0 * v),
    ]
    others += [(np.random.default_rng(0).normal(size=len(x)), v)]
    for states in others:
        changed = Trial(np.array(states).T, trial.inputs, 0.05, ("x", "v"), ("F",))
        assert swapped_columns(SLED, changed) == ""


def test_a_diagnosis_stops_at_such_a_trial():
    trials = [driven(SLED, k) for k in range(3)]
    trials[1] = with_columns(trials[1], 0, 1)
    with pytest.raises(GroundedError, match=holding("t0001", "x and v")) as stopped:
        preflight(SLED, trials)
    assert stopped.value.then is not None and stopped.value.then.arguments == ("t0001",)


def swinging(square: float, noise: float = 0.01) -> Trial:
    """A load at a rail whose carrier is pushed: w' = -square th - 0.1 w + F."""
    rng, steps, dt = np.random.default_rng(0), 600, 0.02
    push = np.repeat(rng.uniform(-0.2, 0.2, steps // 20), 20) * square
    x, states = np.array([0.3, 0.0]), []
    for force in push:
        states.append(x)
        rate = x[1] + dt * (force - square * x[0] - 0.1 * x[1])
        x = np.array([x[0] + dt * (x[1] + rate) / 2, rate])
    logged = np.array([*states, x])
    logged += noise * rng.normal(size=logged.shape) * logged.std(axis=0)
    return Trial(logged, push[:, None], dt, ("x", "v"), ("F",), id="t0001")


@pytest.mark.parametrize("square", [0.5, 2.0, 16.0, 60.0])
def test_a_swing_is_told_by_size_and_sign(square):
    """A crane's angle and rate: the rate was `92 % slower`, the angle `0.164 s old`."""
    right = swinging(square)
    wrong = with_columns(right, 0, 1)
    assert swapped_columns(SLED, right) == ""
    assert swapped_columns(SLED, wrong) == "x and v"
    for trial, said in ((right, ""), (wrong, "x and v, one with the opposite sign,")):
        for signs in ([1, -1], [-1, 1]):
            turned = replace(trial, states=trial.states * signs)
            assert swapped_columns(SLED, turned) == said


@pytest.mark.parametrize("factor", [1.0, -1.0, 0.1, -0.1, 57.3, -57.3])
@pytest.mark.parametrize("square", [1.0, 16.0])
def test_a_free_swing_in_other_units_or_of_the_other_sign_is_no_exchange(square, factor):
    t, pace = np.linspace(0, 12, 601), np.sqrt(square)
    states = np.column_stack([np.sin(pace * t), factor * pace * np.cos(pace * t)])
    trial = Trial(states, np.zeros((600, 1)), 0.02, ("x", "v"), ("F",))
    assert swapped_columns(SLED, trial) == ""
