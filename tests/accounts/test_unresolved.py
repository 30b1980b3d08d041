"""A trial that becomes too fast for the model's time step is cut there."""

import numpy as np
import pytest

from grounded import Trial
from grounded.accounts.sound_trials import sound_trials as preflight
from grounded.diagnosis.telling import instrument_lines
from grounded.models.arm import model as arm

DT, LATE, WHIRL = 0.02, 2, 10.0  # [s], steps, [N m]


def driven(k, whirl=0.0, steps=80, size=0.4):
    """A run whose inputs are 40 ms late; `whirl` [N m] turns the second joint from 0.6 s on."""
    rng, t = np.random.default_rng(k), DT * np.arange(steps)
    u = size * np.stack([3 * np.sin((3 + k) * t + k), np.sin((5 - k) * t)], axis=1)
    u[30:, 1] += whirl
    states = [np.array([-np.pi / 2, 0.0, 0.0, 0.0])]
    for one in [np.zeros(2)] * LATE + list(u[: steps - LATE]):
        z = states[-1]
        for _ in range(40):
            z = arm.system.step(z[None], one[None], arm.values, DT / 40)[0]
        states.append(z)
    y = np.array(states) + rng.standard_normal((steps + 1, 4)) * [1e-3, 1e-3, 1e-2, 1e-2]
    return Trial(y, u, DT, arm.state_names, arm.input_names, id=f"t{k:04d}")


def test_a_whirling_trial_is_cut_where_the_model_cannot_be_integrated():
    trials = [driven(0, WHIRL), driven(1), driven(2)]
    looked = preflight(arm, trials)
    (found,) = [one for one in looked.findings if one.kind == "unresolved"]
    keep = looked.trials[0].known_steps
    assert (
        found.signal == "q2_vel" and found.corrected and found.share == pytest.approx(1 - keep / 80)
    )
    assert 35 < keep < 60 and [t.known_steps for t in looked.trials[1:]] == [80, 80]
    assert (found.said.facts["trial"], found.said.facts["at"].value) == ("t0000", keep * DT)
    (line,) = [x for x in instrument_lines(looked.findings) if "time steps" in x]
    assert line.startswith("q2_vel: reaches 331 rad/s") and "corrected" not in line
