"""Late commands and late sensors are one thing to a model, and that is said."""

from dataclasses import replace

import numpy as np
import pytest

import grounded as gr
from grounded import Model
from grounded.diagnosis.diagnose import DiagnosisOptions
from grounded.diagnosis.hypotheses.lookalike import one_clock
from grounded.effects import Library
from grounded.models.pendulum import model as pendulum
from grounded.trial import Trial

AXES = Model(
    name="axes",
    states={"x": "m", "y": "m", "vx": "m/s", "vy": "m/s"},
    inputs={"F": "N", "G": "N"},
    derivative=lambda s, a, p: {"x": s.vx, "y": s.vy, "vx": a.F - s.vx, "vy": 2 * a.G - s.vy},
)


def found(model, *names, shown=None):
    effects = [Library().effect(name, model) for name in names]
    return one_clock(model, effects, shown or model.state_names)


@pytest.mark.parametrize("model", [pendulum, AXES])
def test_a_delay_of_every_command_is_one_of_every_sensor(model):
    (one,) = found(model, f"delay:{'+'.join(model.input_names)}")
    assert one[1] == f"sensor_delay:{'+'.join(model.state_names)}"


def late(steps: int, seed: int = 0, count: int = 240) -> Trial:
    """A pendulum whose commands arrive some steps late."""
    rng, x, states = np.random.default_rng(seed), np.zeros(2), []
    sent = np.repeat(rng.uniform(-1, 1, count // 6), 6)[:, None]
    for k in range(count):
        states.append(x)
        u = sent[k - steps] if k >= steps else np.zeros(1)
        x = pendulum.system.step(x[None], u[None], pendulum.values, 0.05)[0]
    names = (pendulum.state_names, pendulum.input_names)
    return Trial(np.array([*states, x]), sent, 0.05, *names, id=f"t{seed:04}")


@pytest.mark.slow
def test_a_diagnosis_that_claims_the_one_says_the_other():
    rng, trials = np.random.default_rng(1), [late(2, k) for k in range(2)]
    trials = [
        replace(t, states=t.states + rng.normal(0, [2e-3, 1e-2], t.states.shape)) for t in trials
    ]
    library = Library(tuple(map(Library().family, ("delay", "input_gain", "viscous_friction"))))
    diagnosis = gr.diagnose(pendulum, trials, DiagnosisOptions(library=library))
    assert diagnosis.effects == ("delay:torque",)
    assert ("delay:torque", "sensor_delay:theta+omega") in diagnosis.equivalent
    assert "gap.equivalent" in {one.code for one in diagnosis.findings}
