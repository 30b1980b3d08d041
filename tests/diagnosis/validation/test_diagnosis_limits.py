"""What the data cannot tell: said, and no cause made of it."""

from dataclasses import replace

import numpy as np
import pytest

from grounded import GroundedError, Model, Param, Trial
from grounded.diagnosis.diagnose import diagnose
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.validation.limits import (
    excitation,
    knowable,
)
from grounded.effects import Library
from grounded.models.pendulum import model as pendulum

DT = 0.02
DISTURBED = np.sqrt(DT) * np.array([0.004, 0.06])  # of a step
MEASURED = np.array([0.005, 0.05])


def swings(trials=3, steps=150, seed=0, friction=0.0):
    """Runs of the pendulum itself (or with more friction), disturbed, from moving starts."""
    values = pendulum.values.copy()
    values[pendulum.param_names.index("b")] += friction
    rng, found = np.random.default_rng(seed), []
    for _ in range(trials):
        t, x = np.arange(steps) * DT, rng.uniform(-1, 1, 2)
        u = 1.5 * np.sin(rng.uniform(3, 5) * t) + np.sin(rng.uniform(7, 9) * t + 1)
        states = [x]
        for value in u:
            x = pendulum.system.step(x[None], np.array([[value]]), values, DT)[0]
            x = x + DISTURBED * rng.standard_normal(2)
            states.append(x)
        y = np.array(states) + MEASURED * rng.standard_normal((steps + 1, 2))
        found.append(Trial(y, u[:, None], DT, ("theta", "omega"), ("torque",)))
    return found


def stuck(trials, *states):
    """The same with sensors that show one value."""
    for trial in trials:
        y = trial.states.copy()
        y[:, list(states)] = 0.25
        yield replace(trial, states=y)


def test_what_acts_on_a_state_that_never_moved_is_not_offered():
    data = prepare(pendulum, list(stuck(swings(), 1)))
    assert excitation(data).unmoved == ("omega",)
    offered = {e.name for e in knowable(data, Library().candidates(pendulum, data.scales))}
    assert "rate_gain:theta" in offered and "sensor_scale:theta" in offered
    assert not {"viscous_friction:omega", "sensor_delay:omega", "sensor_bias:omega"} & offered


def let_go(friction, trials=2, steps=300, seed=3):
    """Free swings of the pendulum with additional friction, measured with noise."""
    values = pendulum.values.copy()
    values[pendulum.param_names.index("b")] += friction
    rng, found = np.random.default_rng(seed), []
    for start in rng.uniform(1.0, 1.8, trials):
        states = [np.array([start, 0.0])]
        for _ in range(steps):
            states.append(pendulum.system.step(states[-1][None], np.zeros((1, 1)), values, 0.02)[0])
        y = np.array(states) + np.array([2e-4, 2e-3]) * rng.standard_normal((steps + 1, 2))
        found.append(Trial(y, np.zeros((steps, 1)), 0.02, ("theta", "omega"), ("torque",)))
    return found


def test_the_friction_of_a_free_swing_is_named():
    nominal = replace(
        pendulum, params={n: Param(p.value, p.unit) for n, p in pendulum.params.items()}
    )
    found = diagnose(nominal, let_go(0.05))
    inertia = pendulum.params["m"].value * pendulum.params["l"].value ** 2
    (row,) = (r for r in found.ranking if r.claimed)
    assert row.effect == "viscous_friction:omega"
    assert row.values["k"] == pytest.approx(0.05 / inertia, rel=0.05)
    assert not any(r.effect.endswith(":torque") for r in found.ranking)


def test_how_much_a_switch_is_on_is_not_doubted():
    trials = [replace(t, inputs=(np.asarray(t.inputs) > 0) * 1.0) for t in swings()]
    data = prepare(pendulum, trials)
    offered = {e.name for e in knowable(data, Library().candidates(pendulum, data.scales))}
    assert excitation(data).on_off == {"torque"} and "delay:torque" in offered
    assert not {f"{name}:torque" for name in ("saturation", "input_gain", "backlash")} & offered
    assert not excitation(prepare(pendulum, swings())).on_off


def test_a_model_that_is_no_number_at_a_measured_state_says_where():
    tank = Model(
        states={"h": "m"},
        inputs={"u": "1"},
        params={"k": Param(0.2, "m/s", std=0.06), "c": Param(0.3, "1", std=0.09)},
        derivative=lambda s, a, p: {"h": p.k * a.u - p.c * np.sqrt(s.h)},
        name="tank",
    )
    h = np.abs(np.sin(0.1 * np.arange(60)))[:, None]
    h[17] = -0.004
    trials = [Trial(h, np.ones((59, 1)), 0.1, ("h",), ("u",), id=f"t000{k}") for k in (1, 2)]
    with pytest.raises(GroundedError, match=r"t0001, t = 1\.7 s, h = -0\.004") as raised:
        diagnose(tank, trials)
    assert "np.maximum" in str(raised.value)
