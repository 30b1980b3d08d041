"""One name for one effect: what a bias or a parameter does exactly is not offered twice."""

import pytest

from grounded.effects import Library
from grounded.effects.registry import aliases
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
