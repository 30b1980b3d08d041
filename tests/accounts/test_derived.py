"""Velocities that the robot's program computes from positions, as an overhead crane's did."""

from dataclasses import replace

import numpy as np
import pytest

from grounded import Model, Trial
from grounded.accounts.finding import Finding, late_as_positions, late_effects
from grounded.accounts.sound_trials import sound_trials as preflight
from grounded.diagnosis.telling import instrument_lines
from grounded.effects import Scales, Site, wrap
from grounded.effects.sensor import sensor_lag
from grounded.findings import Quantity, found

DT = 0.04
SWING = Model(
    name="swing",
    states={"q": "rad", "w": "rad/s"},
    inputs={"u": "rad/s^2"},
    params={},
    derivative=lambda s, a, p: {"q": s.w, "w": a.u - 12.0 * s.q},
)


def swung(kind, noise=2e-4, steps=700, keep=0.5):
    """A swing; w is filtered from q's differences, or an own sensor: 2 steps late, or slow."""
    rng, fine = np.random.default_rng(3), 20
    t = DT / fine * np.arange((steps + 1) * fine)
    rates, q, w = [], [], []
    for a, b, c in ((0.35, 3.4, 0.0), (0.1, 1.3, 1.0), (0.05, 6.0, 2.0)):
        q.append(a * np.sin(b * t + c))
        w.append(a * b * np.cos(b * t + c))
        rates.append(-a * b * b * np.sin(b * t + c))
    q, w = sum(q), sum(w)
    u = (sum(rates) + 12.0 * q)[::fine]
    seen = q[::fine] + noise * rng.standard_normal(steps + 1)
    if kind == "filtered":
        logged, last = np.zeros(steps + 1), 0.0
        for k in range(2, steps + 1):  # the rate of the loop's last round
            last = keep * last + (1 - keep) * (seen[k - 1] - seen[k - 2]) / DT
            logged[k] = last
    elif kind == "slow":
        slow, logged = np.zeros(len(w)), np.zeros(steps + 1)
        for k in range(1, len(w)):
            slow[k] = slow[k - 1] + (w[k] - slow[k - 1]) / (2 * fine)
        logged = slow[::fine] + 1e-4 * rng.standard_normal(steps + 1)
    else:
        logged = np.concatenate([np.zeros(2 * fine), w])[: len(w)][::fine]
        logged = logged + 2e-3 * rng.standard_normal(steps + 1)
    states = np.stack([seen, logged], axis=1)[4:]
    return [Trial(states, u[4:-1, None], DT, ("q", "w"), ("u",))]


@pytest.mark.parametrize("keep", [0.5, 0.8])
@pytest.mark.parametrize("noise", [2e-4, 2e-3])
def test_a_rate_filtered_from_positions_is_not_used_and_no_scale_is_claimed(noise, keep):
    found = preflight(SWING, swung("filtered", noise, keep=keep))
    kinds = {f.kind for f in found.findings if f.signal == "w"}
    assert "smoothed" in kinds and kinds <= {"smoothed", "delay", "lag"}
    assert np.isnan(found.trials[0].states[:, 1]).all()


def test_a_rate_filtered_from_positions_is_not_used_once_its_filter_is_adopted():
    site = Site(SWING, ("w",), Scales(dt=DT))
    behind = wrap(sensor_lag.at(site), {"tau": 0.04}, DT)
    (trial,) = swung("filtered", keep=0.8)
    states = np.column_stack([trial.states, trial.states[:, 1]])
    lifted = replace(trial, states=states, state_names=behind.state_names)
    found = preflight(behind, [lifted], behind.state_names[2:])
    assert [f.kind for f in found.findings if f.signal == "w"] == ["smoothed"]
    assert np.isnan(found.trials[0].states[:, 1]).all()


def test_a_delay_of_a_position_is_told_of_the_speed_from_it_unless_it_is_adopted():
    said = found("sensor.derived", "v", of="x", age=0.02)
    seen = [Finding("v", said, "smoothed", corrected=True, source="x")]
    (late,) = late_as_positions(seen, {"sensor_delay:x": 0.03, "sensor_delay:beam": 0.5}, ())
    assert (late.signal, late.delay_s, late.source) == ("v", 0.03, "x")
    assert [line.partition(":")[0] for line in instrument_lines([*seen, late])] == ["v", "v"]
    assert not [*late_as_positions(seen, {"sensor_delay:x": 0.03}, ("sensor_delay:v",))]
    assert not [*late_as_positions(seen, {"sensor_delay:x+v": 0.03}, ())]  # v's own delay
    assert not [*late_as_positions(seen, {}, ())]
    said = found("sensor.late", "v", by=Quantity(0.02, "s"), of="x")
    own = Finding("v", said, "delay", delay_s=0.02, corrected=True)
    both = late_effects([own, *seen, late])
    assert both["sensor_delay:v"]["d"] == pytest.approx(0.05)
