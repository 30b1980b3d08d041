"""A robot on two driven wheels whose pose comes in one late message, as motion capture sends it."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from grounded import Model, Param
from grounded.accounts.sound_trials import sound_trials as preflight
from grounded.trial import Trial

DT, FINE = 0.05, 10  # [s] control step; steps of the simulation in one
LATE, PULL, SLIP = 0.024, 0.03, 0.08  # [s] of the pose; [rad/m]; [s^2/m]
POSE = ("x", "y", "psi")


def dynamics(s, a, p):
    return {
        "v": (a.speed - s.v) / p.tau_v,
        "omega": (a.turn - s.omega) / p.tau_w,
        "x": s.v * np.cos(s.psi),
        "y": s.v * np.sin(s.psi),
        "psi": s.omega,
    }


ROVER = Model(
    name="rover",
    states={"v": "m/s", "omega": "rad/s", "x": "m", "y": "m", "psi": "rad"},
    inputs={"speed": "m/s", "turn": "rad/s"},
    params={"tau_v": Param(0.15, "s"), "tau_w": Param(0.12, "s")},
    angles=("psi",),
    roles={"position": ("x", "y"), "heading": "psi", "speed": "v", "heading_rate": "omega"},
    derivative=dynamics,
)


def driven(seed: int, steps: int = 240) -> Trial:
    """Drive by hand for 12 s: unequal wheels, side slip, a pose that is stamped late."""
    rng = np.random.default_rng(seed)
    speed, turn = gaussian_filter1d(rng.normal(size=(2, steps)), 12.0)
    u = np.stack([0.45 + 1.6 * speed, 3.5 * turn], axis=1)
    v, w, x, y, psi = rows = np.zeros((5, steps * FINE + 1))
    for k in range(steps * FINE):
        a, h = u[k // FINE], DT / FINE
        v[k + 1] = v[k] - np.expm1(-h / 0.15) * (a[0] - v[k])
        w[k + 1] = w[k] - np.expm1(-h / 0.12) * (a[1] - w[k])
        rate = w[k] + PULL * v[k]
        aside = -SLIP * v[k] ** 2 * rate
        x[k + 1] = x[k] + h * (v[k] * np.cos(psi[k]) - aside * np.sin(psi[k]))
        y[k + 1] = y[k] + h * (v[k] * np.sin(psi[k]) + aside * np.cos(psi[k]))
        psi[k + 1] = psi[k] + h * rate
    t, at = DT * np.arange(steps + 1), DT / FINE * np.arange(steps * FINE + 1)
    late = [np.interp(t - LATE * (i > 1), at, row) for i, row in enumerate(rows)]
    noise = np.array([0.002, 0.004, 0.0004, 0.0004, 0.0008]) * rng.normal(size=(steps + 1, 5))
    logged = np.stack(late, axis=1) + noise
    return Trial(logged[1:], u[1:], DT, ROVER.state_names, ROVER.input_names, id=f"t{seed}")


@pytest.fixture(scope="module")
def trials():
    return [driven(seed) for seed in (1, 2, 3)]


def late(findings):
    return {f.signal: f.delay_s for f in findings if f.kind == "delay" and f.corrected}


def test_one_message_is_late_as_a_whole(trials):
    assert set(late(preflight(ROVER, trials).findings)) == {"psi"}
    found = preflight(ROVER, trials, one_message=POSE)
    assert late(found.findings) == pytest.approx(dict.fromkeys(POSE, LATE), abs=0.004)
    assert {f"sensor_delay:{name}" for name in POSE} <= found.settled
