"""Five causes at once: more effects are looked for where the first three leave a gap."""

import numpy as np
import pytest

from grounded import Model, Param, Trial
from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.effects import Library

DT = 0.02
SLED = Model(
    name="sled",
    states={"x": "m", "v": "m/s"},
    inputs={"u": "N"},
    params={"m": Param(1.0, "kg")},
    derivative=lambda s, a, p: {"x": s.v, "v": a.u / p.m},
)
TRUE = {
    "delay:u": ("d", 2 * DT),
    "dead_zone:u": ("c", 0.15),
    "input_bias:u": ("b", -0.3),
    "viscous_friction:v": ("k", 0.5),
    "quadratic_drag:v": ("k", 0.3),
}


def driven(trials=4, steps=250, bias=-0.3, damping=0.5, drag=0.3):
    """Runs of a sled with all five, to and fro, the odd ones with steps."""
    rng, found = np.random.default_rng(4), []
    for k in range(trials):
        t = DT * np.arange(steps)
        u = (1 + 0.4 * k) * np.sin((1.5 + 0.6 * k) * t)
        u += 0.8 * np.sign(np.sin((2.1 + 0.3 * k) * t)) * (k % 2)
        x, rows = np.zeros(2), [np.zeros(2)]
        for late in [0.0, 0.0, *u[:-2]]:
            force = np.sign(late) * max(abs(late) - 0.15, 0.0) + bias
            for _ in range(20):
                v = x[1]
                x = x + DT / 20 * np.array([v, force - damping * v - drag * v * abs(v)])
            rows.append(x)
        states = np.array(rows) + rng.standard_normal((steps + 1, 2)) * [5e-4, 3e-3]
        found.append(Trial(states, u[:, None], DT, ("x", "v"), ("u",)))
    return found


@pytest.mark.slow
def test_more_than_three_effects_are_looked_for_where_three_leave_more_than_noise():
    families = {name.partition(":")[0] for name in TRUE} | {"input_gain", "bias"}
    library = Library(tuple(f for f in Library().families if f.name in families))
    three = diagnose(SLED, driven(), DiagnosisOptions(library=library, max_effects=3)).verdict
    assert three.look_for == 5 and len(three.effects) == 3
    found = diagnose(SLED, driven(), DiagnosisOptions(library=library))
    assert set(found.verdict.effects) == set(TRUE) and not found.verdict.look_for
    for name, (quantity, true) in TRUE.items():
        estimate = found.ranked(name).params[quantity]
        assert abs(estimate.value - true) < max(3 * estimate.std, 0.03 * abs(true)), name
    two = Library(tuple(map(library.family, ("delay", "dead_zone"))))
    few = diagnose(SLED, driven(2), DiagnosisOptions(library=two)).verdict
    assert len(few.effects) <= 2 and not few.look_for
