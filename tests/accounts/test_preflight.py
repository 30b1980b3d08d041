"""The instruments, judged from their own signals: known faults of generated ones, real ones."""

import re
from dataclasses import replace

import numpy as np
import pytest

from grounded import Model, Param, Trial
from grounded.accounts.lag import at_samples
from grounded.accounts.sound_trials import sound_trials as preflight
from grounded.errors import GroundedError, NextCommand
from stepped import logged, stepped

DT = 0.02
ARM = Model(
    states={"q": "rad", "w": "rad/s"},
    inputs={"u": "N m"},
    params={"b": Param(0.3, "1/s", 0.0, 3.0)},
    derivative=lambda s, a, p: {"q": s.w, "w": a.u - p.b * s.w - 4 * np.sin(s.q)},
)


FINE = replace(ARM, substeps=4)


def arm(fault=lambda x: x, seed=0, trials=4, steps=200):
    """Trials of an arm whose noisy sensors have a fault: (T + 1, 2) -> (T + 1, 2)."""
    rng, found, t = np.random.default_rng(seed), [], np.arange(steps) * DT
    for _ in range(trials):
        u = 2 * np.sin(rng.uniform(1, 4) * t + rng.uniform(0, 6)) + np.sin(rng.uniform(4, 9) * t)
        run = logged(ARM, stepped(FINE, u, DT), u, DT, [1e-3, 1e-2], rng)
        found.append(replace(run, states=fault(run.states)))
    return found


def late(x, steps):
    before = np.concatenate([np.full(20, x[0]), x])
    return at_samples(before, np.arange(len(x)) + 20 - steps)


def lagged(x, tau):
    out, a = x.copy(), np.exp(-DT / tau)
    for k in range(1, len(x)):
        out[k] = a * out[k - 1] + (1 - a) * 0.5 * (x[k] + x[k - 1])
    return out


def columns(q=lambda x: x, w=lambda x: x):
    return lambda y: np.stack([q(y[:, 0]), w(y[:, 1])], axis=1)


@pytest.mark.parametrize(
    ("fault", "signal", "kind", "delay", "scale"),
    [
        (columns(w=lambda x: late(x, 1.0)), "w", "delay", 0.02, 1),
        (columns(w=lambda x: late(x, 0.4)), "w", "delay", 0.008, 1),
        (columns(q=lambda x: late(x, 1.5)), "q", "delay", 0.03, 1),
        (columns(w=lambda x: lagged(x, 0.08)), "w", "lag", 0.08, 1),
        (columns(w=lambda x: -x), "w", "sign", 0, -1),
        (columns(w=np.rad2deg), "w", "degrees", 0, 180 / np.pi),
        (columns(q=np.rad2deg), "q", "degrees", 0, 180 / np.pi),
        (columns(w=lambda x: 1.06 * x), "w", "scale", 0, 1.06),
    ],
)
def test_a_velocity_is_held_against_its_position(fault, signal, kind, delay, scale):
    found = preflight(ARM, arm(fault))
    assert [(one.signal, one.kind) for one in found.findings] == [(signal, kind)]
    one = found.findings[0]
    assert one.delay_s == pytest.approx(delay, rel=0.1, abs=2e-4)
    if kind == "delay":  # it was "0.0152 +- 6.7e-05 s"
        assert re.match(r"\d+\.\d+ \+- 0\.\d+ ms later than ", one.finding), one.finding
    assert one.scale == pytest.approx(scale, rel=0.01)
    assert one.corrected is (kind != "scale")
    if kind == "lag":  # its samples stay: the diagnosis' own filter knows
        sent = arm(fault)
        assert found.filters == {signal: one.delay_s}
        assert all((a.states == b.states).all() for a, b in zip(found.trials, sent, strict=True))
    elif one.corrected:
        assert all(abs(f.delay_s) < 0.2 * delay for f in preflight(ARM, found.trials).findings)


def test_sound_sensors_are_left_alone():
    for seed in range(2):
        trials = arm(seed=seed)
        found = preflight(ARM, trials)
        assert found.findings == ()
        assert found.in_step == {"q", "w"}
        sensors = {f"sensor_{of}:{n}" for of in ("delay", "lag", "scale") for n in "qw"}
        assert found.settled == sensors | {"sensor_bias:w", "offset:q", "rate_gain:q"}
        for before, after in zip(trials, found.trials, strict=True):
            np.testing.assert_array_equal(before.states, after.states)


