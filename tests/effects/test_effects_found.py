"""Inputs that act alike are blamed together."""

import numpy as np
import pytest

import grounded as gr
from grounded import Model, Param, Trial

DT = 0.05


boat = Model(
    name="boat",
    states={"v": "m/s", "r": "rad/s", "psi": "rad"},
    inputs={"left": "1", "right": "1"},
    params={"k": Param(1.0, "m/s^2", 0.2, 4.0), "arm": Param(1.5, "1/m", 0.3, 6.0)},
    angles=("psi",),
    derivative=lambda s, a, p: {
        "v": p.k * (a.left + a.right) - 0.6 * s.v,
        "r": p.k * p.arm * (a.right - a.left) - 1.1 * s.r,
        "psi": s.r,
    },
)


@pytest.mark.slow
def test_thrusters_that_are_weaker_astern_are_named_together():
    rng, astern, trials = np.random.default_rng(5), 0.6, []
    for _ in range(3):
        sent = np.repeat(rng.uniform(-0.9, 0.9, (20, 2)), 8, axis=0)
        got, x = np.where(sent < 0, astern, 1.0) * sent, [np.zeros(3)]
        for u in got:
            after = boat.system.step(x[-1][None], u[None], boat.values, DT)[0]
            x.append(after + 1e-3 * rng.standard_normal(3))
        seen = np.array(x) + 4e-3 * rng.standard_normal((len(x), 3))
        trials.append(Trial(seen, sent, DT, boat.state_names, boat.input_names))
    found = gr.diagnose(boat, trials)
    assert found.effects[0] == "input_curve:left+right"
    assert not any(name.startswith(("offset", "input_bias")) for name in found.effects)
    ahead = found.ranking[0].params["a"]  # beside a gain
    assert ahead.value == pytest.approx((1 - astern) / (1 + astern), abs=4 * ahead.std)
