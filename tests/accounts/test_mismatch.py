"""What only several sensors together give away: a boat's units, signs, axes, late positions."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.accounts import ROBOTS, driven
from grounded.accounts.finding import UnusableTrials
from grounded.accounts.sound_trials import sound_trials as preflight
from grounded.frozen import Array
from grounded.trial import Trial

BOAT = ROBOTS["boat"]()
MODEL, NAMES, DT = BOAT.model, BOAT.model.state_names, BOAT.dt
X, Y, PSI, U, V, R = range(6)


@pytest.fixture(scope="module")
def sound():
    """Three logs of a boat that drifts in a current."""
    trials = driven(BOAT, np.random.default_rng(11), 3)
    current = np.array([0.05, -0.03, 0, 0, 0, 0]) * DT
    return [
        replace(t, states=t.states + np.arange(t.steps + 1)[:, None] * current, id=f"t{k:04}")
        for k, t in enumerate(trials)
    ]


def changed(trials, fault) -> list[Trial]:
    """The trials with states after a fault (T, 6) -> (T, 6), or less at the start."""
    seen = [fault(np.array(t.states)) for t in trials]
    return [
        replace(t, states=x, inputs=t.inputs[len(t.states) - len(x) :])
        for t, x in zip(trials, seen, strict=True)
    ]


def times(**by: float):
    return lambda x: x * [by.get(name, 1.0) for name in NAMES]


def refused(trials):
    with pytest.raises(UnusableTrials) as error:
        preflight(MODEL, trials)
    return error.value


def late(x: Array) -> Array:
    """Every velocity three steps late, u off by 0.1 m/s and 10 % too large."""
    y = np.array(x)
    y[3:, U:] = x[:-3, U:]
    y[:, U] = 0.1 + 1.1 * y[:, U]
    return y


def adrift(x: Array) -> Array:
    """At rest in a current."""
    y = np.array(BOAT.noise) * np.random.default_rng(0).normal(size=x.shape)
    y[:, :2] += np.linspace(0, 3.0, len(x))[:, None] * [1.0, -0.6]
    return y


@pytest.mark.parametrize("fault", [late, adrift])
def test_a_current_a_bias_noise_and_a_late_sensor_are_no_mismatch(sound, fault):
    found = preflight(MODEL, changed(sound, fault)).findings
    assert not {one.kind for one in found} & {"mismatch", "degrees", "sign"}


@pytest.mark.parametrize(
    ("fault", "kind", "signals"),
    [
        (times(r=180 / np.pi), "degrees", ["r"]),
        (times(psi=180 / np.pi), "degrees", ["psi"]),
        (times(y=-1), "sign", ["y"]),
        (times(psi=-1), "sign", ["psi"]),
        (times(psi=-1, r=-1), "sign", ["psi", "r"]),
        (lambda x: np.where(np.arange(6) == PSI, np.pi / 2 - x, x), "sign", ["psi"]),
    ],
)
def test_degrees_and_signs_are_put_right_in_the_one_signal_that_has_them(
    sound, fault, kind, signals
):
    found = preflight(MODEL, changed(sound, fault))
    odd = [one for one in found.findings if one.kind in ("degrees", "sign", "mismatch")]
    assert [(one.signal, one.kind) for one in odd] == [(name, kind) for name in signals]
    assert all(one.corrected and one.log.startswith("scale = ") for one in odd)
    for trial, other in zip(found.trials, preflight(MODEL, sound).trials, strict=True):
        np.testing.assert_allclose(trial.states, other.states, atol=1e-6)


def test_a_contradiction_of_another_kind_is_told_with_its_rate(sound):
    def other(x: Array) -> Array:
        way = 3 * np.cumsum(np.random.default_rng(3).normal(size=(len(x) // 20 + 2, 2)), axis=0)
        at = np.arange(len(x)) / 20  # of another run
        each = [np.interp(at, np.arange(len(way)), column) for column in way.T]
        return np.column_stack([*each, x[:, 2:]])

    found = preflight(MODEL, changed(sound, other)).findings
    odd = {(one.signal, one.kind) for one in found if one.kind == "mismatch"}
    assert odd == {("x", "mismatch"), ("y", "mismatch")}
    assert not any(one.corrected for one in found)
    assert all("psi, u and v" in one.finding for one in found if one.kind == "mismatch")


def test_positions_that_are_late_are_told_by_velocities_and_heading(sound, by=0.15):
    def behind(x: Array) -> Array:
        at = np.arange(len(x))
        x[:, :2] = np.stack([np.interp(at - by / DT, at, x[:, i]) for i in (X, Y)], axis=1)
        return x[int(np.ceil(by / DT)) :]

    def delayed(findings):
        return {f.signal: f.delay_s for f in findings if f.kind == "delay" and f.corrected}

    found = preflight(MODEL, changed(sound, behind))
    assert delayed(found.findings) == pytest.approx({"x": by, "y": by}, abs=0.03)
    assert not delayed(preflight(MODEL, found.trials).findings)


def test_one_trial_with_speeds_in_other_axes_is_named_alone(sound):
    def in_the_world(x: Array) -> Array:
        c, s = np.cos(x[:, PSI]), np.sin(x[:, PSI])
        u, v = c * x[:, U] - s * x[:, V], s * x[:, U] + c * x[:, V]
        return np.column_stack([x[:, :U], u, v, x[:, R]])

    error = refused([*sound[:2], *changed(sound[2:], in_the_world)])
    assert error.finding.code == "log.axes"
    assert error.then is not None and error.then.arguments == ("t0002",)


@pytest.mark.parametrize("factor", [0.7, 1.3, 2.05, 2.4, 3.0, 1 / 1.943844])
def test_a_slip_or_a_scale_of_another_size_is_no_unit(sound, factor):
    for trial in changed(sound, times(u=factor, v=factor)):
        assert not {f.kind for f in preflight(MODEL, [trial]).findings} & {"degrees", "sign"}
