"""A likely effect stays without which the model's parameters would end at their bounds.

A balancer's delay of 24 ms was dropped: its moment of inertia, at 7 times the model's value and at
its bound, predicted 0.5 s ahead as well. Nothing could be adopted from that. It does not stay if
predictions lose nothing without it: an arm's verdict claimed a `rate_gain` worth `+0.0 %`.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from grounded import Model, Param
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.validation import decide
from grounded.diagnosis.validation.decide import Decision
from grounded.diagnosis.validation.gain import Gain
from grounded.effects import Library

MODEL = Model(
    states={"q": "rad", "w": "rad/s"},
    inputs={"u": "V"},
    params={"I": Param(0.003, "kg m^2", 0.0005, 0.02), "km": Param(0.05, "N m/V", 0.02, 0.12)},
    derivative=lambda s, a, p: {"q": s.w, "w": p.km * a.u / p.I},
)


def fitted(inertia, *names):
    """A fit with these effects and this moment of inertia."""
    library = Library()
    effects = tuple(library.effect(name, MODEL) for name in names)
    values = tuple({q.name: 0.02 for q in effect.free} for effect in effects)
    shift = np.array([inertia - 0.003, 0.0])
    return SimpleNamespace(hypothesis=Hypothesis(effects, values, shift, 1.0))


def decision(fit, less, nats):
    """The decision for `fit`, whose delay is worth `nats`."""
    search = SimpleNamespace(
        data=SimpleNamespace(model=MODEL), score=lambda f: nats if f is fit else 0.0
    )
    return Decision(search, search, fit, less, {"delay:u": less})


@pytest.mark.parametrize(
    ("inside", "without", "nats", "held"),
    [
        (0.005, 0.02, 766.0, {"delay:u": ("I",)}),
        (0.005, 0.019, 766.0, {}),  # no bound is reached
        (0.02, 0.02, 766.0, {}),  # it does not help
        (0.005, 0.02, 20.0, {}),  # too unlikely to be held against better predictions
    ],
)
def test_what_keeps_a_parameter_off_its_bound_is_told(inside, without, nats, held):
    fit = fitted(inside, "delay:u")
    assert decision(fit, fitted(without), nats).held_up == held


@pytest.mark.parametrize(("gain", "kept"), [(0.01, True), (0.0, False), (-0.02, False)])
def test_what_predictions_lose_nothing_without_is_not_claimed(monkeypatch, gain, kept):
    """It keeps the inertia off its bound, but a claim has to help on data it has not seen."""
    found, fit, doubtful = pruned(monkeypatch, gain, pays=False, trials=4)
    assert (found is fit) is kept
    assert [one.name for one in doubtful] == ([] if kept else ["delay:u"])  # told as unconfirmed


@pytest.mark.parametrize(
    ("gain", "trials", "kept"), [(0.03, 4, True), (0.003, 4, False), (0.003, 1, True)]
)
def test_what_pays_in_one_state_has_to_help_in_the_mean(monkeypatch, gain, trials, kept):
    """A circle's verdict named a tracked point 11 mm off its place: `+0.0 %`."""
    found, fit, _ = pruned(monkeypatch, gain, pays=True, trials=trials, rest=0.004)
    assert (found is fit) is kept


@pytest.mark.parametrize(
    ("name", "nats", "left", "told", "kept"),
    [
        ("sensor_delay:w", 766.0, (), False, True),
        ("sensor_delay:w", 30.0, (), False, False),  # likely, but not beyond all doubt
        ("sensor_bias:w", 766.0, (), False, False),  # a trifle in each step is one a second ahead
        ("delay:u", 30.0, ("less",), True, True),
        ("delay:u", 30.0, ("less",), False, False),  # predictions don't gain by a correction of it
        ("delay:u", 30.0, ("less", "fit"), True, False),  # something else is left
        ("delay:u", 5.0, ("less",), True, False),
    ],
)
def test_what_shows_in_one_channel_or_closes_a_gap_is_claimed(
    monkeypatch, name, nats, left, told, kept
):
    """A boat's speed v was logged 0.1 s late: 67 nats, 6 % of the errors in v, 0.3 % in the mean.

    It was left out, and the verdict was a gap in x "that no known effect explains".
    """
    monkeypatch.setattr(decide, "corrections", lambda ruler, fit, left: left if told else {})
    found, fit, _ = pruned(
        monkeypatch, 0.003, pays=True, trials=4, rest=0.004, name=name, nats=nats, left=left
    )
    assert (found is fit) is kept


def pruned(monkeypatch, gain, pays, trials, rest=0.02, name="delay:u", nats=766.0, left=()):
    """What `_pruned` makes of an effect with such a mean gain.

    left: the fits with a leftover, "fit" with the effect or "less" without it.
    """
    fit, less, bare = fitted(0.005, name), fitted(rest), fitted(0.003)
    fits, off = {name: less, "calibration": bare}, {"fit": fit, "less": less}
    monkeypatch.setattr(
        decide,
        "leftovers",
        lambda _, f: [SimpleNamespace(channel="w") for n in left if off[n] is f],
    )
    monkeypatch.setattr(decide, "fit_without", lambda search, f, name, ruler: fits[name])
    monkeypatch.setattr(decide, "counterparts", lambda *_: [])
    monkeypatch.setattr(decide, "repeats", lambda *_: 0)
    monkeypatch.setattr(decide, "of_no_size", lambda *_: [])
    monkeypatch.setattr(decide, "folds", lambda data: None)
    monkeypatch.setattr(decide, "_pays", lambda search, ruler, rest, *_: pays or rest is bare)

    def gained(before, after):
        by = gain if before is less else 0.5
        return Gain(by, 0.1, by, np.array([max(by, 0.03 * pays)]), np.array([0.1]))

    ruler = SimpleNamespace(
        held_out=True, gain=gained, since_outset=lambda f: 1.0, negligible=lambda f, state: False
    )
    search = SimpleNamespace(
        data=SimpleNamespace(model=MODEL, count=trials),
        predictor=None,
        tempering=SimpleNamespace(factor=1.0),
        score=lambda f: nats * (f is fit),
    )
    found, _, doubtful = decide._pruned(search, fit, ruler, True)
    return found, fit, doubtful
