"""Speeds in other axes or units, and a compass's heading: told by the way that was travelled."""

from dataclasses import replace

import numpy as np
import pytest

from grounded import Model
from grounded.accounts.finding import UnusableTrials
from grounded.accounts.sound_trials import sound_trials as preflight
from grounded.frozen import Array
from grounded.trial import Trial

DT = 0.1
STATES = {"u": "m/s", "v": "m/s", "r": "rad/s", "x": "m", "y": "m", "psi": "rad"}
NAMES = tuple(STATES)
NOISE = np.array([0.015, 0.015, 0.006, 0.01, 0.01, 0.004])


def rates(s, a, p):
    return {
        "u": 1.3 * (a.port + a.starboard) - 0.7 * s.u + s.v * s.r,
        "v": -2.0 * s.v - s.u * s.r,
        "r": 1.6 * (a.starboard - a.port) - 1.8 * s.r,
        "x": s.u * np.cos(s.psi) - s.v * np.sin(s.psi),
        "y": s.u * np.sin(s.psi) + s.v * np.cos(s.psi),
        "psi": s.r,
    }


BOAT = Model(
    name="catamaran",
    states=STATES,
    inputs={"port": "1", "starboard": "1"},
    angles=("psi",),
    derivative=rates,
)


def sailed(seed: int, steps: int = 300) -> Trial:
    """A boat in a current that a stick drives, with noisy sensors."""
    rng, now, aim = np.random.default_rng(seed), np.zeros(2), np.zeros(2)
    x = np.array([0, 0, 0, 0, 0, rng.uniform(-3, 3)])
    states, inputs = [x], []
    for k in range(steps):
        if k % 22 == 0:
            aim = rng.uniform([0.05, -0.45], [0.85, 0.45])
        now = now + 0.35 * (aim - now)
        u = np.array([now[0] - now[1], now[0] + now[1]])
        x = BOAT.system.step(x[None], u[None], BOAT.values, DT)[0] + DT * CURRENT
        states.append(x)
        inputs.append(u)
    seen = np.array(states) + NOISE * rng.standard_normal((steps + 1, 6))
    return Trial(seen, np.array(inputs), DT, NAMES, BOAT.input_names, id=f"t{seed:04}")


CURRENT = np.array([0, 0, 0, 0.12, -0.07, 0])
SOUND = [sailed(seed) for seed in range(4)]


def logged(fault=lambda x: x, trials=1) -> list[Trial]:
    return [replace(trial, states=fault(trial.states)) for trial in SOUND[:trials]]


def times(factor: float, *names: str):
    return lambda x: x * np.where(np.isin(NAMES, names), factor, 1.0)


def in_the_world(x: Array) -> Array:
    y, (c, s) = np.array(x), (np.cos(x[:, 5]), np.sin(x[:, 5]))
    y[:, 0], y[:, 1] = c * x[:, 0] - s * x[:, 1], s * x[:, 0] + c * x[:, 1]
    return y


def compass(x: Array) -> Array:
    y = np.array(x)
    y[:, 5] = np.pi / 2 - x[:, 5]
    return y


def test_one_trial_with_speeds_in_other_axes_is_named_alone():
    odd = [*SOUND[:2], *logged(in_the_world, 3)[2:]]
    with pytest.raises(UnusableTrials) as stopped:
        preflight(BOAT, odd)
    assert stopped.value.finding.code == "log.axes"
    assert stopped.value.then is not None and stopped.value.then.arguments == ("t0002",)


@pytest.mark.parametrize("seed", range(4))
def test_a_compass_heading_is_put_right_in_one_finding(seed):
    sound = SOUND[seed]
    odd = replace(sound, states=compass(sound.states))
    found = preflight(BOAT, [odd])
    (one,) = found.findings
    assert (one.signal, one.kind, one.scale) == ("psi", "sign", -1.0)
    assert one.log == "scale = -1, offset = 1.5707963"
    np.testing.assert_allclose(found.trials[0].states, sound.states, atol=1e-9)


@pytest.mark.parametrize(
    ("unit", "factor", "names"),
    [
        ("knots", 1.943844, ("u", "v")),
        ("knots", 1.943844, ("u",)),
        ("km/h", 3.6, ("u", "v")),
        ("mph", 2.236936, ("u", "v")),
        ("ft/s", 3.28084, ("u", "v")),
        ("feet", 3.28084, ("x", "y")),
    ],
)
def test_speeds_and_positions_in_another_unit_are_named_with_their_scale(unit, factor, names):
    for trial in logged(times(factor, *names), 4):
        with pytest.raises(UnusableTrials) as stopped:
            preflight(BOAT, [trial])
        (one,) = stopped.value.findings
        assert (one.code, one.about, one.facts["unit"]) == ("log.unit", names, unit)
        assert one.facts["by"] == pytest.approx(1 / factor, rel=1e-5)
        assert one.facts["tables"] == tuple(f"[log.state.{name}]" for name in names)


@pytest.mark.parametrize("factor", [0.7, 1.08, 1.3, 2.05, 2.4, 3.0, 3.45, 1 / 1.943844])
def test_a_slip_or_a_scale_of_another_size_is_no_unit(factor):
    for trial in logged(times(factor, "u", "v"), 4):
        assert not {f.kind for f in preflight(BOAT, [trial]).findings} - {"mismatch"}
