"""A step that is too long for the model is told; a trial that becomes too fast for it is cut."""

from dataclasses import replace

import numpy as np
import pytest

from grounded import Model, Param
from grounded.accounts.sound_trials import sound_trials as preflight
from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.diagnosis.telling import instrument_lines
from grounded.models.arm import model as arm
from stepped import levels, library, logged, stepped

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


def run(model, seed):
    rng = np.random.default_rng(seed)
    u = levels(rng, 20, 10)
    x = stepped(replace(model, substeps=8), u, DT)
    return logged(model, x, u, DT, [1e-3, 1e-2], rng)


def test_the_verdict_tells_it():
    model = motor(95.0)
    options = DiagnosisOptions(library=library("input_gain"))
    found = diagnose(model, [run(model, k) for k in range(3)], options)
    assert "substeps=2" in found.preflight[0].advice
    assert [one.kind for one in found.preflight] == ["time step"]


def driven(k, whirl=0.0, steps=80):
    """A run whose inputs are 40 ms late; `whirl` [N m] turns the second joint from 0.6 s on."""
    rng, t = np.random.default_rng(k), DT * np.arange(steps)
    u = 0.4 * np.stack([3 * np.sin((3 + k) * t + k), np.sin((5 - k) * t)], axis=1)
    u[30:, 1] += whirl
    late = np.r_[np.zeros((2, 2)), u[:-2]]
    parts, start = np.repeat(late, 40, axis=0), [-np.pi / 2, 0.0, 0.0, 0.0]
    x = stepped(arm, parts, DT / 40, start)[::40]
    return logged(arm, x, u, DT, [1e-3, 1e-3, 1e-2, 1e-2], rng, id=f"t{k:04d}")


def test_a_whirling_trial_is_cut_where_the_model_cannot_be_integrated():
    trials = [driven(0, 10.0), driven(1), driven(2)]
    looked = preflight(arm, trials)
    (found,) = [one for one in looked.findings if one.kind == "unresolved"]
    keep = looked.trials[0].known_steps
    assert found.signal == "q2_vel" and found.corrected
    assert found.share == pytest.approx(1 - keep / 80)
    assert 35 < keep < 60 and [t.known_steps for t in looked.trials[1:]] == [80, 80]
    assert (found.said.facts["trial"], found.said.facts["at"].value) == ("t0000", keep * DT)
    (line,) = [x for x in instrument_lines(looked.findings) if "time steps" in x]
    assert line.startswith("q2_vel: reaches 331 rad/s") and "corrected" not in line
