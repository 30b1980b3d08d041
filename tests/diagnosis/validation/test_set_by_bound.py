"""An effect whose size is set by a bound of the model's parameters is not claimed.

The model of a boat that nobody here wrote has a cross term that the boat lacks. "The speed changes
69 % slower" made the term smaller, and four times the thrust, up to its bound, kept the rest as it
was: named as a cause, adopted, it put the moment of inertia at three times its value.
"""

import numpy as np
import pytest

from grounded import Model, Param, Trial, diagnose


def boat(cross):
    """Forward speed, with a cross term of sway and turn rate."""
    return Model(
        name="boat",
        states={"u": "m/s", "v": "m/s", "r": "rad/s"},
        inputs={"f": "1", "g": "m/s^2", "h": "rad/s^2"},
        params={"k": Param(0.8, "m/s^2", 0.2, 3.2), "c": Param(0.4, "1/s", 0.0, 5.0)},
        derivative=lambda s, a, p: {
            "u": p.k * a.f - p.c * s.u + cross * s.v * s.r,
            "v": a.g - 0.8 * s.v,
            "r": a.h - 0.9 * s.r,
        },
    )


def drives(real, count=3, dt=0.05):
    """Steps of all inputs; the real boat has k = 1 and c = 0.5."""
    rng, found = np.random.default_rng(0), []
    for _ in range(count):
        inputs = np.column_stack([w * np.repeat(rng.uniform(-1, 1, 25), 12) for w in (1, 2.5, 2.5)])
        states = [np.zeros(3)]
        for row in inputs:
            after = real.system.step(states[-1][None], row[None], np.array([1.0, 0.5]), dt)[0]
            states.append(after + 1e-3 * rng.standard_normal(3))
        measured = np.array(states) + 3e-3 * rng.standard_normal((len(states), 3))
        found.append(Trial(measured, inputs, dt, real.state_names, real.input_names))
    return found


@pytest.mark.parametrize(("real", "claimed"), [(0.6, ("rate_gain:u",)), (0.0, ())])
def test_an_effect_that_only_a_bound_limits_is_not_claimed(real, claimed):
    """With a term that is too large by half, gain and parameters describe it, inside the bounds."""
    found = diagnose(boat(1.4), drives(boat(real)))
    assert found.verdict.effects == claimed
    assert found.verdict.parameters == (("k", "c") if claimed else ())
    assert found.verdict.sentence.startswith("A gap remains") is not bool(claimed)
    rows = {row.effect: row for row in found.ranking}
    assert rows["rate_gain:u"].claimed is bool(claimed)
