"""States that answer commands before they are sent, and what only looks so."""

from dataclasses import replace

import numpy as np
import pytest

import grounded as gr
from facts import holds
from grounded import Model, Param
from grounded.accounts.commands import clocks_apart, judge_clocks
from grounded.errors import GroundedError
from grounded.trial import Trial


def craft(lag=0.3, drag=0.4, gain=1.0):
    """A thing with a thruster and a rudder, whose speeds nobody has to measure."""
    return Model(
        name="craft",
        states={"x": "m", "psi": "rad", "v": "m/s", "r": "rad/s"},
        inputs={"thrust": "1", "rudder": "rad"},
        params={
            "gain": Param(gain, "m/s^2", 0.3, 3.0),
            "drag": Param(drag, "1/s", 0.1, 2.0),
            "lag": Param(lag, "s", 0.02, 1.0),
        },
        derivative=lambda s, a, p: {
            "x": s.v,
            "psi": s.r,
            "v": p.gain * a.thrust - p.drag * s.v,
            "r": (1.5 * a.rudder - s.r) / p.lag,
        },
    )


def driven(model, *, early=0, seed=0, dt=0.02, steps=900, hold=15):
    """Under commands that change every 0.3 s; `early`: steps by which the states are ahead."""
    rng, x, states = np.random.default_rng(seed), np.zeros(model.n), []
    sent = np.repeat(rng.uniform(-1, 1, (steps // hold, model.m)), hold, axis=0)
    for u in sent:
        states.append(x)
        x = model.system.step(x[None], u[None], model.values, dt)[0]
    logged = np.array([*states, x])
    logged += 0.002 * np.std(logged, axis=0) * rng.normal(size=logged.shape)
    a, b = max(early, 0), max(-early, 0)
    used = steps - a - b
    states, sent = logged[a : a + used + 1], sent[b : b + used]
    return Trial(states, sent, dt, model.state_names, model.input_names, id=f"t{seed:04}")


REAL = craft(lag=0.15, drag=0.7, gain=0.8)


@pytest.mark.parametrize("early", [8, 23, 40])
@pytest.mark.parametrize("blind", [False, True])
def test_states_before_their_commands_are_told_by_how_much(early, blind):
    trial = driven(REAL, early=early)
    if blind:  # no sensor of the speeds
        trial = replace(trial, states=trial.states * [1, 1, np.nan, np.nan])
    found = clocks_apart(craft(), trial, range(4))
    assert found is not None and found.facts["lead"] == pytest.approx(0.02 * early, abs=0.04)
    assert found.facts["mended"].value < found.facts["logged"].value / 2
    assert found.about == craft().state_names[: 2 if blind else 4]


def test_a_diagnosis_stops_at_them_and_names_the_delay():
    trials = [driven(REAL, early=23 * k, seed=k) for k in range(2)]
    with pytest.raises(GroundedError) as stopped:
        gr.diagnose(craft(), trials)
    said = str(stopped.value)
    assert holds(said, "t0001", "clocks", "[log.state.x]", "[log.state.r]")
    assert "t0000" not in said and stopped.value.then.arguments == ("t0001",)
    judge_clocks(craft(), trials[:1], range(4))
