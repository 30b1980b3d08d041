"""The RC car of section 5.2, its manoeuvres, and the simulated real car."""

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import grounded
from grounded.experiments.car_tasks import DT, NAMES, RAMP_DOWN, RAMP_UP, car_task, target
from grounded.experiments.real_car import CALIBRATION, UNMODELLED, real_car
from grounded.models.car import dynamics, model
from stepped import stepped

P = SimpleNamespace(**{k: p.value for k, p in model.params.items()})


def rates(u1=0.0, u2=0.0, **state):
    s = {"delta": 0.0, "v": 0.0, "x": 0.0, "y": 0.0, "psi": 0.0, "psi_rate": 0.0} | state
    return dynamics(SimpleNamespace(**s), SimpleNamespace(steering=u1, throttle=u2), P)


def simulate(steering, throttle, seconds, of=model, **state):
    start = [state.get(name, 0.0) for name in of.state_names]
    path = stepped(of, np.tile([steering, throttle], (round(seconds / DT), 1)), DT, start)
    return dict(zip(of.state_names, path.T, strict=True))


def test_equations_of_section_5_2_by_hand():
    found = rates(u1=0.5, u2=0.6, delta=0.1, v=1.0, psi=0.3)
    assert found["delta"] == pytest.approx((P.a1 * 0.5 + P.b1 - 0.1) / P.tau_delta)
    v_ss = P.a2 * 0.6 + P.a3 * 0.5 + P.b2
    assert v_ss > 1.0 and found["v"] == pytest.approx((v_ss - 1.0) / P.tau_v)
    assert found["psi"] == pytest.approx(1.0 * np.sin(0.1) / P.L)
    rear = np.cos(0.1)
    assert (found["x"], found["y"]) == (
        pytest.approx(rear * np.cos(0.3)),
        pytest.approx(rear * np.sin(0.3)),
    )


def test_it_brakes_at_a_fixed_rate():
    assert rates(u2=0.3, v=3.0)["v"] == P.a4
    assert rates(u2=0.0, v=3.0)["v"] == P.a4


def test_the_motor_stalls_below_018():
    assert model.params["stall"].value == 0.18
    still = simulate(0.0, 0.17, 2.0)
    assert np.abs(still["x"]).max() == 0.0
    assert simulate(0.0, 0.19, 2.0)["x"][-1] > 0.1


def test_it_neither_chatters_nor_rolls_backwards():
    v = simulate(0.0, 0.0, 4.0, v=1.0)["v"]
    assert (np.diff(v) <= 1e-12).all() and v.min() >= -1e-9 and v[-1] < 1e-3
    v = simulate(0.0, 0.3, 4.0, v=1.5)["v"]
    assert (np.diff(v) <= 1e-9).all() and v[-1] == pytest.approx(P.a2 * 0.3 + P.b2, abs=1e-6)


def test_the_sixth_state_is_the_heading_rate():
    run = simulate(0.4, 0.6, 4.0)
    expected = run["v"] * np.sin(run["delta"]) / P.L
    np.testing.assert_allclose(run["psi_rate"], expected, atol=2e-3)


def test_six_states_two_inputs_and_the_nine_parameters_of_the_paper():
    assert model.state_names == ("delta", "v", "x", "y", "psi", "psi_rate")
    assert (model.n, model.m) == (6, 2) and len(model.params) == 10  # nine, and the stall
    assert model.angles == ("psi",)


# the manoeuvres


@pytest.mark.parametrize("name", NAMES)
def test_a_target_is_a_motion_of_the_car(name):
    states = target(name)
    delta, v, x, y, psi, _ = states.T
    assert (v[0], x[0], y[0], psi[0]) == (0, 0, 0, 0)  # footnote 18: from zero velocity
    acceleration = np.diff(v) / DT
    assert acceleration.max() < RAMP_UP + 1e-6 and acceleration.min() > -1.1 * RAMP_DOWN
    moved = np.hypot(np.diff(x), np.diff(y))
    rear = (v * np.cos(delta))[:-1] + 0.5 * np.diff(v * np.cos(delta))
    np.testing.assert_allclose(moved, rear * DT, atol=2e-3)
    along = np.arctan2(np.diff(y), np.diff(x))
    middle = psi[:-1] + 0.5 * np.diff(psi)
    off = np.angle(np.exp(1j * (along - middle)))[v[:-1] > 0.2]
    assert np.abs(off).max() < 0.02


def test_speeds_and_radii_of_the_paper():
    circle, eight = target("circle"), target("figure8")
    assert circle[-1, 1] == pytest.approx(1.4, abs=1e-6)
    assert np.abs(np.hypot(*(circle[80:, 2:4] - [0.3, 1.0]).T) - 1.0).max() < 0.1
    assert 1.3 < eight[:, 1].max() <= 1.4 + 1e-9  # straights of 1 m are too short for all of 1.4
    turning = np.abs(eight[:, 5]) > 1.9
    assert turning.any() and eight[turning, 1].max() < 1.15
    turn = target("turn")
    assert turn[-1, 4] == pytest.approx(np.pi / 2, abs=0.02) and np.ptp(turn[20:, 1]) > 0.2


@pytest.mark.parametrize("name", NAMES)
def test_tasks_are_at_20_hz_with_footnote_17s_latency(name):
    task = car_task(name, model)
    assert task.dt == 0.05 and task.latency.tolist() == [0.1, 0.1]
    assert task.feedback == (name != "turn")
    assert task.problem().nz == 6 + 2 + 2  # the latency is a queue in the state
    assert (task.low.tolist(), task.high.tolist()) == ([-1, -1], [1, 1])


# the real car


def test_the_real_car_differs_where_it_is_said_to():
    real = real_car()
    for name, factor in CALIBRATION.items():
        assert real.params[name].value == pytest.approx(factor * model.params[name].value)
        assert 0.05 < abs(factor - 1) <= 0.2 + 1e-9
    assert set(UNMODELLED) <= set(real.params) and not set(UNMODELLED) & set(model.params)


def test_without_its_effects_and_errors_it_is_the_model():
    crude = dict(zip(model.param_names, model.values.tolist(), strict=True))
    same = real_car().with_values({**crude, **dict.fromkeys(UNMODELLED, 0.0)})
    a = simulate(0.4, 0.6, 3.0)
    b = simulate(0.4, 0.6, 3.0, of=same)
    for name in model.state_names:
        np.testing.assert_allclose(a[name], b[name], atol=1e-12)


def test_the_gyro_shows_all_that_turns_the_real_car():
    real, p = real_car(), real_car().params
    run = simulate(0.5, 0.7, 4.0, of=real)
    grip = 1 + p["understeer"].value * run["v"] ** 2
    yaw = run["v"] * np.sin(run["delta"]) / (p["L"].value * grip)
    yaw += p["thread_yaw"].value * run["v"] * np.sin(2 * (run["psi"] - p["thread"].value))
    np.testing.assert_allclose(run["psi_rate"], yaw, atol=2e-3)


def test_nothing_that_searches_or_diagnoses_can_see_the_real_car():
    """Only studies and the examples' real.py import it."""
    root = Path(grounded.__file__).parents[1]
    allowed = ("experiments", "examples.py", "real_car.py")
    imports = re.compile(r"(?m)^\s*(from|import)\b.*\breal_(car|pendulum)\b")
    files = [
        path for room in ("grounded", "trials", "cli") for path in root.glob(f"{room}/**/*.py")
    ]
    assert len(files) > 100
    for path in files:
        seen = imports.search(path.read_text())
        assert not seen or any(part in str(path) for part in allowed), (path, seen)
