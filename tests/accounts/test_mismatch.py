"""What only several sensors together give away: a boat's units, signs, axes, late positions."""

import numpy as np
import pytest

from grounded import Model, Param
from grounded.accounts.finding import UnusableTrials
from grounded.accounts.sound_trials import sound_trials as preflight
from grounded.frozen import Array
from grounded.trial import Trial

DT = 0.1
SCALE = {"m": Param(40.0, "kg", 30.0, 60.0), "k": Param(1.5, "1/s", 0.3, 4.0)}


def moving(s, a, p):
    return {
        "x": s.u * np.cos(s.psi) - s.v * np.sin(s.psi),
        "y": s.u * np.sin(s.psi) + s.v * np.cos(s.psi),
        "psi": s.r,
        "u": (a.thrust - 12 * s.u) / p.m,
        "v": -1.0 * s.v - 0.6 * s.u * s.r,
        "r": p.k * a.rudder * s.u - 1.5 * s.r,
    }


BOAT = Model(
    name="boat",
    states={"x": "m", "y": "m", "psi": "rad", "u": "m/s", "v": "m/s", "r": "rad/s"},
    inputs={"thrust": "N", "rudder": "rad"},
    params=SCALE,
    angles=("psi",),
    derivative=moving,
)
# without a sway sensor, the model has none either
PLAIN = Model(
    name="plain boat",
    states={name: unit for name, unit in BOAT.states.items() if name != "v"},
    inputs=dict(BOAT.inputs),
    params=SCALE,
    angles=("psi",),
    derivative=lambda s, a, p: {
        "x": s.u * np.cos(s.psi),
        "y": s.u * np.sin(s.psi),
        "psi": s.r,
        "u": (a.thrust - 12 * s.u) / p.m,
        "r": p.k * a.rudder * s.u - 1.5 * s.r,
    },
)
NAMES = BOAT.state_names
NOISE = np.array([0.02, 0.02, 0.005, 0.02, 0.02, 0.01])


def sailed(seed: int, current: tuple[float, float] = (0.1, -0.06)) -> tuple[Array, Array]:
    """30 s of a boat in a current with noisy sensors: states (301, 6), inputs (300, 2)."""
    rng, x = np.random.default_rng(seed), np.array([0, 0, 0.4 * seed, 1.0, 0, 0])
    states, inputs = [x], []
    for k in range(300):
        if k % 20 == 0:
            u = np.array([rng.uniform(8, 30), rng.uniform(-0.5, 0.5)])
        x = BOAT.system.step(x[None], u[None], BOAT.values, DT)[0]
        x[:2] += np.array(current) * DT
        states.append(x)
        inputs.append(u)
    return np.array(states) + NOISE * rng.normal(size=(301, 6)), np.array(inputs)


def logged(model: Model, fault=lambda x: x, trials: int = 3, **how) -> list[Trial]:
    """Trials with the states of a model, after a fault (T, 6) -> (T, 6), or less at the start."""
    found = []
    shown = [NAMES.index(name) for name in model.state_names]
    for seed in range(trials):
        states, inputs = sailed(seed, **how)
        names = (model.state_names, model.input_names)
        seen = fault(states)[:, shown]
        found.append(Trial(seen, inputs[len(states) - len(seen) :], DT, *names, id=f"t{seed:04}"))
    return found


def times(**by: float):
    return lambda x: x * [by.get(name, 1.0) for name in NAMES]


def swapped(a: str, b: str):
    def fault(x: Array) -> Array:
        order = list(NAMES)
        i, j = order.index(a), order.index(b)
        order[i], order[j] = b, a
        return x[:, [NAMES.index(name) for name in order]]

    return fault


def late(x: Array) -> Array:
    """Every velocity three steps late, u off by 0.1 m/s and 10 % too large."""
    y = np.array(x)
    y[3:, 3:] = x[:-3, 3:]
    y[:, 3] = 0.1 + 1.1 * y[:, 3]
    return y


def adrift(x: Array) -> Array:
    """At rest in a current."""
    y = NOISE * np.random.default_rng(0).normal(size=x.shape)
    y[:, :2] += np.linspace(0, 3.0, len(x))[:, None] * [1.0, -0.6]
    return y


@pytest.mark.parametrize(("model", "fault"), [(BOAT, late), (PLAIN, adrift)])
def test_a_current_a_bias_noise_and_a_late_sensor_are_no_mismatch(model, fault):
    found = preflight(model, logged(model, fault)).findings
    assert not {one.kind for one in found} & {"mismatch", "degrees", "sign"}


@pytest.mark.parametrize("model", [BOAT, PLAIN])
@pytest.mark.parametrize(
    ("fault", "kind", "signals"),
    [
        (times(r=180 / np.pi), "degrees", ["r"]),
        (times(psi=180 / np.pi), "degrees", ["psi"]),
        (times(y=-1), "sign", ["y"]),
        (times(psi=-1), "sign", ["psi"]),
        (times(psi=-1, r=-1), "sign", ["psi", "r"]),
    ],
)
def test_degrees_and_signs_are_put_right_in_the_one_signal_that_has_them(
    model, fault, kind, signals
):
    found = preflight(model, logged(model, fault))
    assert [(one.signal, one.kind) for one in found.findings] == [(name, kind) for name in signals]
    assert all(one.corrected and one.log.startswith("scale = ") for one in found.findings)
    sound = logged(model)
    for trial, other in zip(found.trials, sound, strict=True):
        np.testing.assert_allclose(trial.states, other.states, atol=1e-9)


