"""What is searched, how far and how surely, follows from the model and the log."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from grounded import GroundedError, Model, Param, Trial, diagnose
from grounded.diagnosis.diagnose import DiagnosisOptions
from grounded.diagnosis.hypotheses.search import TO_THE_TOP, HypothesisSearch
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.validation.claims import moved_parameters
from grounded.diagnosis.validation.identifiable import identified
from grounded.diagnosis.validation.limits import excitation, knowable, without_others
from grounded.effects import InputFamily, Library, MemoryFamily, wrap
from grounded.models.arm import model as arm
from grounded.models.cart_pole import model as cart_pole
from grounded.models.pendulum import model as pendulum
from grounded.places import levelled
from grounded_trials.logs.resample import to_grid
from grounded_trials.logs.signals import Series, SignalSpec
from stepped import levels, library, logged, stepped


def only(*names):
    """Options of a diagnosis by a few families."""
    return DiagnosisOptions(library=library(*names))


def offered(model, trials):
    """The names of what is offered to explain trials."""
    data = prepare(model, trials)
    return {e.name for e in knowable(data, Library().candidates(model, data.scales))}


def slide(s, a, p, dt):
    """The force of a slide that is dragged past a spring; `was` is where its handle was."""
    return {"f": p.k * np.tanh((a.pull - s.was) / 2e-3), "was": a.pull}


def branching(s, a, p, dt):
    """The same, of a function that can't be traced."""
    return slide(s, a, p, dt) if a.pull < 1e9 else {"f": 0.0, "was": 0.0}


def dragged(step, play, count=160, dt=0.04):
    """Two logs of the slide, whose handle has some play; where it was is in none of them."""
    k = Param(30.0, "N", std=3.0)
    model = Model({"f": "N", "was": "m"}, {"pull": "m"}, {"k": k}, step=step)
    rng, trials = np.random.default_rng(2), []
    for size, rate in ((0.09, 2.1), (0.14, 1.4)):
        pull, at = size * np.sin(rate * np.arange(count) * dt), [0.0]
        for now in pull:
            at.append(min(max(at[-1], now - play / 2), now + play / 2))
        force = np.r_[0.0, 30.0 * np.tanh(np.diff(at) / 2e-3)] + 0.4 * rng.normal(size=count + 1)
        trials.append(logged(model, np.c_[force, np.full(count + 1, np.nan)], pull, dt))
    return model, trials


@pytest.mark.parametrize("step", [slide, branching])
def test_a_state_that_the_commands_alone_determine_is_an_exact_memory(step):
    model, trials = dragged(step, 0.0, 20)
    data = prepare(model, trials)
    assert data.exact == data.hidden == (1,)
    np.testing.assert_allclose(data.states[1:21, 1], trials[0].inputs[:, 0])


@pytest.mark.slow
def test_a_play_before_a_models_own_memory_is_found():
    model, trials = dragged(slide, 0.021)
    found = diagnose(model, trials, only("backlash", "dead_zone", "input_gain", "parameter"))
    (claimed,) = (row for row in found.ranking if row.claimed)
    assert claimed.effect == "backlash:pull"
    assert claimed.values["b"] == pytest.approx(0.021, rel=0.1)


