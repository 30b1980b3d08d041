"""Commands and joints in each other's column, and commands in percent, by what a model makes."""

from dataclasses import replace

import numpy as np
import pytest
from grounded.instruments.predictions.mistaken import (
    ODD_FROM,
    Mistake,
    _best,
    described,
    judge_commands,
    mended_by,
    mistaken,
)

import grounded as gr
from cli import grounded
from facts import holding, holds
from grounded import Model, Param
from grounded.accounts.motion import Ahead, Fit
from grounded.errors import GroundedError
from grounded.trial import Trial
from ros_bags import thruster_bag


def vessel(gain=1.0, arm=0.6, drag=0.8, **params):
    """A catamaran with a thruster on each hull."""

    def rates(s, a, p):
        push, turn = p.gain * (a.port + a.starboard), p.gain * p.arm * (a.starboard - a.port)
        return {
            "u": push - p.drag * s.u,
            "r": turn - 1.5 * p.drag * s.r,
            "north": s.u * np.cos(s.psi),
            "east": s.u * np.sin(s.psi),
            "psi": s.r,
        }

    return Model(
        name="vessel",
        states={"u": "m/s", "r": "rad/s", "north": "m", "east": "m", "psi": "rad"},
        inputs={"port": "1", "starboard": "1"},
        params={
            "gain": Param(gain, "m/s^2", 0.2, 3.0),
            "arm": Param(arm, "rad/m", 0.1, 2.0),
            "drag": Param(drag, "1/s", 0.1, 3.0),
        },
        angles=("psi",),
        derivative=rates,
    )


def two_joints(coupling=0.3):
    """A planar arm whose shoulder is heavier than its elbow."""

    def rates(s, a, p):
        return {
            "q1": s.w1,
            "q2": s.w2,
            "w1": 1.2 * a.t1 - 4.0 * np.sin(s.q1) - 0.3 * s.w1 - p.c * s.w2,
            "w2": 5.0 * a.t2 - 9.0 * np.sin(s.q1 + s.q2) - 0.5 * s.w2 - p.c * s.w1,
        }

    return Model(
        name="arm",
        states={"q1": "rad", "q2": "rad", "w1": "rad/s", "w2": "rad/s"},
        inputs={"t1": "N m", "t2": "N m"},
        params={"c": Param(coupling, "1/s", 0.0, 1.0)},
        derivative=rates,
    )