@pytest.mark.parametrize(
    ("model", "fault", "about", "by"),
    [
        (BOAT, times(x=1e3, y=1e3), ("x", "y"), 0.001),
        (PLAIN, times(x=1e3, y=1e3), ("x", "y"), 0.001),
        (BOAT, times(u=1e3), ("u",), 0.001),
        (BOAT, times(y=1e2), ("y",), 0.01),
        (BOAT, swapped("x", "y"), ("x", "y"), None),
        (BOAT, swapped("u", "v"), ("u", "v"), None),
        (PLAIN, swapped("x", "y"), ("x", "y"), None),
    ],
)
def test_another_unit_or_an_exchange_stops_and_says_what_mends_it(model, fault, about, by):
    with pytest.raises(UnusableTrials) as error:
        preflight(model, logged(model, fault))
    first = error.value.finding
    assert (first.code, first.about) == ("log.unit" if by else "log.exchange", about)
    if by:
        assert first.facts["by"] == pytest.approx(by, rel=1e-5)
        assert first.facts["tables"] == tuple(f"[log.state.{name}]" for name in about)
    assert error.value.then is not None
    assert error.value.then.arguments == ("t0000", "t0001", "t0002")


@pytest.mark.parametrize(
    ("unit", "factor", "names"),
    [
        ("knots", 1.943844, ("u", "v")),
        ("knots", 1.943844, ("u",)),
        ("km/h", 3.6, ("u", "v")),
        ("mph", 2.236936, ("u", "v")),
        ("feet", 3.28084, ("x", "y")),
    ],
)
def test_speeds_and_positions_in_another_unit_are_named_with_it(unit, factor, names):
    fault = times(**dict.fromkeys(names, factor))
    for trial in logged(BOAT, fault, current=(0.0, 0.0)):
        with pytest.raises(UnusableTrials) as stopped:
            preflight(BOAT, [trial])
        (one,) = stopped.value.findings
        assert (one.code, one.about, one.facts["unit"]) == ("log.unit", names, unit)
        assert one.facts["by"] == pytest.approx(1 / factor, rel=1e-5)


def test_what_no_single_change_mends_is_stated():
    def other(x: Array) -> Array:
        y = np.array(x)
        y[:, :2] = sailed(9)[0][:, :2]  # of another run
        return y

    found = preflight(BOAT, logged(BOAT, other)).findings
    assert {(one.signal, one.kind) for one in found} == {("x", "mismatch"), ("y", "mismatch")}
    assert not any(one.corrected for one in found)
    assert all("psi, u and v" in one.finding for one in found)


@pytest.mark.parametrize("model", [BOAT, PLAIN])
@pytest.mark.parametrize("angle", [np.pi / 2, np.pi])
def test_a_heading_off_by_a_constant_is_no_exchange_and_no_sign(model, angle):
    def off(x: Array) -> Array:
        return x + angle * np.eye(6)[2]

    (found,) = preflight(model, logged(model, off)).findings
    assert (found.signal, found.kind, found.corrected) == ("psi", "offset", False)


def positions_late(by: float, which: tuple[int, ...] = (0, 1)):
    def fault(x: Array) -> Array:
        at, y = np.arange(len(x)) - by / DT, np.array(x)
        for i in which:
            y[:, i] = np.interp(at, np.arange(len(x)), x[:, i])
        return y[int(np.ceil(by / DT)) :]

    return fault


def delayed(findings):
    return {f.signal: f.delay_s for f in findings if f.kind == "delay" and f.corrected}


def test_positions_that_are_late_are_told_by_velocities_and_heading(by=0.15):
    found = preflight(BOAT, logged(BOAT, positions_late(by)))
    assert delayed(found.findings) == pytest.approx({"x": by, "y": by}, abs=0.01)
    assert not delayed(preflight(BOAT, found.trials).findings)


def in_the_world(x: Array) -> Array:
    y, (c, s) = np.array(x), (np.cos(x[:, 2]), np.sin(x[:, 2]))
    y[:, 3], y[:, 4] = c * x[:, 3] - s * x[:, 4], s * x[:, 3] + c * x[:, 4]
    return y


def test_one_trial_with_speeds_in_other_axes_is_named_alone():
    odd = [*logged(BOAT)[:2], logged(BOAT, in_the_world)[2]]
    with pytest.raises(UnusableTrials) as stopped:
        preflight(BOAT, odd)
    assert stopped.value.finding.code == "log.axes"
    assert stopped.value.then is not None and stopped.value.then.arguments == ("t0002",)


def test_a_compass_heading_is_put_right_in_one_finding():
    def compass(x: Array) -> Array:
        return np.where(np.arange(6) == 2, np.pi / 2 - x, x)

    for sound, odd in zip(logged(BOAT), logged(BOAT, compass), strict=True):
        found = preflight(BOAT, [odd])
        (one,) = found.findings
        assert (one.signal, one.kind, one.scale) == ("psi", "sign", -1.0)
        assert one.log == "scale = -1, offset = 1.5707963"
        np.testing.assert_allclose(found.trials[0].states, sound.states, atol=1e-9)


@pytest.mark.parametrize("factor", [0.7, 1.08, 1.3, 2.05, 2.4, 3.0, 3.45, 1 / 1.943844])
def test_a_slip_or_a_scale_of_another_size_is_no_unit(factor):
    for trial in logged(BOAT, times(u=factor, v=factor)):
        assert not {f.kind for f in preflight(BOAT, [trial]).findings} - {"mismatch"}
