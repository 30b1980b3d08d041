"""One name for one effect: what a bias or a parameter does exactly is not offered twice."""

import pytest

from grounded.effects import Library
from grounded.effects.registry import aliases
from grounded.model import Model, Param
from grounded.models.aircraft import model as aircraft
from grounded.models.car import model as car
from grounded.models.pendulum import model as pendulum


def names(model, library=None):
    return {effect.name for effect in (library or Library()).candidates(model)}


def test_the_rates_that_are_something_else():
    assert aliases(pendulum) == {"offset:omega": "input_bias:torque"}
    found = aliases(car, ["psi_rate"])
    assert found == {
        "offset:delta": "parameter:b1",
        "rate_gain:delta": "parameter:tau_delta",
        "rate_gain:psi": "parameter:L",
    }
    assert aliases(aircraft) == {}


@pytest.mark.parametrize("dropped", ["offset:delta", "rate_gain:delta", "rate_gain:psi"])
def test_it_is_offered_by_the_other_name_only(dropped):
    other = aliases(car, ["psi_rate"])[dropped]
    assert dropped not in names(car)
    assert other in names(car)
    assert dropped in names(car, Library().without([other.partition(":")[0]]))


def test_a_parameter_that_may_not_move_does_not_stand_for_an_effect():
    def model(low, high):
        return Model(
            states={"v": "m/s"},
            inputs={"u": "1"},
            params={"tau": Param(1.0, "s", low, high), "k": Param(2.0, "m/s")},
            derivative=lambda s, a, p: {"v": (p.k * a.u - s.v) / p.tau},
        )

    assert aliases(model(0.1, 10.0))["rate_gain:v"] == "parameter:tau"
    assert "rate_gain:v" not in aliases(model(0.9, 1.1))


def test_a_parameter_that_is_blamed_goes_no_further_than_its_std_lets_it():
    known = Model(
        states={"v": "m/s"},
        inputs={"u": "N"},
        params={"m": Param(2.0, "kg", std=0.1), "k": Param(1.0, "1", 0.2, 3.0)},
        derivative=lambda s, a, p: {"v": (p.k * a.u - s.v) / p.m},
    )
    m, k = (Library().effect(f"parameter:{name}", known).quantities[0] for name in "mk")
    assert (m.low, m.high) == pytest.approx((-0.3, 0.3))
    assert (k.low, k.high) == pytest.approx((-0.8, 2.0))
