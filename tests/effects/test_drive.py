"""The speed of a wheel: found from the model, kept under adopted effects, and what it loses."""

from dataclasses import replace

import numpy as np
import pytest

from grounded import Model, Param
from grounded.effects.drive import weights_at
from grounded.models.arm import model as arm

DT, HALF_TRACK = 0.02, 0.15


def drives(s, a, p):
    """Force of each wheel [N]: its voltage less the back-EMF of its own speed."""
    left, right = s.v - p.h * s.r, s.v + p.h * s.r
    return p.k * (a.left - p.e * left), p.k * (a.right - p.e * right)


def moved(s, a, p):
    left, right = drives(s, a, p)
    return {
        "x": s.v * np.cos(s.psi),
        "y": s.v * np.sin(s.psi),
        "psi": s.r,
        "v": (left + right) / p.m,
        "r": p.h * (right - left) / p.I,
    }


rover = Model(
    name="rover",
    states={"x": "m", "y": "m", "psi": "rad", "v": "m/s", "r": "rad/s"},
    inputs={"left": "V", "right": "V"},
    params={
        "m": Param(4.0, "kg", 2.0, 8.0),
        "I": Param(0.12, "kg m^2", 0.05, 0.3),
        "h": Param(HALF_TRACK, "m"),
        "k": Param(2.0, "N/V"),
        "e": Param(6.0, "V s/m"),
    },
    angles=("psi",),
    derivative=moved,
)


def other(**terms):
    """The rover with other rates, which `terms` compute from s."""

    def dynamics(s, a, p):
        rates = moved(s, a, p)
        return rates | {name: rates[name] + more(s) for name, more in terms.items()}

    return replace(rover, derivative=dynamics)


cart = Model(
    name="cart",  # as a textbook has it, with a crude track
    states={"psi": "rad", "v": "m/s", "r": "rad/s"},
    inputs={"left": "1", "right": "1"},
    params={
        "k": Param(0.8, "m/s", 0.3, 2.0),
        "track": Param(0.25, "m", 0.15, 0.5),
        "tau": Param(0.2, "s", 0.03, 1.0),
        "tau_r": Param(0.2, "s", 0.03, 1.0),
    },
    angles=("psi",),
    derivative=lambda s, a, p: {
        "psi": s.r,
        "v": (p.k * (a.left + a.right) / 2 - s.v) / p.tau,
        "r": (p.k * (a.right - a.left) / p.track - s.r) / p.tau_r,
    },
)


def test_the_weights_of_a_wheels_speed_follow_the_track():
    crudely = dict(zip(cart.param_names, cart.values, strict=True))
    values = crudely | {"track": 0.3, "tau_r": 0.1, "delay_d": 0.02}  # of an adopted effect, too
    for name, side in (("left", -1), ("right", 1)):
        at = weights_at(cart, f"{name}<-v+r", values)
        crude = weights_at(cart, f"{name}<-v+r", crudely)
        other = {one for one in at if one != next(iter(at))}.pop()
        ratio = {"r": 0.15, "v": 1 / 0.15}[other]
        assert at[other] == pytest.approx(side * ratio, rel=1e-6)
        assert crude[other] == pytest.approx(side * (0.125 if other == "r" else 8.0), rel=1e-6)
    assert weights_at(arm, "tau1<-w1", {}) == {"w1": 1.0}
