"""What arrives early within a step moves positions farther (`MemoryFamily.lead`)."""

import numpy as np
import pytest

from grounded import Model, Trial
from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.effects import Library
from grounded.effects.actuator import first_order_lag, rate_limit
from grounded.effects.memory import Sent, shifted_within

DT, FINE = 0.02, 200
LIBRARY = Library()

joint = Model(
    states={"q": "rad", "w": "rad/s"},
    inputs={"torque": "N m"},
    params={},
    derivative=lambda s, a, p: {"q": s.w, "w": 5.0 * a.torque - 0.4 * s.w},
    name="joint",
)


def received(name, value, commands):
    """The torque at the middle of every fine part of every step, (T, FINE)."""
    t = (np.arange(FINE) + 0.5) / FINE * DT
    found, z = [], commands[0]
    late = np.concatenate([np.repeat(commands[:1], 50), commands])
    for k, u in enumerate(commands):
        if name == "delay":
            back = np.floor((k * DT + t - value) / DT + 1e-9).astype(int)
            found.append(late[back + 50])
        elif name == "first_order_lag":
            found.append(u + (z - u) * np.exp(-t / value))
            z = u + (z - u) * np.exp(-DT / value)
        else:
            found.append(z + np.clip(u - z, -value * t, value * t))
            z += float(np.clip(u - z, -value * DT, value * DT))
    return np.array(found)


def commands_of(seed, count=150):
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(-1, 1, count // 3), 3) + 0.2 * rng.standard_normal(count)


def trial(name, value, seed, noise=1.0):
    """A joint simulated in fine parts, with an encoder of 1e-5 rad."""
    u, x, states = commands_of(seed), np.zeros(2), [np.zeros(2)]
    for row in received(name, value, u):
        for torque in row:
            rate = 5.0 * torque - 0.4 * x[1]
            h = DT / FINE
            x = x + h * np.array([x[1] + 0.5 * h * rate, rate * (1 - 0.2 * h)])
        states.append(x)
    rng = np.random.default_rng(seed + 100)
    y = np.array(states) + noise * np.array([1e-5, 2e-4]) * rng.standard_normal((len(u) + 1, 2))
    return Trial(y, u[:, None], DT, ("q", "w"), ("torque",), start_inputs=u[:1])


CASES = [("delay", 0.0083), ("delay", 0.0312), ("first_order_lag", 0.012), ("rate_limit", 15.0)]


@pytest.mark.parametrize(("name", "value"), CASES)
def test_a_lead_is_the_first_moment_of_what_arrives_in_a_step(name, value):
    u = commands_of(1)
    arriving = received(name, value, u)
    early = 0.5 - (np.arange(FINE) + 0.5) / FINE
    expected = (early * arriving).mean(axis=1)
    if name == "delay":
        still = np.zeros((1, len(u)))
        (mean,), (found,) = shifted_within(Sent(u[None], u[:1], still, u[None], still), value / DT)
        np.testing.assert_allclose(mean, arriving.mean(axis=1), atol=2e-3)
    else:
        family = {"first_order_lag": first_order_lag, "rate_limit": rate_limit}[name]
        c = {"tau": value} if name == "first_order_lag" else {"r": value}
        found = family.lead(u, family.along(u[None], u[:1], c, DT)[0], c, DT)
    np.testing.assert_allclose(found, expected, atol=2e-3)
    assert np.abs(expected).max() > 0.02


@pytest.mark.parametrize(("name", "value"), CASES)
def test_a_delay_of_a_part_of_a_step_is_estimated_from_encoders(name, value):
    data = prepare(joint, [trial(name, value, seed) for seed in (1, 2)], np.zeros(1))
    effect = LIBRARY.effect(f"{name}:torque", joint, data.scales)
    (q,) = effect.free
    search = HypothesisSearch(data, (effect,))
    start = search.fresh(Hypothesis().plus(effect, {q.name: 1.2 * value}))
    (fit,) = search.refined([start], 25)
    assert fit.hypothesis.values[0][q.name] == pytest.approx(value, rel=0.02)
