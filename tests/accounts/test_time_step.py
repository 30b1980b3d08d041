"""A step that is too long for the model is told; a trial that becomes too fast for it is cut."""

from dataclasses import replace

import numpy as np
import pytest

from grounded import Model, Param, Trial
from grounded.accounts.sound_trials import sound_trials as preflight
from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.diagnosis.telling import instrument_lines
from grounded.effects import Library
from grounded.models.arm import model as arm

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


STEP, LATE, WHIRL = 0.02, 2, 10.0  # [s], steps, [N m]


def driven(k, whirl=0.0, steps=80, size=0.4):
    """A run whose inputs are 40 ms late; `whirl` [N m] turns the second joint from 0.6 s on."""
    rng, t = np.random.default_rng(k), STEP * np.arange(steps)
    u = size * np.stack([3 * np.sin((3 + k) * t + k), np.sin((5 - k) * t)], axis=1)
    u[30:, 1] += whirl
    states = [np.array([-np.pi / 2, 0.0, 0.0, 0.0])]
    for one in [np.zeros(2)] * LATE + list(u[: steps - LATE]):
        z = states[-1]
        for _ in range(40):
            z = arm.system.step(z[None], one[None], arm.values, STEP / 40)[0]
        states.append(z)
    y = np.array(states) + rng.standard_normal((steps + 1, 4)) * [1e-3, 1e-3, 1e-2, 1e-2]
    return Trial(y, u, STEP, arm.state_names, arm.input_names, id=f"t{k:04d}")


def test_a_whirling_trial_is_cut_where_the_model_cannot_be_integrated():
    trials = [driven(0, WHIRL), driven(1), driven(2)]
    looked = preflight(arm, trials)
    (found,) = [one for one in looked.findings if one.kind == "unresolved"]
    keep = looked.trials[0].known_steps
    assert (
        found.signal == "q2_vel" and found.corrected and found.share == pytest.approx(1 - keep / 80)
    )
    assert 35 < keep < 60 and [t.known_steps for t in looked.trials[1:]] == [80, 80]
    assert (found.said.facts["trial"], found.said.facts["at"].value) == ("t0000", keep * STEP)
    (line,) = [x for x in instrument_lines(looked.findings) if "time steps" in x]
    assert line.startswith("q2_vel: reaches 331 rad/s") and "corrected" not in line
