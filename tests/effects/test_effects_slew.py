"""slew_limit: a state that moves only so fast, however stiff the model that drives it."""

import numpy as np
import pytest

from grounded import Model, Param
from grounded.effects import Library, wrap

DT = 0.02


def servo(tau):
    return Model(
        name="servo",
        states={"angle": "rad"},
        inputs={"command": "rad"},
        params={"tau": Param(tau, "s", std=0.3 * tau)},
        derivative=lambda s, a, p: {"angle": (a.command - s.angle) / p.tau},
    )


def limit(model, target="angle"):
    return Library().effect(f"slew_limit:{target}", model)


@pytest.mark.parametrize("tau", [0.02, 0.07])
def test_a_long_way_goes_at_the_limit_and_arrives(tau):
    model = servo(tau)
    fast = wrap(limit(model), {"r": 1.5}, DT)
    x, u = [0.0], np.array([[0.6]])
    for _ in range(60):
        after = fast.system.step(np.array([[x[-1]]]), u, fast.values, DT)
        x.append(float(after[0, 0]))
    np.testing.assert_allclose(x[1:16], 1.5 * DT * np.arange(1, 16), atol=1e-12)
    assert x[-1] == pytest.approx(0.6, abs=1e-3)
    assert np.diff(x).max() <= 1.5 * DT + 1e-12