def driven(model, seed=0, *, late=0, gains=1.0, noise=0.01, steps=400, dt=0.05):
    """Under commands that change every 0.4 s, from rest."""
    rng, x, states = np.random.default_rng(seed), np.zeros(model.n), []
    sent = np.repeat(rng.uniform(-0.5, 1.0, (steps // 8, model.m)), 8, axis=0)
    for k in range(steps):
        states.append(x)
        u = sent[max(k - late, 0)] * gains
        x = model.system.step(x[None], u[None], model.values, dt)[0]
    logged = np.array([*states, x])
    logged += noise * np.std(logged, axis=0) * rng.normal(size=logged.shape)
    return Trial(logged, sent, dt, model.state_names, model.input_names, id=f"t{seed:04}")


def every(model):
    return range(model.n)


SWAPPED = Mistake(inputs=(0, 1))
CRUDE = [vessel(), vessel(gain=0.6, drag=1.4), vessel(arm=1.1)]


@pytest.mark.parametrize("crude", CRUDE)
@pytest.mark.parametrize("late", [0, 2])
def test_exchanged_commands_are_named_and_a_crude_model_is_no_exchange(crude, late):
    trials = [driven(vessel(), k, late=late, gains=np.array([0.8, 1.1])) for k in range(2)]
    assert mistaken(crude, trials, every(crude)) is None
    told = mistaken(crude, [SWAPPED.mended(t) for t in trials], every(crude))
    assert told is not None and told.mistake.inputs == (0, 1) and told.mistake.signs == (1, 1)
    assert told.mended < told.logged / 2 and not told.others
    said = described(crude, told)
    assert holds(said, "port and starboard", "r, east and psi")  # the mirror image does it, too


@pytest.mark.parametrize("late", [0, 6])
def test_an_exchange_behind_a_lag_and_a_dead_zone_is_named(tmp_path, late):
    """A diagnosis claimed that the turn rate can't change faster than 0 rad/s^2."""
    for folder, swapped in (("right", False), ("crossed", True)):
        w = tmp_path / folder
        log = thruster_bag(tmp_path / f"{folder}-bag", swapped, names=True, late=late)
        assert grounded("init", w, "--from", log).code == 0
        said = grounded("-C", w, "ingest", "--data", log)
        assert said.code == 0
        assert ("columns of left and right look exchanged" in " ".join(said.err.split())) == swapped


def rover(tau=0.3, k_w=1.0):
    """A robot on two wheels that is told a speed and a rate of turn."""

    def rates(s, a, p):
        return {
            "v": (a.linear - s.v) / p.tau,
            "omega": (p.k_w * a.angular - s.omega) / p.tau,
            "x": s.v * np.cos(s.psi),
            "y": s.v * np.sin(s.psi),
            "psi": s.omega,
        }

    return Model(
        states={"v": "m/s", "omega": "rad/s", "x": "m", "y": "m", "psi": "rad"},
        inputs={"linear": "m/s", "angular": "rad/s"},
        params={"tau": Param(tau, "s", 0.05, 1.0), "k_w": Param(k_w, "1", 0.7, 1.3)},
        angles=("psi",),
        derivative=rates,
    )


@pytest.mark.parametrize("late", [0, 2])
def test_exchanged_commands_of_two_units_are_named(late):
    """A diagnosis said of a Twist read crosswise that the speed moves by at most 0 m/s^2."""
    trials = [driven(rover(), k, late=late, gains=np.array([1.0, 0.9])) for k in range(2)]
    crude = rover(tau=0.15, k_w=1.1)
    assert mistaken(crude, trials, every(crude)) is None
    told = mistaken(crude, [SWAPPED.mended(t) for t in trials], every(crude))
    assert told is not None and told.mistake.inputs == (0, 1) and told.mistake.signs == (1, 1)


def test_an_exchange_with_a_sign_says_whose():
    odd = SWAPPED.mended(driven(vessel(), gains=np.array([-1.0, 1.0])))
    told = mistaken(vessel(), [odd], every(vessel()))
    assert told is not None and told.mistake.inputs == (0, 1) and told.mistake.signs == (-1, 1)
    assert holds(described(vessel(), told), "sign of port")


def test_an_exchange_with_a_sign_takes_five_seconds_of_log():
    """2.5 s of an arm whose joints stick more than the model knows were refused as one."""
    for gains, signs in (((-1.0, 1.0), (-1, 1)), ((1.0, 1.0), (1, 1))):
        whole = SWAPPED.mended(driven(vessel(), gains=np.array(gains)))
        short = whole.until(round(4.8 / whole.dt))
        assert short.steps * short.dt < ODD_FROM < whole.steps * whole.dt
        told = mistaken(vessel(), [short], every(vessel()))
        assert (told is None) if min(signs) < 0 else (told is not None)
        told = mistaken(vessel(), [short, short], every(vessel()))  # of all trials together
        assert told is not None and told.mistake.signs == signs


@pytest.mark.parametrize("gains", [(-1.0, 1.0), (-1.0, -1.0), (0.0, 1.0), (0.3, 2.5)])
def test_a_turned_dead_or_weak_input_is_no_exchange(gains):
    trials = [driven(vessel(), k, gains=np.array(gains)) for k in range(2)]
    assert mistaken(vessel(), trials, every(vessel())) is None


def test_two_commands_that_do_the_same_tell_nothing():
    straight = Model(
        name="cart",
        states={"x": "m", "v": "m/s"},
        inputs={"front": "N", "rear": "N"},
        derivative=lambda s, a, p: {"x": s.v, "v": a.front + a.rear - 0.5 * s.v},
    )
    trial = driven(straight)
    for one in (trial, SWAPPED.mended(trial)):
        assert mistaken(straight, [one], every(straight)) is None


def test_one_trial_that_is_right_as_it_is_refutes_an_exchange():
    trials = [driven(vessel(), k) for k in range(3)]
    trials[1] = SWAPPED.mended(trials[1])
    assert mistaken(vessel(), trials, every(vessel())) is None
    assert mistaken(vessel(), trials[1:2], every(vessel())) is not None


def test_exchanged_joints_with_their_velocities_are_named_in_one_run():
    arm, joints = two_joints(), Mistake(states=((0, 1), (2, 3)))
    trial = driven(two_joints(0.1))
    assert mistaken(arm, [trial], every(arm)) is None
    told = mistaken(arm, [joints.mended(trial)], every(arm))
    assert told is not None and joints in (told.mistake, *told.others)
    assert holds(described(arm, told), "q1 and q2", "w1 and w2")
    told = mistaken(arm, [SWAPPED.mended(trial)], every(arm))
    assert told is not None and holds(described(arm, told), "t1 and t2")


def crane(L=0.85, kF=27.0, rub=0.75):
    """A trolley with a load: a position in m and an angle, each with its own velocity."""

    def rates(s, a, p):
        sn, cs = np.sin(s.th), np.cos(s.th)
        pull = 2 * sn * (p.L * s.w**2 + 9.81 * cs)
        acc = (p.kF * a.volt - 3 * s.v - 6 * rub * np.tanh(s.v / 0.05) + pull) / (6 + 2 * sn**2)
        return {"x": s.v, "v": acc, "th": s.w, "w": -(acc * cs + 9.81 * sn) / p.L}

    return Model(
        states={"x": "m", "v": "m/s", "th": "rad", "w": "rad/s"},
        inputs={"volt": "V"},
        params={"L": Param(L, "m", 0.5, 1.6), "kF": Param(kF, "N/V", 10.0, 40.0)},
        angles=("th",),
        derivative=rates,
    )


def test_positions_in_unlike_units_are_exchanged_with_their_velocities_too():
    """The log of a crane whose trolley and load were exchanged had a confident, wrong verdict."""
    crude, joints = crane(1.0, 25.0, 0.0), Mistake(states=((0, 2), (1, 3)))
    trial = driven(crane(), dt=0.04)
    assert mistaken(crude, [trial], every(crude)) is None
    told = mistaken(crude, [joints.mended(trial)], every(crude))
    assert told is not None and told.mistake == joints


def ball(rub=0.0, tilt=0.0, lag=0.05, linkage=0.1):
    """A ball that rolls on a beam which a servo tilts."""

    def rates(s, a, p):
        return {
            "x": s.v,
            "v": 7.0 * np.sin(s.beam + tilt) - rub * np.tanh(s.v / 0.01),
            "beam": (p.linkage * a.servo - s.beam) / p.lag,
        }

    return Model(
        name="ball",
        states={"x": "m", "v": "m/s", "beam": "rad"},
        inputs={"servo": "rad"},
        params={"linkage": Param(linkage, "1", 0.05, 0.2), "lag": Param(lag, "s", 0.01, 0.3)},
        derivative=rates,
    )


ROLLED = ball(rub=0.1, tilt=0.02, lag=0.12, linkage=0.085)


@pytest.mark.parametrize("turned", [(0, 1), (2,)])
def test_a_sensor_that_counts_the_other_way_is_named_with_its_velocity(turned):
    trials = [driven(ROLLED, k) for k in range(2)]
    assert mistaken(ball(), trials, every(ball())) is None
    told = mistaken(ball(), [Mistake(turned=turned).mended(t) for t in trials], every(ball()))
    assert told is not None and told.mistake.turned == turned and not told.others
    names = [ball().state_names[i] for i in turned]
    assert holds(described(ball(), told), *names, "the opposite sign")
    assert all(f"[log.state.{name}]" in mended_by(ball(), told) for name in names)


def test_a_position_that_counts_the_other_way_beside_a_right_velocity_is_named_alone():
    """The distance from the top as the height: both were to be turned, then one back again."""
    trials = [Mistake(turned=(0,)).mended(driven(ROLLED, k)) for k in range(2)]
    with pytest.raises(GroundedError) as refused:
        gr.diagnose(ball(), trials)
    said = str(refused.value)
    assert "x looks logged" in said and "[log.state.x]" in said and "[log.state.v]" not in said


@pytest.mark.parametrize("gain", [-1.0, 0.0, 0.3])
def test_a_turned_dead_or_weak_input_is_no_turned_sensor(gain):
    trials = [driven(ROLLED, k, gains=np.array([gain])) for k in range(2)]
    assert mistaken(ball(), trials, every(ball())) is None


@pytest.mark.parametrize(
    ("factor", "unit"), [(100.0, "percent"), (255.0, "8 bits"), (1000.0, "thousandths")]
)
def test_commands_of_another_unit_are_named_with_their_scale(factor, unit):
    trials = [driven(vessel(), k, gains=0.8) for k in range(2)]
    odd = [replace(t, inputs=factor * t.inputs) for t in trials]
    told = mistaken(CRUDE[1], odd, every(CRUDE[1]))
    assert told is not None and told.mistake.inputs == (0, 1)
    assert told.mistake.factor == factor and unit in told.mistake.unit
    with pytest.raises(GroundedError, match=holding("[log.input.port]", f"{1 / factor:.6g}")) as no:
        judge_commands(CRUDE[1], odd)
    assert no.value.then is not None and no.value.then.arguments == ("t0000", "t0001")


def test_parts_of_one_for_a_model_in_percent_are_named():
    """Nothing was said, and the diagnosis blamed a time constant at its bound and three sensors."""

    def rates(s, a, p):
        return {"v": p.k * a.throttle - s.v}

    params = {"k": Param(0.05, "m/s^2", 0.03, 0.07)}
    units = {"states": {"v": "m/s"}, "inputs": {"throttle": "%"}}
    model = Model(name="m", params=params, derivative=rates, **units)
    trial = driven(model, gains=40.0)
    trial = replace(trial, inputs=40 * trial.inputs)
    assert mistaken(model, [trial], every(model)) is None
    told = mistaken(model, [replace(trial, inputs=trial.inputs / 100)], every(model))
    assert told is not None and told.mistake.factor == 0.01
    assert holds(described(model, told), "100 times too small")
    assert "by 100 " in mended_by(model, told)


def test_commands_that_are_large_in_the_model_too_are_in_no_other_unit():
    def rates(s, a, p):
        return {"v": 0.01 * a.duty - s.v}

    model = Model(name="m", states={"v": "m/s"}, inputs={"duty": "1"}, derivative=rates)
    trial = driven(model)
    large = driven(model, gains=100.0)
    large = replace(large, inputs=100 * large.inputs)
    for one in (trial, large, replace(large, states=0 * large.states)):
        assert mistaken(model, [one], every(model)) is None


def test_an_angle_that_is_sent_in_degrees_is_named():
    def rates(s, a, p):
        return {"psi": s.r, "r": 4.0 * (0.8 * np.sin(a.rudder) - s.r)}

    states = {"psi": "rad", "r": "rad/s"}
    model = Model(name="m", states=states, inputs={"rudder": "rad"}, derivative=rates)
    trial = driven(model, gains=0.5)
    trial = replace(trial, inputs=0.5 * trial.inputs)
    assert mistaken(model, [trial], every(model)) is None
    told = mistaken(model, [replace(trial, inputs=np.rad2deg(trial.inputs))], every(model))
    assert told is not None and told.mistake.factor == pytest.approx(180 / np.pi)


def test_gaps_hidden_states_and_short_logs_are_no_obstacle():
    trial = SWAPPED.mended(driven(vessel()))
    states = np.array(trial.states)
    states[40:60] = np.nan
    states[:, 2] = np.nan
    told = mistaken(vessel(), [replace(trial, states=states)], every(vessel()))
    assert told is not None and told.state != vessel().state_names.index("north")
    assert mistaken(vessel(), [trial.until(12)], every(vessel())) is None
    assert mistaken(vessel(), [trial.until(0)], every(vessel())) is None
    assert mistaken(vessel(), [], every(vessel())) is None


def test_a_channel_that_a_change_leaves_empty_tells_nothing():
    """Two warnings of numpy's stood above a diagnosis' verdict."""
    trial = driven(vessel())
    states = np.array(trial.states)
    states[:, 1] = np.nan
    assert not Ahead(vessel(), replace(trial, states=states), range(5), 100).enough


def test_a_diagnosis_stops_at_exchanged_commands():
    trials = [SWAPPED.mended(driven(vessel(), k)) for k in range(2)]
    with pytest.raises(
        GroundedError, match=holding("port and starboard", "every trial")
    ) as stopped:
        gr.diagnose(vessel(), trials)
    assert stopped.value.then is not None and stopped.value.then.verb == "discard"


def test_of_two_explanations_an_exchange_comes_before_a_turned_sensor():
    """It is a mistake of [log] alone; the other has the robot's program wrong as well."""

    def fits(left):
        return {0: (Fit(np.ones(4), np.ones(2)), Fit(left, np.ones(2)))}

    turned, swapped = Mistake(turned=(0, 2)), Mistake(states=((0, 1), (2, 3)))
    close, clear = np.array([0.5, 0.4, 0.5, 0.4]), np.array([0.5, 0.2, 0.5, 0.2])
    told = _best({turned: fits(close), swapped: fits(1.1 * close)})
    assert (told.mistake, told.others) == (swapped, (turned,))
    assert told.mended == pytest.approx(0.44)
    told = _best({turned: fits(clear), swapped: fits(close)})
    assert (told.mistake, told.others) == (turned, ())
