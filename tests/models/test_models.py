"""The aircraft, the RC car with its manoeuvres, the pendulum: trims, signs, textbook periods."""

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import grounded
from facts import holding
from grounded.errors import GroundedError
from grounded.experiments import car_tasks, figure8
from grounded.experiments.car_tasks import NAMES, RAMP_DOWN, RAMP_UP, car_task, target
from grounded.experiments.figure8 import figure8_target, flight_task, perturbed
from grounded.experiments.pendulum import pendulum_task
from grounded.experiments.real_car import UNMODELLED, real_car
from grounded.models import aircraft, car, pendulum
from grounded.models.aircraft import PARAMS, lift_coefficient
from grounded.models.aircraft_trim import level_trim
from stepped import stepped

VALUES = SimpleNamespace(**{name: param.value for name, param in PARAMS.items()})


def flight_rates(x, u, values=VALUES):
    s = SimpleNamespace(**dict(zip(aircraft.model.state_names, x, strict=True)))
    a = SimpleNamespace(**dict(zip(aircraft.model.input_names, u, strict=True)))
    return aircraft.dynamics(s, a, values)


def fly(x, u, seconds):
    return stepped(aircraft.model, np.tile(u, (round(seconds / figure8.DT), 1)), figure8.DT, x)


def column(path, name):
    return path[:, aircraft.model.state_names.index(name)]


@pytest.fixture(scope="module")
def straight():
    return level_trim(aircraft.model, 11.0)


def test_exactly_43_parameters_12_states_4_inputs():
    assert (len(aircraft.model.params), aircraft.model.n, aircraft.model.m) == (43, 12, 4)
    assert (VALUES.mass, VALUES.b) == (1.0, 1.5)  # footnote 13


def test_lift_carries_the_weight_in_trim(straight):
    x, u = straight
    found = flight_rates(x, u)
    held = [name for name in aircraft.model.state_names if name not in ("north", "east", "psi")]
    assert max(abs(found[name]) for name in held) < 1e-8
    assert np.hypot(found["north"], found["east"]) == pytest.approx(11.0, abs=1e-6)
    assert 0 < u[0] < 1


def test_a_coordinated_turn_banks_by_its_turn_rate():
    # a level coordinated turn: tan(phi) = omega V / g, point mass; the wing body's lift tilts a bit
    for omega in (-0.2, 0.2):
        start, held = level_trim(aircraft.model, 9.0, omega)
        path = fly(start, held, 2.0)
        turned = column(path, "psi")[-1] - column(path, "psi")[0]
        assert turned == pytest.approx(2.0 * omega, abs=1e-6)
        phi = start[aircraft.model.state_names.index("phi")]
        assert np.tan(phi) * 9.81 / 9.0 == pytest.approx(omega, rel=0.1)
        assert np.abs(column(path, "altitude")).max() < 1e-6


@pytest.mark.parametrize(
    ("surface", "change", "rate", "sign"),
    [
        ("elevator", -0.05, "q", 1),  # pulled: nose up
        ("aileron", 0.05, "p", 1),  # right wing down
        ("rudder", 0.05, "r", -1),  # nose left
        ("throttle", 0.05, "u", 1),
    ],
)
def test_each_input_moves_the_aircraft_its_way(straight, surface, change, rate, sign):
    x, u = straight
    moved = u.copy()
    moved[aircraft.model.input_names.index(surface)] += change
    assert sign * (flight_rates(x, moved)[rate] - flight_rates(x, u)[rate]) > 0.01


def test_statically_stable_in_pitch_and_yaw(straight):
    x, u = straight
    up, right = x.copy(), x.copy()
    up[aircraft.model.state_names.index("w")] += 0.3  # the air comes from below: nose down
    right[aircraft.model.state_names.index("v")] += 0.3  # the air comes from the right: nose right
    assert flight_rates(up, u)["q"] < flight_rates(x, u)["q"]
    assert flight_rates(right, u)["r"] > flight_rates(x, u)["r"]


def test_without_air_energy_and_spin_are_kept():
    still = aircraft.model.with_values({"rho": 0.0})
    x = np.array([[0, 0, 100, 8, 1, 2, 0.2, 0.1, 0.3, 0.5, 0.4, -0.6]])
    inertia = np.array(
        [[VALUES.Jx, 0, -VALUES.Jxz], [0, VALUES.Jy, 0], [-VALUES.Jxz, 0, VALUES.Jz]]
    )

    def energy(x):
        v, w = x[0, 3:6], x[0, 9:12]
        return 0.5 * v @ v + 9.81 * x[0, 2] + 0.5 * w @ inertia @ w

    after = stepped(still, np.zeros((100, 4)), figure8.DT, x[0])[-1:]
    assert energy(after) == pytest.approx(energy(x), rel=1e-7)


def test_lift_falls_beyond_the_stall():
    alpha = np.linspace(-1.2, 1.2, 241)
    lift = lift_coefficient(alpha, VALUES)
    linear = VALUES.CL0 + VALUES.CLa * alpha
    assert np.abs(lift - linear)[np.abs(alpha) < 0.3].max() < 1e-3
    peak = alpha[np.argmax(lift)]
    assert 0.3 < peak < VALUES.alpha_s
    assert lift[-1] == pytest.approx(2 * np.sin(1.2) ** 2 * np.cos(1.2), abs=1e-6)


def test_no_trim_is_said_so():
    with pytest.raises(GroundedError, match=holding("9.00 m/s")):
        level_trim(aircraft.model.with_values({"rho": 0.0}), 9.0, 0.0)
    with pytest.raises(GroundedError, match=holding(f"'{pendulum.model.name}'")):
        level_trim(pendulum.model, 3.0, 0.0)


