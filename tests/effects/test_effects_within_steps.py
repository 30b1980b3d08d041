"""What arrives early within a step moves positions farther (`MemoryFamily.lead`)."""

import numpy as np
import pytest

from grounded.effects.actuator import first_order_lag, rate_limit
from grounded.effects.memory import Sent, shifted_within

DT, FINE = 0.02, 200


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