def flushed(late, steps=260, dt=0.5):
    """A bath with a time constant of 40 s; warm water arrives `late` steps after its valve."""
    model = Model(
        {"T": "degC"},
        {"valve": "1"},
        {"k": Param(11.0, "degC", 5.0, 30.0), "tau": Param(40.0, "s")},
        derivative=lambda s, a, p: {"T": (p.k * a.valve - s.T) / p.tau},
    )
    rng, trials = np.random.default_rng(8), []
    for some in ((0.2, 0.9, 0.4, 0.7), (0.8, 0.1, 0.6, 0.3)):
        valve = np.repeat(some, steps // 4)
        arrives = np.r_[np.zeros(late), valve][:steps]
        T = stepped(model.with_values({"k": 12.0}), arrives, dt)
        trials.append(logged(model, T, valve, dt, 0.02, rng))
    return model, trials


@pytest.mark.slow
def test_a_dead_time_of_many_steps_is_found():
    model, trials = flushed(14)
    found = diagnose(model, trials, only("delay", "first_order_lag", "rate_limit", "input_gain"))
    claimed = [row for row in found.ranking if row.claimed]
    assert [row.effect for row in claimed if row.effect != "input_gain:valve"] == ["delay:valve"]
    assert claimed[0].values["d"] == pytest.approx(7.0, abs=0.2)


def cart(right, turns):
    """Logs of a cart of two wheels under proportional commands, each of which acts 0.3 too far."""
    model = Model(
        {"v": "m/s", "w": "rad/s"},
        {"a": "1", "b": "1"},
        {"k": Param(2.0, "1/s", std=0.02)},
        derivative=lambda s, u, p: {
            "v": p.k * (u.a + u.b - s.v),
            "w": p.k * (turns * (u.a - u.b) - s.w),
        },
    )
    rng = np.random.default_rng(3)
    sent = [levels(rng, 8, 10) * [1.0, right] for _ in range(2)]
    return model, [logged(model, stepped(model, u + 0.3, 0.1), u, 0.1, 4e-3, rng) for u in sent]


@pytest.mark.parametrize(
    ("right", "turns", "single"), [(1.0, 0.0, False), (0.4, 0.0, False), (1.0, 3.0, True)]
)
def test_of_inputs_that_no_trial_tells_apart_only_all_together_are_blamed(right, turns, single):
    """Wheels that also turn the cart are told apart by that, whatever they are sent."""
    model, trials = cart(right, turns)
    data, library = prepare(model, trials), Library()
    known = knowable(data, library.candidates(model, data.scales))
    acting = [e for e in known if isinstance(e.family, InputFamily | MemoryFamily)]
    of_all = {e.family.name for e in acting if e.site.targets == ("a", "b")}
    assert len(acting) == len({e.name for e in acting})
    assert of_all == {e.family.name for e in acting}
    assert any(len(e.site.targets) == 1 for e in acting) == single
    for effect in acting:
        assert library.effect(effect.name, model, data.scales).site.targets == effect.site.targets


def swings():
    """Three runs of the pendulum itself, disturbed, from moving starts."""
    rng, found, t = np.random.default_rng(0), [], np.arange(150) * 0.02
    disturbed = np.sqrt(0.02) * np.array([0.004, 0.06])
    for _ in range(3):
        start = rng.uniform(-1, 1, 2)
        u = 1.5 * np.sin(rng.uniform(3, 5) * t) + np.sin(rng.uniform(7, 9) * t + 1)
        x = stepped(pendulum, u, 0.02, start, disturbed=disturbed, rng=rng)
        found.append(logged(pendulum, x, u, 0.02, [0.005, 0.05], rng))
    return found


def test_what_acts_on_a_state_that_never_moved_is_not_offered():
    stuck = [replace(one, states=one.states * [1, 0] + [0, 0.25]) for one in swings()]
    assert excitation(prepare(pendulum, stuck)).unmoved == ("omega",)
    found = offered(pendulum, stuck)
    assert "rate_gain:theta" in found and "sensor_scale:theta" in found
    assert not {"viscous_friction:omega", "sensor_delay:omega", "sensor_bias:omega"} & found


def test_the_friction_of_a_free_swing_is_named():
    rng, friction = np.random.default_rng(3), pendulum.params["b"].value + 0.05
    nominal = replace(
        pendulum, params={n: Param(p.value, p.unit) for n, p in pendulum.params.items()}
    )
    still, real = np.zeros(300), pendulum.with_values({"b": friction})
    swung = [
        logged(pendulum, stepped(real, still, 0.02, [q, 0.0]), still, 0.02, [2e-4, 2e-3], rng)
        for q in rng.uniform(1.0, 1.8, 2)
    ]
    found = diagnose(nominal, swung)
    inertia = pendulum.params["m"].value * pendulum.params["l"].value ** 2
    (row,) = (r for r in found.ranking if r.claimed)
    assert row.effect == "viscous_friction:omega"
    assert row.values["k"] == pytest.approx(0.05 / inertia, rel=0.05)
    assert not any(r.effect.endswith(":torque") for r in found.ranking)


def test_how_much_a_switch_is_on_is_not_doubted():
    trials = [replace(t, inputs=(np.asarray(t.inputs) > 0) * 1.0) for t in swings()]
    found = offered(pendulum, trials)
    assert excitation(prepare(pendulum, trials)).on_off == {"torque"} and "delay:torque" in found
    assert not {f"{name}:torque" for name in ("saturation", "input_gain", "backlash")} & found
    assert not excitation(prepare(pendulum, swings())).on_off


def test_a_model_that_is_no_number_at_a_measured_state_says_where():
    tank = Model(
        states={"h": "m"},
        inputs={"u": "1"},
        params={"k": Param(0.2, "m/s", std=0.06), "c": Param(0.3, "1", std=0.09)},
        derivative=lambda s, a, p: {"h": p.k * a.u - p.c * np.sqrt(s.h)},
        name="tank",
    )
    h = np.abs(np.sin(0.1 * np.arange(60)))[:, None]
    h[17] = -0.004
    trials = [Trial(h, np.ones((59, 1)), 0.1, ("h",), ("u",), id=f"t000{k}") for k in (1, 2)]
    with pytest.raises(GroundedError, match=r"t0001, t = 1\.7 s, h = -0\.004") as raised:
        diagnose(tank, trials)
    assert "np.maximum" in str(raised.value)


@pytest.mark.parametrize(("speeds", "free"), [((1.1, 1.7, 2.6, 3.4), True), ([1.7] * 4, False)])
def test_numbers_of_an_adopted_wave_are_held_where_one_motion_is_repeated(speeds, free):
    numbers = {"periodic_v_A": 0.4, "periodic_v_B": 0.0, "periodic_v_omega": 2.0}
    model = Model(
        states={"x": "m", "v": "m/s"},
        inputs={"u": "m/s^2"},
        params={name: Param(value, "1", std=0.1) for name, value in ({"k": 1.0} | numbers).items()},
        roles={"position": ("x",), "speed": "v"},
        derivative=lambda s, a, p: {"x": s.v, "v": p.k * a.u - s.v},
    )
    rng, noise = np.random.default_rng(3), [1e-3, 4e-3]
    sent = [np.sin(speed * np.arange(120) * 0.05) for speed in speeds]
    carts = [logged(model, stepped(model, u, 0.05), u, 0.05, noise, rng) for u in sent]
    held = without_others(prepare(model, carts, np.zeros(1)), ["periodic:v"], Library())
    assert [held.params[name].spread > 0 for name in model.params] == [True] + [free] * 3


STICK = Model(
    name="stick",
    states={"stick": "rad", "stick_rate": "rad/s"},
    inputs={"valve": "1"},
    params={"k": Param(0.8, "rad/s", 0.4, 1.6)},
    derivative=lambda s, a, p: {
        "stick": s.stick_rate,
        "stick_rate": (p.k * a.valve - s.stick_rate) / 0.15,
    },
)


def test_a_wrong_zero_of_a_sensor_may_be_another_level():
    assert levelled(pendulum) == ["theta"] and not levelled(STICK)
    params = {"g": Param(9.8, "m/s^2"), "l": Param(0.5, "m")}
    coupled = Model(  # the angle also moves the cart
        name="cart",
        states={"x": "m", "v": "m/s", "q": "rad", "w": "rad/s"},
        inputs={"f": "N"},
        params=params,
        derivative=lambda s, a, p: {
            "x": s.v,
            "v": a.f + np.sin(s.q),
            "q": s.w,
            "w": -p.g / p.l * np.sin(s.q),
        },
    )
    assert levelled(coupled) == []
    ball = Model(  # the verdict named the encoder alone, and the student's table was not level
        name="ball",
        states={"x": "m", "v": "m/s", "beam": "rad", "w": "rad/s"},
        inputs={"volt": "V"},
        params=params,
        derivative=lambda s, a, p: {
            "x": s.v,
            "v": 5 / 7 * p.g * np.sin(s.beam),
            "beam": s.w,
            "w": 8 * (0.5 * a.volt - s.w),
        },
    )
    assert levelled(ball) == ["beam"]


@pytest.mark.slow
def test_an_encoder_that_reads_short_is_named_and_a_gear_as_its_second_reading():
    """An encoder reads 6 % short beside a gyro that is right."""
    rng, short = np.random.default_rng(7), []
    for u in [levels(rng, 20, 10) for _ in range(3)]:
        shown = stepped(STICK, u, 0.02) * [0.94, 1.0]
        short.append(logged(STICK, shown, u, 0.02, [5e-4, 4e-3], rng))
    found = diagnose(STICK, short, only("sensor_scale", "rate_gain", "viscous_friction"))
    assert found.effects == ("sensor_scale:stick",)
    assert found.ranking[0].values["k"] == pytest.approx(-0.06, abs=0.005)
    (one,) = [one for one in found.findings if one.code == "model.sensor"]
    assert one.about == ("stick",) and one.facts["rate"] == "stick_rate"


def test_two_states_of_one_sensor_are_late_together_where_a_third_is_seen():
    rng, u = np.random.default_rng(5), 2 * np.sin(0.09 * np.arange(60))
    x = stepped(cart_pole, u, 0.025, [0.0, np.pi, 0.0, 0.0])
    swung = [logged(cart_pole, x, u, 0.025, [1e-3, 1e-3, 5e-3, 1e-2], rng) for _ in range(2)]
    pair = "sensor_delay:theta+theta_vel"
    assert pair in offered(cart_pole, swung)
    blind = [replace(t, states=t.states * [np.nan, 1, np.nan, 1]) for t in swung]
    found = offered(cart_pole, blind)
    assert "sensor_delay:theta" in found and pair not in found


def test_crosstalk_is_offered_where_the_model_has_no_such_path():
    """Each of a helicopter's two fans turns one axis, damped."""
    fans = Model(
        states={"pitch_rate": "rad/s", "yaw_rate": "rad/s"},
        inputs={"u_pitch": "V", "u_yaw": "V"},
        params={"d": Param(0.8, "1/s", 0.1, 3.0)},
        derivative=lambda s, a, p: {
            "pitch_rate": 1.2 * a.u_pitch - p.d * s.pitch_rate,
            "yaw_rate": a.u_yaw - p.d * s.yaw_rate,
        },
    )
    names = {e.name for e in Library().candidates(fans) if e.family.name == "crosstalk"}
    assert names == {"crosstalk:pitch_rate<-u_yaw", "crosstalk:yaw_rate<-u_pitch"}
    assert not any(e.family.name == "crosstalk" for e in Library().candidates(arm))


DT = 0.05


def ratio_cart(drag, std=0.05):
    """A cart whose force and mass show only as a ratio, unless it has a drag that is known."""
    return Model(
        states={"v": "m/s"},
        inputs={"u": "N"},
        params={"m": Param(2.0, "kg", std=std)},
        derivative=lambda s, a, p: {"v": (a.u - drag * s.v) / p.m},
    )


def driven(real, size=4.0):
    """Four runs under random levels."""
    rng = np.random.default_rng(3)
    sent = [levels(rng, 10, 8, size, real.m) for _ in range(4)]
    return [logged(real, stepped(real, u, DT), u, DT, 1e-3, rng) for u in sent]


def test_a_gain_beside_an_uncertain_mass_is_as_uncertain_as_the_mass():
    weaker = wrap(Library().effect("input_gain:u", ratio_cart(0.0)), {"g": -0.3}, DT)
    alone = DiagnosisOptions(library=library("input_gain"))
    found = diagnose(ratio_cart(0.0), driven(weaker), alone)
    assert found.effects == ("input_gain:u",)
    g = found.ranking[0].params["g"]
    assert g.value == pytest.approx(-0.3, abs=0.01)
    assert g.std == pytest.approx(0.7 * 0.05 / 2.0, rel=0.1)
    assert g.interval[1] - g.interval[0] > 3.8 * g.std
    (one,) = found.combinations
    assert one.values == ("input_gain:u",) and one.rests_on == {"m": 0.05}
    (told,) = [one for one in found.findings if one.code == "model.given"]
    assert told.about == ("input_gain:u",) and told.facts["rests"] == ("m",)
    assert found.to_json()["combinations"] == [
        {"values": ["input_gain:u"], "rests_on": {"m": 0.05}}
    ]


def planar():
    """Two joints in a horizontal plane: all torques and inertias may be larger by one factor."""

    def rates(s, a, p):
        mc, h = p.I2 + 0.06 * p.load, 0.07 + 0.075 * p.load
        c, sn = np.cos(s.q2), np.sin(s.q2)
        M11, M12 = 0.2 + p.I1 + 0.09 * p.load + mc + 2 * h * c, mc + h * c
        r1 = a.t1 + h * sn * (2 * s.w1 * s.w2 + s.w2**2)
        r2, det = a.t2 - h * sn * s.w1**2, M11 * mc - M12**2
        w1, w2 = (mc * r1 - M12 * r2) / det, (M11 * r2 - M12 * r1) / det
        return {"q1": s.w1, "q2": s.w2, "w1": w1, "w2": w2}

    return Model(
        states={"q1": "rad", "q2": "rad", "w1": "rad/s", "w2": "rad/s"},
        inputs={"t1": "N m", "t2": "N m"},
        params={
            "I1": Param(0.045, "kg m^2", std=0.01),
            "I2": Param(0.05, "kg m^2", std=0.05),
            "load": Param(0.5, "kg", std=0.3),
        },
        derivative=rates,
    )


PLANAR = {
    "input_gain:t1+t2": {"g": -0.2},
    "joint_friction:t1<-w1": {"c": 0.2, "b": 0.3},
    "added_inertia:t2<-w2": {"J": 0.03},
}


def test_the_scale_of_a_planar_arm_rests_on_the_surest_inertia():
    model, real, h = planar(), planar(), Hypothesis(shift=np.zeros(3), spread=1.0)
    for name in reversed(PLANAR):
        real = wrap(Library().effect(name, real), PLANAR[name], DT)
    data = prepare(model, driven(real, 2.0))
    for name, values in PLANAR.items():
        h = h.plus(Library().effect(name, model, data.scales), values)
    search = HypothesisSearch(data, ())
    (fit,) = search.refined([search.fresh(h)], TO_THE_TOP)
    found = identified(search.predictor, fit)
    (one,) = found.combinations
    assert {*one.values} == {*PLANAR, "load"} and one.rests_on == {"I1": 0.01}
    g = fit.hypothesis.values[0]["g"]
    # I1 + 0.2 + 0.09 load is in proportion to the torques, and so is 0.07 + 0.075 load
    per_g = (0.245 + 0.09 * 0.5 - 0.09 / 0.075 * (0.07 + 0.075 * 0.5)) / (1 + g)
    assert found.std["input_gain:t1+t2", "g"] == pytest.approx(0.01 / abs(per_g), rel=0.15)


def test_a_gain_follows_the_mass_that_is_held():
    """A cart only tells k / m, and b; its crude model is sure of m to 20 %."""
    model = Model(
        states={"v": "m/s"},
        inputs={"u": "V"},
        params={
            "m": Param(1.0, "kg", std=0.2),
            "k": Param(1.0, "N/V", std=0.5),
            "b": Param(0.5, "1/s", std=0.3),
        },
        derivative=lambda s, a, p: {"v": p.k / p.m * a.u - p.b * s.v},
    )
    rng, real = np.random.default_rng(0), {"m": 1.25, "k": 1.5, "b": 0.6}
    sent = [np.sin(rng.uniform(1, 4) * np.arange(150) * DT) for _ in range(3)]
    true = [stepped(model.with_values(real), u, DT) for u in sent]
    trials = [logged(model, x, u, DT, 3e-3, rng) for x, u in zip(true, sent, strict=True)]
    found = diagnose(model, trials, DiagnosisOptions(library=Library(())))  # calibration alone
    by = {one.parameter: one for one in found.identifiable}
    assert by["k"].given == pytest.approx({"m": 1.0}, abs=0.1) and not by["b"].given
    k = found.parameters["k"]
    assert k.value == pytest.approx(1.5 / 1.25, rel=0.02)
    assert abs(1.5 - k.value) > 5 * k.std  # with m as written
    assert abs(1.5 - k.value) < 2 * by["k"].prior * by["k"].left  # with all free
    (one,) = [f for f in found.findings if f.code == "model.given"]
    assert one.about == ("k",) and one.facts["rests"] == ("m",)


def test_of_two_parameters_that_hide_each_other_one_stays():
    boat = Model(
        states={"v": "m/s"},
        inputs={"u": "N"},
        params={"a": Param(0.5, std=0.3), "b": Param(0.5, std=0.3), "gain": Param(1.0, std=0.3)},
        derivative=lambda s, a, p: {"v": p.gain * a.u - p.a * s.v - p.b * s.v**3},
        integrator="euler",
    )
    rng, real = np.random.default_rng(1), boat.with_values({"a": 0.8, "b": 0.7, "gain": 1.3})
    sent = [levels(rng, 10, 8, 3.0) for _ in range(3)]
    trials = [logged(boat, stepped(real, u, 0.05), u, 0.05, 1e-3, rng) for u in sent]
    search = HypothesisSearch(prepare(boat, trials), ())
    fit = search.nulls()
    without = SimpleNamespace(held_out=False)
    assert {*moved_parameters(search, fit, without)} == {0, 1, 2}

    def gain(less, whole):
        a, b, needed = np.abs(less.hypothesis.shift) > 1e-9
        return SimpleNamespace(mean=0.0 if needed and (a or b) else 1.0)

    ruler = SimpleNamespace(held_out=True, since_outset=lambda fit: 1.0, gain=gain)
    left = {*moved_parameters(search, fit, ruler)}
    assert 2 in left and len(left) == 2


def test_a_delay_is_no_surer_than_states_between_two_samples():
    """Of a rover's log at 50 Hz on a grid of 20 Hz: 0.0461 +- 0.0001 s, of 0.050 s."""
    motor = Model(
        states={"w": "rad/s"},
        inputs={"u": "rad/s"},
        derivative=lambda s, a, p: {"w": (a.u - s.w) / 0.1},
    )
    rng, h, series = np.random.default_rng(0), 1e-3, {}
    sent = levels(rng, 40, 750)
    w = stepped(motor, np.concatenate([np.zeros((50, 1)), sent])[:30_000], h)[:, 0]
    w = w[:30_000:20] + 1e-3 * rng.standard_normal(1500)
    for name, y, every in (("w", w, 20), ("u", sent[::50, 0], 50)):
        stamps, spec = np.int64(1e9 * h * every) * np.arange(len(y)), SignalSpec(f"/{name}.data")
        series[name] = Series(spec, stamps, y, stamps, len(y), "a/B")
    log = to_grid(series, 0.05, ["w"], ["u"])
    assert log.interpolated_s == pytest.approx(0.0025, abs=1e-4)
    trial = Trial(log.states, log.inputs, 0.05, ("w",), ("u",))
    found = diagnose(motor, [trial], DiagnosisOptions(interpolated_s=log.interpolated_s))
    (row,) = (one for one in found.ranking if one.claimed)
    d, least = row.params["d"], log.interpolated_s
    assert row.effect == "sensor_delay:w" and abs(d.value - 0.05) < 2 * d.std
    assert least <= d.std < least + 1e-3