def test_the_figure8_closes_in_sixty_seconds():
    path, speed, rate = figure8_target()
    assert path.shape == (3001, 3) and speed.min() >= 9 - 1e-9 and speed.max() <= 11 + 1e-9
    assert np.abs(path[-1] - path[0]).max() < 0.5  # one lap
    assert np.ptp(path[:, 0]) == pytest.approx(np.ptp(path[:, 1]), rel=0.01)
    assert np.abs(rate).max() == pytest.approx(9 / 42, rel=1e-3)
    change = np.diff(rate) / figure8.DT
    assert np.abs(change).max() < 2.1 * (9 / 42)  # a Hann window of 1 s: at most twice the jump
    assert (path[:, 2] == 0).all()


def test_the_task_weighs_positions_and_inputs_alone():
    task = flight_task(aircraft.model)
    assert task.horizon == 3000 and task.dt == 0.02
    assert task.reward.state.tolist() == [1, 1, 1] + [0] * 9
    assert task.reward.input.tolist() == [1] * 4
    assert task.reward.input_change.tolist() == [1e5] * 4
    other = flight_task(
        perturbed(aircraft.model, np.random.default_rng(0)), started_by=aircraft.model
    )
    assert other.hash == task.hash  # one real task, whatever model plans it


def test_every_parameter_is_perturbed_by_its_own_factor():
    other = perturbed(aircraft.model, np.random.default_rng(3))
    factor = other.values / aircraft.model.values
    assert factor.min() >= 0.8 and factor.max() <= 1.2
    assert len(np.unique(factor)) == 43
    assert (perturbed(aircraft.model, np.random.default_rng(3)).values == other.values).all()


P = SimpleNamespace(**{k: p.value for k, p in car.model.params.items()})


def car_rates(u1=0.0, u2=0.0, **state):
    s = {"delta": 0.0, "v": 0.0, "x": 0.0, "y": 0.0, "psi": 0.0, "psi_rate": 0.0} | state
    return car.dynamics(SimpleNamespace(**s), SimpleNamespace(steering=u1, throttle=u2), P)


def simulate(steering, throttle, seconds, of=car.model, **state):
    start = [state.get(name, 0.0) for name in of.state_names]
    path = stepped(
        of, np.tile([steering, throttle], (round(seconds / car_tasks.DT), 1)), car_tasks.DT, start
    )
    return dict(zip(of.state_names, path.T, strict=True))


def test_equations_of_section_5_2_by_hand():
    found = car_rates(u1=0.5, u2=0.6, delta=0.1, v=1.0, psi=0.3)
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
    assert car_rates(u2=0.3, v=3.0)["v"] == P.a4
    assert car_rates(u2=0.0, v=3.0)["v"] == P.a4


def test_the_motor_stalls_below_018():
    assert car.model.params["stall"].value == 0.18
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


@pytest.mark.parametrize("name", NAMES)
def test_a_target_is_a_motion_of_the_car(name):
    states = target(name)
    delta, v, x, y, psi, _ = states.T
    assert (v[0], x[0], y[0], psi[0]) == (0, 0, 0, 0)  # footnote 18: from zero velocity
    acceleration = np.diff(v) / car_tasks.DT
    assert acceleration.max() < RAMP_UP + 1e-6 and acceleration.min() > -1.1 * RAMP_DOWN
    moved = np.hypot(np.diff(x), np.diff(y))
    rear = (v * np.cos(delta))[:-1] + 0.5 * np.diff(v * np.cos(delta))
    np.testing.assert_allclose(moved, rear * car_tasks.DT, atol=2e-3)
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
    task = car_task(name, car.model)
    assert task.dt == 0.05 and task.latency.tolist() == [0.1, 0.1]
    assert task.feedback == (name != "turn")
    assert task.problem().nz == 6 + 2 + 2  # the latency is a queue in the state
    assert (task.low.tolist(), task.high.tolist()) == ([-1, -1], [1, 1])


def test_without_its_effects_and_errors_it_is_the_model():
    crude = dict(zip(car.model.param_names, car.model.values.tolist(), strict=True))
    same = real_car().with_values({**crude, **dict.fromkeys(UNMODELLED, 0.0)})
    a = simulate(0.4, 0.6, 3.0)
    b = simulate(0.4, 0.6, 3.0, of=same)
    for name in car.model.state_names:
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


def swing(of, theta, seconds, torque=0.0, dt=0.002):
    return stepped(of, np.full(round(seconds / dt), torque), dt, [theta, 0.0])


def test_small_swings_have_the_textbooks_period():
    free = pendulum.model.with_values({"b": 0.0})
    period = 2 * np.pi * np.sqrt(0.5 / 9.81)
    path = swing(free, 0.01, period)
    np.testing.assert_allclose(path[-1], [0.01, 0.0], atol=2e-4)


def test_energy_is_kept_without_damping_and_lost_with_it():
    def energy(of, path):
        g, length = of.params["g"].value, of.params["l"].value
        return 0.5 * (length * path[:, 1]) ** 2 - g * length * np.cos(path[:, 0])

    free = pendulum.model.with_values({"b": 0.0})
    kept = energy(free, swing(free, 2.0, 3.0))
    assert np.ptp(kept) < 1e-6
    assert energy(pendulum.model, swing(pendulum.model, 2.0, 3.0))[-1] < kept[0] - 0.1


def test_the_task_goes_from_hanging_to_standing():
    task = pendulum_task(pendulum.model)
    assert task.target[0, 0] == 0.0 and task.target[-1, 0] == pytest.approx(np.pi)
    assert task.horizon * task.dt == pytest.approx(3.0) and np.isnan(task.target[:, 1]).all()
