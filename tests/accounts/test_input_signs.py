"""A motor wired the wrong way round in some trials, seen by a model without friction."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from grounded import Model, Param
from grounded.accounts.commands import how_inputs_act, judge_signs
from grounded.accounts.finding import UnusableTrials
from grounded.accounts.sound_trials import sound_trials
from grounded.models import arm, cart_pole
from grounded.trial import Trial

DT = 0.01
AXIS = Model(
    name="axis",
    states={"x": "m", "v": "m/s"},
    inputs={"torque": "N m"},
    params={"M": Param(12.0, "kg", 9.0, 16.0)},
    derivative=lambda s, a, p: {"x": s.v, "v": 100.0 * a.torque / p.M},
)


def driven(wired=1.0, rises=0.0, seed=0, seconds=3.0, identity=""):
    """An axis with friction of 8 N and 15 N s/m, under feedback to points 1.3 s apart.

    With `rises`, a negative spring [N/m], it has no friction, and the points are near 0.
    """
    rubs, far = (0.0, 0.1) if rises else (1.0, 1.0)
    rng = np.random.default_rng(seed)
    goals = far * rng.uniform(0.0, 1.0, 40)
    x, v, states, inputs = 0.0, 0.0, [], []
    for k in range(round(seconds / DT)):
        states.append((x + 2e-5 * rng.normal(), v + 2e-3 * rng.normal()))
        u = 1.6 * (goals[int(k * DT / 1.3)] - states[-1][0]) - 0.5 * states[-1][1]
        inputs.append((np.clip(u + 0.05 * rng.normal(), -1.5, 1.5),))
        for _ in range(10):
            force = 100.0 * wired * inputs[-1][0] + rises * x
            v += 1e-3 * (force - rubs * (8.0 * np.tanh(v / 0.005) + 15.0 * v)) / 12.0
            x += 1e-3 * v
    names = (AXIS.state_names, AXIS.input_names)
    return Trial(np.array([*states, (x, v)]), np.array(inputs), DT, *names, id=identity)


@pytest.mark.parametrize("wired", [1.0, -1.0])
@pytest.mark.parametrize("seed", range(3))
def test_the_sign_of_an_input_is_known_though_friction_is_not_modelled(wired, seed):
    """With the wrong sign the feedback runs away: the input is at its limit but for 0.3 s."""
    (acts,) = how_inputs_act(AXIS, driven(wired, seed=seed), range(2))
    assert acts.sign * wired >= 0


def test_the_trial_that_contradicts_the_others_is_named():
    right = driven(seconds=10.0, identity="t0001")
    wrong = replace(right, inputs=-right.inputs, id="t0002")
    judge_signs(AXIS, [right, replace(right, id="t0003")], range(2))
    judge_signs(
        AXIS, [wrong, replace(wrong, id="t0003")], range(2)
    )  # the model's sign: not their fault
    with pytest.raises(UnusableTrials) as raised:
        sound_trials(AXIS, [right, wrong])
    (one,) = raised.value.findings
    assert (one.code, one.about, one.facts["which"]) == ("log.reversed", ("torque",), ("t0002",))
    assert one.facts["others"] == ("t0001",) and one.facts["share"] < 0 < one.facts["usual"]
    assert raised.value.then.arguments == ("t0002",)
    sound_trials(AXIS, [right, wrong], first=1)  # two robots, which are compared
    more = [replace(wrong, id=f"t000{k + 2}") for k in range(2)]
    with pytest.raises(UnusableTrials) as raised:
        judge_signs(AXIS, [right, *more], range(2))
    facts = raised.value.finding.facts
    assert (facts["which"], facts["others"]) == (("t0001",), ("t0002", "t0003"))
    assert facts["usual"] < 0 < facts["share"]


SWINGS = {  # model, goal, inputs there, their limit, gains, largest distance of the start
    "axis": (AXIS, np.zeros(2), np.zeros(1), 1.5, np.array([[40.0, 3.0]]), [0.3, 0.0]),
    "cart": (
        cart_pole.model,
        np.zeros(4),
        np.zeros(1),
        12.0,
        np.array([[-30.0, -160.0, -30.0, -35.0]]),
        [0.3, 0.05, 0.0, 0.0],
    ),
    "arm": (
        arm.model,
        np.array([0.5, 1.0, 0.0, 0.0]),
        np.array([20.0, 2.0]),
        40.0,
        np.array([[900.0, 150.0, 60.0, 15.0], [150.0, 150.0, 15.0, 12.0]]),
        [0.6, 0.3, 0.0, 0.0],
    ),
}


def swinging(plant, late, seed, strong, dt, seconds):
    """A robot under feedback through commands `late` seconds late: it swings or whirls."""
    model, at, held, limit, gains, far = SWINGS[plant]
    rng, fine = np.random.default_rng(seed), 0.005
    x = at + np.array(far) * rng.uniform(-1.0, 1.0, model.n)
    queue, states, inputs = [held] * round(late / fine), [], []
    for _ in range(round(seconds / dt)):
        states.append(x + 1e-4 * rng.normal(size=model.n))
        inputs.append(np.clip(held - strong * gains @ (states[-1] - at), -limit, limit))
        for _ in range(round(dt / fine)):
            queue.append(inputs[-1])
            x = model.system.step(x[None], queue.pop(0)[None], model.values, fine)[0]
            rate = x[model.n // 2 :]
            rate -= fine * 2.0 * rate  # a friction that the model lacks
    return model, Trial(
        np.array([*states, x]), np.array(inputs), dt, model.state_names, model.input_names
    )


@pytest.mark.parametrize("plant", SWINGS)
@pytest.mark.parametrize("strong", [0.1, 0.3, 1.0])
def test_an_input_that_acts_late_is_never_said_to_act_the_other_way_round(plant, strong):
    """Its feedback swings: a delay turns the harmonics round, and a whirling arm ends anywhere."""
    runs = itertools.product((0.03, 0.06, 0.1, 0.15, 0.25), range(4), (0.02, 0.05), (1.2, 3.0))
    for late, seed, dt, seconds in runs:
        model, trial = swinging(plant, late, seed, strong, dt, seconds)
        acts = how_inputs_act(model, trial, range(model.n))
        assert min(one.sign for one in acts) >= 0, (late, seed, dt, seconds, acts)


@pytest.mark.parametrize("drag", [0.7, 0.9])
def test_what_acts_by_more_than_a_reversed_motor_could_is_not_reversed(drag):
    """A fan is driven in proportion to a drag that the model lacks, and would explain it."""
    sled = Model(
        {"x": "m", "v": "m/s"},
        {"motor": "1", "fan": "1"},
        derivative=lambda s, a, p: {"x": s.v, "v": 8.0 * (a.motor + a.fan)},
    )
    rng, v, states, inputs = np.random.default_rng(1), 0.0, [[0.0, 0.0]], []
    for k in range(600):
        inputs.append([np.sin(0.05 * k) + 0.6 * np.sin(0.13 * k), 0.02 * v * abs(v)])
        rate = 8.0 * sum(inputs[-1]) - drag * v * abs(v)
        states.append([states[-1][0] + 0.02 * v, v := v + 0.02 * rate])
    noisy = np.array(states) + [1e-4, 1e-3] * rng.standard_normal((601, 2))
    trial = Trial(noisy, np.array(inputs), 0.02, sled.state_names, sled.input_names)
    motor, fan = how_inputs_act(sled, trial, range(2))
    assert motor.sign == 1 and fan.sign == 0 and not fan.share > -2.5
