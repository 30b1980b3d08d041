"""Model and Param: names, units, angles, and the errors for wrong arguments."""

import numpy as np
import pytest

from facts import holding
from grounded.checks import near
from grounded.errors import GroundedError
from grounded.model import Model, Param
from small_tasks import black_box, cart, cart_dynamics, rover


def model(**changes):
    fields = {
        "name": "toy",
        "states": {"x": "m", "v": "m/s"},
        "inputs": {"force": "N"},
        "params": {"mass": Param(1.0), "drag": Param(0.2)},
        "derivative": cart_dynamics,
    }
    return Model(**fields | changes)


def test_names_are_in_the_order_of_declaration():
    assert (rover.n, rover.m) == (3, 2)
    assert rover.state_names == ("x", "y", "psi") and rover.input_names == ("speed", "turn")
    assert rover.param_names == ("gain", "yaw", "dead")
    np.testing.assert_array_equal(rover.values, [1.0, 1.0, 0.05])
    np.testing.assert_array_equal(rover.angle_mask, [False, False, True])


def test_differences_of_angles_wrap_and_the_arguments_stay():
    a, b = np.array([[1.0, 0.0, 3.1]]), np.array([[0.0, 0.0, -3.1]])
    kept = a.copy()
    np.testing.assert_allclose(rover.difference(a, b), [[1.0, 0.0, 6.2 - 2 * np.pi]])
    np.testing.assert_array_equal(a, kept)
    np.testing.assert_allclose(rover.difference(a + 4 * np.pi, a)[0, 2], 0.0, atol=1e-12)
    assert np.isnan(rover.difference(np.array([0, 0, np.nan]), b[0])[2])


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"derivative": None}, holding("exactly one", "derivative=")),
        ({"step": cart_dynamics}, holding("exactly one", "derivative=")),
        ({"integrator": "heun"}, holding("rk4", "euler", "'heun'")),
        ({"states": {}}, holding("state")),
        ({"inputs": {}}, holding("input", "free motion", "column of zeros")),
        ({"inputs": {"x": "N"}}, holding("'x'", "twice")),
        ({"params": {"mass": 1.0}}, holding("'mass'", "Param", "float")),
        ({"params": {"v": Param(1.0)}}, holding("'v'", "state", "parameter")),
        ({"states": {"my state": "m"}}, holding("'my state'")),
        ({"angles": ("psi",)}, holding("angle", "'psi'", "x and v")),
        ({"angles": ("vv",)}, holding("angle", "'vv'", "'v'")),
        ({"roles": {"position": ("x", "y")}}, holding("position", "'y'")),
        ({"roles": {"position": ("x", "x", "x", "x")}}, holding("position", "three")),
        ({"roles": {"positon": "x"}}, holding("positon", "did you mean", "position")),
    ],
    ids=lambda v: " ".join(v) if isinstance(v, dict) else str(v)[:40],
)
def test_a_wrong_declaration_says_what_is_wrong(change, match):
    with pytest.raises(GroundedError, match=match):
        model(**change)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_parameter_is_a_number(value):
    with pytest.raises(GroundedError, match="finite"):
        Param(value)


def test_a_parameter_lies_between_its_bounds():
    with pytest.raises(GroundedError, match=holding("2.0", "0 to 1")):
        Param(2.0, "1", 0.0, 1.0)
    with pytest.raises(GroundedError, match=holding("1.0", "0.0")):
        Param(0.5, "1", 1.0, 0.0)
    with pytest.raises(GroundedError):
        Param(0.5, std=0.0)
    two = Param(0.5, "1", 0.0, 1.0)
    assert two.at_bound(0.0) and two.at_bound(1.0) and not two.at_bound(0.999)
    assert not Param(0.5, std=0.1).at_bound(0.5) and not Param(0.5).at_bound(0.5)
    assert not two.stopped(0.9) and two.stopped(1.0) == "bound" and not Param(0.5).stopped(0.5)
    prior = Param(0.5, std=0.1)
    assert prior.reach == pytest.approx((0.2, 0.8)) and prior.stopped(prior.reach[1]) == "prior"
    assert not prior.stopped(0.799) and Param(-0.5, std=1.0).reach == (-3.5, -0.1)
    assert Param(0.5, "1", 0.0, 1.0, std=0.1).stopped(0.8) == "prior"
    assert not Param(0.5).uncertain and not Param(0.5, "1", 0.5, 0.5).uncertain
    assert Param(0.5, "1", 0.0, 1.0).spread == pytest.approx(1 / 12**0.5)
    assert Param(0.5, std=0.1).spread == 0.1 and Param(0.5, std=0.1).uncertain


def test_other_values_make_a_copy_and_widen_bounds():
    changed = cart.with_values({"mass": 20.0})
    assert cart.params["mass"].value == 1.0 and changed.params["mass"].value == 20.0
    assert changed.params["mass"].high == 20.0 and changed.params["mass"].low == 0.1
    assert changed.params["mass"].unit == "kg" and changed.values[0] == 20.0
    with pytest.raises(GroundedError, match=holding("'mas'", "'cart'", "'mass'")):
        cart.with_values({"mas": 1.0})


def test_what_was_declared_cannot_be_changed():
    with pytest.raises(TypeError):
        cart.states["z"] = "m"  # type: ignore[index]
    with pytest.raises(ValueError, match="read-only"):
        cart.values[0] = 3.0


def test_rk4_and_euler_by_hand():
    x, u = np.array([[0.5, 2.0]]), np.array([[3.0]])
    rate = np.array([2.0, 3.0 - 0.2 * 2.0])
    euler = model(integrator="euler")
    np.testing.assert_allclose(
        euler.system.step(x, u, euler.values, 0.1)[0], x[0] + 0.1 * rate, atol=1e-15
    )
    # v' = f - d v has the solution v(t) = f/d + (v0 - f/d) exp(-d t); RK4 is exact to h^5
    rk4 = model()
    v = 15.0 + (2.0 - 15.0) * np.exp(-0.2 * 0.1)
    assert rk4.system.step(x, u, rk4.values, 0.1)[0, 1] == pytest.approx(v, abs=1e-9)


def test_a_black_box_step_is_a_model_too():
    x, u = np.array([[1.0, 0.0], [-1.0, 0.0]]), np.zeros((2, 1))
    v = [-0.1, 0.2]
    found = black_box.system.step(x, u, black_box.values, 0.1)
    np.testing.assert_allclose(found, [[1 - 0.01, v[0]], [-1 + 0.02, v[1]]], atol=1e-12)
    f_x, f_u = black_box.system.linearise(x, u, black_box.values, 0.1)
    np.testing.assert_allclose(f_x[0], [[1 - 0.01, 0.1], [-0.1, 1.0]], atol=1e-6)
    np.testing.assert_allclose(f_x[1], [[1 - 0.02, 0.1], [-0.2, 1.0]], atol=1e-6)
    np.testing.assert_allclose(f_u[:, :, 0], [[0.01, 0.1]] * 2, atol=1e-6)


def test_the_nearest_name():
    assert near("steerng", ["steering", "throttle"]) == {"near": "steering"}
    assert near("zzz", ["a", "b"]) == {"known": ("a", "b")}
