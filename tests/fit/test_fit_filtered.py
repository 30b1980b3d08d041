"""Filtered sensors: a fit finds the filters and recovers the model behind them."""

import numpy as np
import pytest

from grounded.effects.sensor import lagging
from grounded.fit import fit
from grounded.model import Model, Param
from grounded.trial import Trial

DT, TAU = 0.02, 0.03
AXIS = Model(
    name="axis",
    states={"x": "m", "v": "m/s"},
    inputs={"volts": "V"},
    params={
        "k": Param(2.0, "m/s^2/V", 0.5, 8.0),
        "b": Param(3.0, "1/s", 0.1, 20.0),
        "c": Param(0.0, "m/s^2", 0.0, 2.0),
    },
    roles={"position": ("x",), "speed": "v"},
    derivative=lambda s, a, p: {
        "x": s.v,
        "v": p.k * a.volts - p.b * s.v - p.c * np.tanh(s.v / 0.02),
    },
)
TRUE = {"k": 4.0, "b": 6.0, "c": 0.5}


def filtered(v, tau, dt=DT):
    """Return a speed (T + 1,) as measured by a sensor with a filter."""
    off, y = 0.0, v.copy()
    for t in range(1, len(v)):
        off = lagging(off, v[t] - v[t - 1], tau, dt)
        y[t] = v[t] + off
    return y


def runs(tau=TAU, count=4, steps=250, seed=0):
    """Return logs of the axis with position quantised to 0.05 mm and filtered speed."""
    rng, found = np.random.default_rng(seed), []
    values = AXIS.with_values(TRUE).values
    for _ in range(count):
        volts = np.repeat(rng.uniform(-1, 1, (steps // 10 + 1, 1)), 10, axis=0)[:steps]
        x = np.zeros((steps + 1, 2))
        for t in range(steps):
            z = x[t][None]
            for _ in range(4):
                z = AXIS.system.step(z, volts[t][None], values, DT / 4)
            x[t + 1] = z[0]
        y = np.column_stack([np.round(x[:, 0] / 5e-5) * 5e-5, filtered(x[:, 1], tau)])
        y[:, 1] += rng.normal(0, 1e-3, len(y))
        found.append(Trial(y, volts, DT, AXIS.state_names, AXIS.input_names))
    return found


def test_a_filter_of_speeds_is_not_fitted_as_friction():
    trials = runs(count=3, steps=200)
    found = fit(AXIS, trials)
    assert [one.kind for one in found.preflight if one.corrected] == ["lag"]
    for name, value in TRUE.items():
        assert found.params[name].value == pytest.approx(value, rel=0.03)
        assert found.params[name].low < value < found.params[name].high
    assert tuple(found.prediction_error[-1].crude) == AXIS.state_names
    assert found.helps and {*found.params} == {*TRUE}
