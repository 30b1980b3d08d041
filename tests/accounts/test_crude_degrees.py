"""Degrees in every log, of a body that the model knows too little of to predict it.

An arm with a payload and dry friction was missed by four times what it did, in radians: `unknown`
was said, and a negative mass, of angles of +-90 `rad`.
"""

from dataclasses import replace

import numpy as np
import pytest
from grounded.accounts.sound_trials import sound_trials as preflight

from grounded import Model, Param, Trial
from grounded.accounts.finding import DEGREES

DT, FINE = 0.02, 20  # [s], and parts of a step
ARM = Model(
    states={"q": "rad", "w": "rad/s"},
    inputs={"u": "N m"},
    params={"b": Param(0.3, "1/s", 0.0, 3.0)},
    derivative=lambda s, a, p: {"q": s.w, "w": a.u - p.b * s.w - 4 * np.sin(s.q)},
)


def driven(force, start, friction, load, seed=0, steps=800):
    """A trial of an arm with friction [N m] and a load that ARM lacks, `force(t, q, w)` on it."""
    x, states, sent = np.array(start, float), [start], []
    for k in range(steps):
        u = force(k * DT, *x)
        for _ in range(FINE):
            turn = 0.7 * (u - load * np.sin(x[0]) - friction * np.tanh(x[1] / 0.02) - 0.5 * x[1])
            x = x + DT / FINE * np.array([x[1], turn])
        states.append(x)
        sent.append([u])
    noise = np.random.default_rng(seed).normal(size=(steps + 1, 2)) * [1e-4, 1e-2]
    return Trial(np.array(states) + noise, np.array(sent), DT, ("q", "w"), ("u",))


def jogged(seed, friction, load):
    """It follows a slow way, its gravity known."""

    def force(t, q, w):
        wanted = 0.5 + 0.6 * np.sin(1.1 * t + seed) + 0.3 * np.sin(2.9 * t)
        rate = 0.66 * np.cos(1.1 * t + seed) + 0.87 * np.cos(2.9 * t)
        return load * np.sin(q) + 60 * (wanted - q) + 8 * (rate - w)

    return driven(force, (0.5, 0.0), friction, load, seed)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(("friction", "load"), [(0, 10), (2, 6), (2, 10), (4, 6)])
def test_angles_in_degrees_are_told_by_which_way_a_crude_model_says_they_go(seed, friction, load):
    sound = jogged(seed, friction, load)
    assert not [f for f in preflight(ARM, [sound]).findings if f.kind == "degrees"]
    turned = replace(sound, states=np.rad2deg(sound.states))
    found = preflight(ARM, [turned])
    assert [(f.signal, f.kind) for f in found.findings] == [("q", "degrees"), ("w", "degrees")]
    np.testing.assert_allclose(found.trials[0].states, sound.states)


@pytest.mark.parametrize("friction", [0, 2])
def test_an_arm_that_spins_is_not_in_degrees(friction):
    spun = driven(lambda t, q, w: 9 + 4 * np.sin(2 * t), (0.0, 0.0), friction, 6)
    assert np.ptp(spun.states[:, 0]) > 8 * np.pi
    assert all_in_degrees(ARM, [spun], range(2)) == []


def balancer(tall, strong, drag):
    """A body upright on driven wheels, its inner loop unknown to the model."""
    return Model(
        states={"x": "m", "v": "m/s", "tilt": "rad", "rate": "rad/s"},
        inputs={"volt": "V"},
        params={"tall": Param(tall, "1/s^2", 20.0, 200.0), "strong": Param(strong, "m/s^2/V", 0.5)},
        derivative=lambda s, a, p: {
            "x": s.v,
            "v": p.strong * a.volt - drag * s.v + 3.0 * np.sin(s.tilt),
            "tilt": s.rate,
            "rate": p.tall * np.sin(s.tilt) - 6.0 * (p.strong * a.volt - drag * s.v),
        },
    )


def balanced(model, late, seed=0, steps=1500):
    """A run of the balancer under feedback that rocks it, with its commands late."""
    rng, x, states, sent = np.random.default_rng(seed), np.zeros(4), [np.zeros(4)], []
    for k in range(steps):
        rock = 0.03 * np.sin(0.01 * k) + 0.02 * np.sin(0.037 * k)
        volt = 12 * (x[2] - rock) + 1.5 * x[3] + 1.2 * x[0] + 2.0 * x[1]
        sent.append([np.clip(volt + 0.5 * rng.normal(), -8, 8)])
        u = np.array(sent[max(k - late, 0)])
        x = model.system.step(x[None], u[None], model.values, 0.01)[0]
        states.append(x)
    noise = rng.normal(size=(steps + 1, 4)) * [1e-4, 2e-3, 1e-3, 1e-2]
    return Trial(np.array(states) + noise, np.array(sent), 0.01, tuple(model.states), ("volt",))


def test_tilts_in_degrees_of_an_unstable_body_are_told_by_a_calibrated_model():
    """A balancer's tilt of 4.9 "rad" was explained by a rotor of 25 V s^2/m, and not warned of."""
    crude, sound = balancer(90.0, 3.0, 0.0), balanced(balancer(60.0, 2.2, 1.0), late=2)
    assert 0.02 < np.abs(sound.states[:, 2]).max() < 0.5
    turned = replace(sound, states=sound.states * [1, 1, DEGREES, DEGREES])
    told = [f.signal for f in preflight(crude, [turned]).findings if f.kind == "degrees"]
    assert told == ["tilt", "rate"]
    assert all_in_degrees(crude, [sound], range(4)) == []
    large = replace(sound, states=sound.states * [1, 1, 8, 8])  # nothing that degrees explain
    assert all_in_degrees(crude, [large], range(4)) == []


@pytest.mark.parametrize("weak", [0.1, 10.0])
def test_an_input_of_another_strength_is_no_angle_in_degrees(weak):
    spun = Model(
        states={"q": "rad", "w": "rad/s"},
        inputs={"u": "V"},
        derivative=lambda s, a, p: {"q": s.w, "w": 40 * weak * a.u - 2 * s.w},
    )
    rng = np.random.default_rng(0)
    u, x, states = np.repeat(rng.uniform(-1, 1, 40), 20), np.zeros(2), [np.zeros(2)]
    for one in u:
        x = x + 0.01 * np.array([x[1], 40 * one - 2 * x[1]])
        states.append(x)
    trial = Trial(np.array(states), u[:, None], 0.01, ("q", "w"), ("u",))
    assert np.abs(trial.states[:, 0]).max() > 1.0
    assert all_in_degrees(spun, [trial], range(2)) == []
