"""A robot on two driven wheels whose pose comes in one late message, as motion capture sends it."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from grounded import Model, Param
from grounded.accounts.sound_trials import sound_trials as preflight
from grounded.trial import Trial
from stepped import logged, stepped

DT, FINE = 0.05, 10  # [s] control step; steps of the simulation in one
LATE, PULL, SLIP = 0.024, 0.03, 0.08  # [s] of the pose; [rad/m]; [s^2/m]
POSE = ("x", "y", "psi")


ROVER = Model(
    name="rover",
    states={"v": "m/s", "omega": "rad/s", "x": "m", "y": "m", "psi": "rad"},
    inputs={"speed": "m/s", "turn": "rad/s"},
    params={"tau_v": Param(0.15, "s"), "tau_w": Param(0.12, "s")},
    angles=("psi",),
    roles={"position": ("x", "y"), "heading": "psi", "speed": "v", "heading_rate": "omega"},
    derivative=lambda s, a, p: {
        "v": (a.speed - s.v) / p.tau_v,
        "omega": (a.turn - s.omega) / p.tau_w,
        "x": s.v * np.cos(s.psi),
        "y": s.v * np.sin(s.psi),
        "psi": s.omega,
    },
)


def driven(seed: int, steps: int = 240) -> Trial:
    """Drive by hand for 12 s: unequal wheels, side slip, a pose that is stamped late."""
    rng = np.random.default_rng(seed)
    speed, turn = gaussian_filter1d(rng.normal(size=(2, steps)), 12.0)
    u = np.stack([0.45 + 1.6 * speed, 3.5 * turn], axis=1)

    def rates(s, a):
        v, w, _, _, psi = s
        rate = w + PULL * v
        aside, c, sn = -SLIP * v**2 * rate, np.cos(psi), np.sin(psi)
        moved = [v * c - aside * sn, v * sn + aside * c, rate]
        return np.array([(a[0] - v) / 0.15, (a[1] - w) / 0.12, *moved])

    rows = stepped(rates, np.repeat(u, FINE, axis=0), DT / FINE, np.zeros(5), fine=1)
    t, at = DT * np.arange(steps + 1), DT / FINE * np.arange(steps * FINE + 1)
    late = [np.interp(t - LATE * (i > 1), at, row) for i, row in enumerate(rows.T)]
    noise = [0.002, 0.004, 0.0004, 0.0004, 0.0008]
    return logged(ROVER, np.transpose(late)[1:], u[1:], DT, noise, rng, id=f"t{seed}")


def late(findings):
    return {f.signal: f.delay_s for f in findings if f.kind == "delay" and f.corrected}


def test_one_message_is_late_as_a_whole():
    trials = [driven(seed) for seed in (1, 2, 3)]
    assert set(late(preflight(ROVER, trials).findings)) == {"psi"}
    found = preflight(ROVER, trials, one_message=POSE)
    assert late(found.findings) == pytest.approx(dict.fromkeys(POSE, LATE), abs=0.004)
    assert {f"sensor_delay:{name}" for name in POSE} <= found.settled