def stuck(x):
    out = x.copy()
    out[60:85] = out[60]
    return out


def dropped(x):
    out = x.copy()
    out[[50, 90, 91, 130]] = -20.0
    return out


@pytest.mark.parametrize(
    ("fault", "kind", "lost"),
    [
        (stuck, "stuck", 24),
        (dropped, "dropout", 4),
        (lambda x: np.repeat(x[::4], 4)[:201], "held", 150),
    ],
)
def test_samples_that_show_nothing_become_missing(fault, kind, lost):
    found = preflight(ARM, arm(columns(q=fault), trials=2))
    one = next(f for f in found.findings if f.kind == kind)
    assert (one.signal, one.corrected) == ("q", True)
    gone = [int(np.isnan(t.states[:, 0]).sum()) for t in found.trials]
    assert max(gone) == pytest.approx(lost, abs=1)  # a turn hides it in the other trial
    assert one.share == pytest.approx(sum(gone) / 402)


def test_jumps_by_a_full_turn_are_taken_out():
    def turn(y, full):
        y = y + np.array([3.0, 0])
        y[:, 0] = (y[:, 0] * full / (2 * np.pi) + full / 2) % full - full / 2
        return y

    for full, unit in ((2 * np.pi, []), (360.0, ["degrees"])):
        found = preflight(ARM, arm(lambda y, full=full: turn(y, full)))
        assert [f.kind for f in found.findings] == ["wrapped", *unit]
        steps = np.concatenate([np.diff(t.states[:, 0]) for t in found.trials])
        assert np.abs(steps).max() < 0.3


BEAM = Model(
    states={"r": "m", "v": "m/s", "theta": "rad"},
    inputs={"cmd": "rad"},
    params={"k": Param(5.0, "m/s^2", 2.0, 12.0), "tau": Param(0.1, "s", 0.02, 0.5)},
    derivative=lambda s, a, p: {
        "r": s.v,
        "v": p.k * np.sin(s.theta),
        "theta": (a.cmd - s.theta) / p.tau,
    },
)


@pytest.mark.parametrize(
    ("unit", "sent", "k"), [(1.0, 180 / np.pi, 2.8), (180 / np.pi, 1.0, 10.0), (1.0, 1.0, 5.0)]
)
def test_an_angle_in_degrees_in_all_logs_is_told_by_the_model(unit, sent, k):
    """Ball on a beam: no rate of theta is logged, only its command and what it does to the ball."""
    rng, trials = np.random.default_rng(1), []
    for phase in (0.0, 2.0):
        u = 0.12 * np.sin(1.8 * DT * np.arange(400) + phase)
        x = stepped(BEAM.with_values({"k": k, "tau": 0.13}), u, DT) * [1, 1, unit]
        trials.append(logged(BEAM, x, sent * u, DT, [1e-3, 4e-3, 1e-3 * unit], rng))
    found = [(f.signal, f.kind) for f in preflight(BEAM, trials).findings]
    assert found == [("theta", "degrees")] * (unit > 1) + [("cmd", "degrees")] * (sent > 1)


def test_a_trial_with_stamps_in_milliseconds_stops_the_diagnosis():
    trials = arm(steps=100)
    at = np.arange(0, 100, 1e-2)
    slow = np.stack([np.interp(at, np.arange(101), x) for x in trials[1].states.T], axis=1)
    inputs = np.repeat(trials[1].inputs, 100, axis=0)[: len(slow) - 1]
    slow[:, 0] = trials[1].states[0, 0] + np.cumsum(slow[:, 1]) * DT / 1000
    odd = Trial(slow, inputs, DT, ("q", "w"), ("u",), id="t0002")
    with pytest.raises(GroundedError, match="t0002") as error:
        preflight(ARM, [trials[0], odd])
    assert error.value.then == NextCommand("discard", ("t0002",))


@pytest.mark.parametrize(
    ("factor", "rpm", "mended"),
    [(60 / (2 * np.pi), True, True), (2 * np.pi / 60, True, False), (9.2, False, False)],
)
def test_a_rate_in_rpm_is_said_to_be_in_rpm(factor, rpm, mended):
    (found,) = preflight(ARM, arm(columns(w=lambda x: factor * x))).findings
    assert (found.signal, found.corrected) == ("w", mended)
    assert ("rpm" in found.finding) == rpm
    assert found.log == "scale = 0.10471976" * mended
