"""What the sensors give away of themselves: delays, derived speeds, units, signs, axes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

import grounded as gr
from benchmarks.accounts import ROBOTS, driven
from facts import holds
from grounded import Model, Param, Trial
from grounded.accounts.commands import clocks_apart, how_inputs_act, judge_clocks
from grounded.accounts.finding import Finding, UnusableTrials, late_as_positions, late_effects
from grounded.accounts.sound_trials import sound_trials as preflight
from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.diagnosis.telling import instrument_lines
from grounded.effects import Scales, Site, wrap
from grounded.effects.sensor import sensor_lag
from grounded.errors import GroundedError
from grounded.findings import Quantity, found
from grounded.frozen import Array
from grounded.models.arm import model as arm
from stepped import levels, library, logged, stepped


def craft(lag=0.3, drag=0.4, gain=1.0):
    """A thing with a thruster and a rudder, whose speeds nobody has to measure."""
    return Model(
        name="craft",
        states={"x": "m", "psi": "rad", "v": "m/s", "r": "rad/s"},
        inputs={"thrust": "1", "rudder": "rad"},
        params={
            "gain": Param(gain, "m/s^2", 0.3, 3.0),
            "drag": Param(drag, "1/s", 0.1, 2.0),
            "lag": Param(lag, "s", 0.02, 1.0),
        },
        derivative=lambda s, a, p: {
            "x": s.v,
            "psi": s.r,
            "v": p.gain * a.thrust - p.drag * s.v,
            "r": (1.5 * a.rudder - s.r) / p.lag,
        },
    )


def clocked(model, *, early=0, seed=0, dt=0.02, steps=900, hold=15):
    """Under commands that change every 0.3 s; `early`: steps by which the states are ahead."""
    rng = np.random.default_rng(seed)
    sent = levels(rng, steps // hold, hold, m=model.m)
    x = stepped(model, sent, dt)
    noise = 0.002 * np.std(x, axis=0)
    return logged(model, x[early:], sent[: steps - early], dt, noise, rng, id=f"t{seed:04}")


REAL = craft(lag=0.15, drag=0.7, gain=0.8)


@pytest.mark.parametrize("early", [8, 23, 40])
@pytest.mark.parametrize("blind", [False, True])
def test_states_before_their_commands_are_told_by_how_much(early, blind):
    trial = clocked(REAL, early=early)
    if blind:  # no sensor of the speeds
        trial = replace(trial, states=trial.states * [1, 1, np.nan, np.nan])
    found = clocks_apart(craft(), trial, range(4))
    assert found is not None and found.facts["lead"] == pytest.approx(0.02 * early, abs=0.04)
    assert found.facts["mended"].value < found.facts["logged"].value / 2
    assert found.about == craft().state_names[: 2 if blind else 4]


def test_a_diagnosis_stops_at_them_and_names_the_delay():
    trials = [clocked(REAL, early=23 * k, seed=k) for k in range(2)]
    with pytest.raises(GroundedError) as stopped:
        gr.diagnose(craft(), trials)
    said = str(stopped.value)
    assert holds(said, "t0001", "clocks", "[log.state.x]", "[log.state.r]")
    assert "t0000" not in said and stopped.value.then.arguments == ("t0001",)
    judge_clocks(craft(), trials[:1], range(4))


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
    waves = ((0.35, 3.4, 0.0), (0.1, 1.3, 1.0), (0.05, 6.0, 2.0))
    q, w = sum(a * np.exp(1j * (b * t + c)) * [[-1j], [b]] for a, b, c in waves).real
    u = sum((12.0 - b * b) * a * np.sin(b * t + c) for a, b, c in waves)[::fine]
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


BOAT = ROBOTS["boat"]()
MODEL, NAMES, BOAT_DT = BOAT.model, BOAT.model.state_names, BOAT.dt
X, Y, PSI, U, V, R = range(6)


@pytest.fixture(scope="module")
def sound():
    """Three logs of a boat that drifts in a current."""
    trials = driven(BOAT, np.random.default_rng(11), 3)
    current = np.array([0.05, -0.03, 0, 0, 0, 0]) * BOAT_DT
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
        x[:, :2] = np.stack([np.interp(at - by / BOAT_DT, at, x[:, i]) for i in (X, Y)], axis=1)
        return x[int(np.ceil(by / BOAT_DT)) :]

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


HAND_DT = 0.01
AXIS = Model(
    name="axis",
    states={"x": "m", "v": "m/s"},
    inputs={"torque": "N m"},
    params={"M": Param(12.0, "kg", 9.0, 16.0)},
    derivative=lambda s, a, p: {"x": s.v, "v": 100.0 * a.torque / p.M},
)


def moved_by_hand(wired, seed, seconds=3.0):
    """An axis with friction of 8 N and 15 N s/m, under feedback to points 1.3 s apart."""
    rng = np.random.default_rng(seed)
    goals, x, v, states, inputs = rng.uniform(0.0, 1.0, 40), 0.0, 0.0, [], []
    for k in range(round(seconds / HAND_DT)):
        states.append((x + 2e-5 * rng.normal(), v + 2e-3 * rng.normal()))
        u = 1.6 * (goals[int(k * HAND_DT / 1.3)] - states[-1][0]) - 0.5 * states[-1][1]
        inputs.append((np.clip(u + 0.05 * rng.normal(), -1.5, 1.5),))
        for _ in range(10):
            force = 100.0 * wired * inputs[-1][0]
            v += 1e-3 * (force - 8.0 * np.tanh(v / 0.005) - 15.0 * v) / 12.0
            x += 1e-3 * v
    return logged(AXIS, [*states, (x, v)], inputs, HAND_DT)


@pytest.mark.parametrize("wired", [1.0, -1.0])
@pytest.mark.parametrize("seed", range(3))
def test_the_sign_of_an_input_is_known_though_friction_is_not_modelled(wired, seed):
    """With the wrong sign the feedback runs away: the input is at its limit but for 0.3 s."""
    (acts,) = how_inputs_act(AXIS, moved_by_hand(wired, seed), range(2))
    assert acts.sign * wired >= 0


POSE_DT, FINE = 0.05, 10  # [s] control step; steps of the simulation in one
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


def posed(seed: int, steps: int = 240) -> Trial:
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

    rows = stepped(rates, np.repeat(u, FINE, axis=0), POSE_DT / FINE, np.zeros(5), fine=1)
    t, at = POSE_DT * np.arange(steps + 1), POSE_DT / FINE * np.arange(steps * FINE + 1)
    told = [np.interp(t - LATE * (i > 1), at, row) for i, row in enumerate(rows.T)]
    noise = [0.002, 0.004, 0.0004, 0.0004, 0.0008]
    return logged(ROVER, np.transpose(told)[1:], u[1:], POSE_DT, noise, rng, id=f"t{seed}")


def told(findings):
    return {f.signal: f.delay_s for f in findings if f.kind == "delay" and f.corrected}


def test_one_message_is_late_as_a_whole():
    trials = [posed(seed) for seed in (1, 2, 3)]
    assert set(told(preflight(ROVER, trials).findings)) == {"psi"}
    found = preflight(ROVER, trials, one_message=POSE)
    assert told(found.findings) == pytest.approx(dict.fromkeys(POSE, LATE), abs=0.004)
    assert {f"sensor_delay:{name}" for name in POSE} <= found.settled


STEP = 0.02


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
    x = stepped(replace(model, substeps=8), u, STEP)
    return logged(model, x, u, STEP, [1e-3, 1e-2], rng)


def test_the_verdict_tells_it():
    model = motor(95.0)
    options = DiagnosisOptions(library=library("input_gain"))
    found = diagnose(model, [run(model, k) for k in range(3)], options)
    assert "substeps=2" in found.preflight[0].advice
    assert [one.kind for one in found.preflight] == ["time step"]


def whirled(k, whirl=0.0, steps=80):
    """A run whose inputs are 40 ms late; `whirl` [N m] turns the second joint from 0.6 s on."""
    rng, t = np.random.default_rng(k), STEP * np.arange(steps)
    u = 0.4 * np.stack([3 * np.sin((3 + k) * t + k), np.sin((5 - k) * t)], axis=1)
    u[30:, 1] += whirl
    late = np.r_[np.zeros((2, 2)), u[:-2]]
    parts, start = np.repeat(late, 40, axis=0), [-np.pi / 2, 0.0, 0.0, 0.0]
    x = stepped(arm, parts, STEP / 40, start)[::40]
    return logged(arm, x, u, STEP, [1e-3, 1e-3, 1e-2, 1e-2], rng, id=f"t{k:04d}")


def test_a_whirling_trial_is_cut_where_the_model_cannot_be_integrated():
    trials = [whirled(0, 10.0), whirled(1), whirled(2)]
    looked = preflight(arm, trials)
    (found,) = [one for one in looked.findings if one.kind == "unresolved"]
    keep = looked.trials[0].known_steps
    assert found.signal == "q2_vel" and found.corrected
    assert found.share == pytest.approx(1 - keep / 80)
    assert 35 < keep < 60 and [t.known_steps for t in looked.trials[1:]] == [80, 80]
    assert (found.said.facts["trial"], found.said.facts["at"].value) == ("t0000", keep * STEP)
    (line,) = [x for x in instrument_lines(looked.findings) if "time steps" in x]
    assert line.startswith("q2_vel: reaches 331 rad/s") and "corrected" not in line
