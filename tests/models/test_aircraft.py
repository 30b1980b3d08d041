"""The 6-DOF aircraft: its trims, its signs, its symmetry."""

from types import SimpleNamespace

import numpy as np
import pytest

from facts import holding
from grounded.errors import GroundedError
from grounded.experiments.figure8 import DT, figure8_target, flight_task, perturbed
from grounded.models.aircraft import PARAMS, dynamics, lift_coefficient, model
from grounded.models.aircraft_trim import level_trim
from grounded.models.pendulum import model as pendulum
from stepped import stepped

VALUES = SimpleNamespace(**{name: param.value for name, param in PARAMS.items()})


def rates(x, u, values=VALUES):
    s = SimpleNamespace(**dict(zip(model.state_names, x, strict=True)))
    a = SimpleNamespace(**dict(zip(model.input_names, u, strict=True)))
    return dynamics(s, a, values)


def fly(x, u, seconds):
    return stepped(model, np.tile(u, (round(seconds / DT), 1)), DT, x)


def column(path, name):
    return path[:, model.state_names.index(name)]


@pytest.fixture(scope="module")
def straight():
    return level_trim(model, 11.0)


def test_exactly_43_parameters_12_states_4_inputs():
    assert (len(model.params), model.n, model.m) == (43, 12, 4)
    assert (VALUES.mass, VALUES.b) == (1.0, 1.5)  # footnote 13


def test_lift_carries_the_weight_in_trim(straight):
    x, u = straight
    found = rates(x, u)
    held = [name for name in model.state_names if name not in ("north", "east", "psi")]
    assert max(abs(found[name]) for name in held) < 1e-8
    assert np.hypot(found["north"], found["east"]) == pytest.approx(11.0, abs=1e-6)
    assert 0 < u[0] < 1


def test_trim_is_held_for_ten_seconds(straight):
    path = fly(*straight, 10.0)
    assert np.abs(column(path, "altitude")).max() < 1e-6
    assert np.abs(column(path, "east")).max() < 1e-6
    assert column(path, "north")[-1] == pytest.approx(110.0, abs=1e-4)


def test_a_coordinated_turn_banks_by_its_turn_rate():
    # a level coordinated turn: tan(phi) = omega V / g, point mass; the wing body's lift tilts a bit
    for omega in (-0.2, 0.2):
        start, held = level_trim(model, 9.0, omega)
        path = fly(start, held, 2.0)
        turned = column(path, "psi")[-1] - column(path, "psi")[0]
        assert turned == pytest.approx(2.0 * omega, abs=1e-6)
        phi = start[model.state_names.index("phi")]
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
    moved[model.input_names.index(surface)] += change
    assert sign * (rates(x, moved)[rate] - rates(x, u)[rate]) > 0.01


def test_statically_stable_in_pitch_and_yaw(straight):
    x, u = straight
    up, right = x.copy(), x.copy()
    up[model.state_names.index("w")] += 0.3  # the air comes from below: nose down
    right[model.state_names.index("v")] += 0.3  # the air comes from the right: nose right
    assert rates(up, u)["q"] < rates(x, u)["q"]
    assert rates(right, u)["r"] > rates(x, u)["r"]


def test_symmetric_flight_stays_symmetric(straight):
    x, _ = straight
    values = SimpleNamespace(**(vars(VALUES) | {"k_Q": 0.0}))
    x = x * [name not in ("v", "phi", "psi", "p", "r") for name in model.state_names]
    found = rates(x, np.array([0.9, 0.0, -0.1, 0.0]), values)
    assert all(found[name] == 0 for name in ("v", "phi", "psi", "p", "r", "east"))


def test_without_air_energy_and_spin_are_kept():
    still = model.with_values({"rho": 0.0})
    x = np.array([[0, 0, 100, 8, 1, 2, 0.2, 0.1, 0.3, 0.5, 0.4, -0.6]])
    inertia = np.array(
        [[VALUES.Jx, 0, -VALUES.Jxz], [0, VALUES.Jy, 0], [-VALUES.Jxz, 0, VALUES.Jz]]
    )

    def energy(x):
        v, w = x[0, 3:6], x[0, 9:12]
        return 0.5 * v @ v + 9.81 * x[0, 2] + 0.5 * w @ inertia @ w

    after = stepped(still, np.zeros((100, 4)), DT, x[0])[-1:]
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
        level_trim(model.with_values({"rho": 0.0}), 9.0, 0.0)
    with pytest.raises(GroundedError, match=holding(f"'{pendulum.name}'")):
        level_trim(pendulum, 3.0, 0.0)


def test_the_figure8_closes_in_sixty_seconds():
    path, speed, rate = figure8_target()
    assert path.shape == (3001, 3) and speed.min() >= 9 - 1e-9 and speed.max() <= 11 + 1e-9
    assert np.abs(path[-1] - path[0]).max() < 0.5  # one lap
    assert np.ptp(path[:, 0]) == pytest.approx(np.ptp(path[:, 1]), rel=0.01)
    assert np.abs(rate).max() == pytest.approx(9 / 42, rel=1e-3)
    change = np.diff(rate) / DT
    assert np.abs(change).max() < 2.1 * (9 / 42)  # a Hann window of 1 s: at most twice the jump
    assert (path[:, 2] == 0).all()


def test_the_task_weighs_positions_and_inputs_alone():
    task = flight_task(model)
    assert task.horizon == 3000 and task.dt == 0.02
    assert task.reward.state.tolist() == [1, 1, 1] + [0] * 9
    assert task.reward.input.tolist() == [1] * 4
    assert task.reward.input_change.tolist() == [1e5] * 4
    other = flight_task(perturbed(model, np.random.default_rng(0)), started_by=model)
    assert other.hash == task.hash  # one real task, whatever model plans it


def test_every_parameter_is_perturbed_by_its_own_factor():
    other = perturbed(model, np.random.default_rng(3))
    factor = other.values / model.values
    assert factor.min() >= 0.8 and factor.max() <= 1.2
    assert len(np.unique(factor)) == 43
    assert (perturbed(model, np.random.default_rng(3)).values == other.values).all()
