"""Degrees in every log, of a body that the model knows too little of to predict it.

An arm with a payload and dry friction was missed by four times what it did, in radians: `unknown`
was said, and a negative mass, of angles of +-90 `rad`.
"""

from dataclasses import replace

import numpy as np
import pytest

from grounded import Model, Param, Trial
from grounded.instruments.odd_trial import all_in_degrees
from grounded.instruments.preflight import preflight

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
