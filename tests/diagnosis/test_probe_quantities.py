"""A probe holds what the diagnosis did not estimate; it ended with KeyError 'b' on a belt drive."""

from types import SimpleNamespace

from grounded.diagnosis.excitation import _effect
from grounded.effects import Library, Scales
from grounded.models.car import model as car


def test_a_quantity_that_was_not_estimated_is_held():
    name = "input_curve:steering"
    assert [q.name for q in Library().effect(name, car, Scales()).free] == ["a", "b"]
    found = SimpleNamespace(made=None, ranked=lambda _: SimpleNamespace(params={"b": None}))
    effect = _effect(Library(), name, SimpleNamespace(model=car), found, Scales())
    assert [q.name for q in effect.free] == ["b"]
