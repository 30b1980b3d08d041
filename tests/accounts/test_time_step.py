"""An integrator's step that is too long for the model is told, with the number that is enough."""

from dataclasses import replace

import numpy as np

from grounded import Model, Param, Trial
from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.effects import Library

DT = 0.02


def motor(a):
    """A motor that reaches its speed at the rate a [1/s]."""
    return Model(
        name="motor",
        states={"q": "rad", "w": "rad/s"},
        inputs={"volts": "V"},
        params={"a": Param(a, "1/s", 0.5 * a, 2 * a), "g": Param(9.0, "1/s^2")},
        derivative=lambda s, u, p: {
            "q": s.w,
            "w": p.a * (5 * u.volts - s.w) - p.g * np.sin(s.q),
        },
    )


def run(model, seed=0, steps=200):
    rng, fine = np.random.default_rng(seed), replace(model, substeps=8)
    u = np.repeat(rng.uniform(-1, 1, steps // 10), 10)[:, None]
    states = [np.zeros(2)]
    for one in u:
        states.append(fine.system.step(states[-1][None], one[None], fine.values, DT)[0])
    noise = rng.standard_normal((steps + 1, 2)) * [1e-3, 1e-2]
    return Trial(np.array(states) + noise, u, DT, model.state_names, model.input_names)


def test_the_verdict_tells_it():
    model = motor(95.0)
    options = DiagnosisOptions(library=Library((Library().family("input_gain"),)))
    found = diagnose(model, [run(model, k) for k in range(3)], options)
    assert "substeps=2" in found.preflight[0].advice
    assert [one.kind for one in found.preflight] == ["time step"]
