"""States that answer commands before they are sent, and what only looks so."""

from dataclasses import replace

import numpy as np
import pytest

import grounded as gr
from facts import holds
from grounded import Model, Param
from grounded.accounts.commands import answers_early, judge_clocks
from grounded.errors import GroundedError
from grounded.trial import Trial


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


def cart(mass=1.0, drag=0.2):
    return Model(
        name="cart",
        states={"x": "m", "v": "m/s"},
        inputs={"force": "N"},
        params={"mass": Param(mass, "kg", 0.1, 10.0)},
        derivative=lambda s, a, p: {"x": s.v, "v": (a.force - drag * s.v) / p.mass},
    )


def driven(model, *, early=0, seed=0, dt=0.02, steps=900, hold=15):
    """Under commands that change every 0.3 s; `early`: steps by which the states are ahead."""
    rng, x, states = np.random.default_rng(seed), np.zeros(model.n), []
    sent = np.repeat(rng.uniform(-1, 1, (steps // hold, model.m)), hold, axis=0)
    for u in sent:
        states.append(x)
        x = model.system.step(x[None], u[None], model.values, dt)[0]
    logged = np.array([*states, x])
    logged += 0.002 * np.std(logged, axis=0) * rng.normal(size=logged.shape)
    a, b = max(early, 0), max(-early, 0)
    used = steps - a - b
    states, sent = logged[a : a + used + 1], sent[b : b + used]
    return Trial(states, sent, dt, model.state_names, model.input_names, id=f"t{seed:04}")


def pole_cart(back_emf=0.0, dry=0.0, gain=2.8):
    """A motor drives a cart, a pole hangs from it."""

    def derivative(s, a, p):
        push = p.gain * a.volts - back_emf * s.v - dry * np.tanh(s.v / 0.003)
        cos, sin = np.cos(s.th), np.sin(s.th)
        v = (4 / 3 * (push + 0.03 * s.w**2 * sin) + 0.2 * 9.81 * cos * sin) / (4 / 3 - 0.2 * cos**2)
        return {"x": s.v, "v": v, "th": s.w, "w": -(9.81 * sin + v * cos) / 0.22}

    return Model(
        name="pole_cart",
        states={"x": "m", "v": "m/s", "th": "rad", "w": "rad/s"},
        inputs={"volts": "V"},
        params={"gain": Param(gain, "m/s^2/V", 1.0, 5.0)},
        derivative=derivative,
    )


def steered(path, *, back_emf=4.0, gains=(40.0, 6.0, 0.0), seconds=2.5, early=0, dt=0.02):
    """By a controller in one program with its sensors, which sends a sample of 20 ms late."""
    real, rng = pole_cart(back_emf, 1.0, 2.4), np.random.default_rng(0)
    x, was, rates = np.array([path(0.0), 0.0, 0.0, 0.0]), None, np.zeros(2)
    steps, states, sent = round(seconds / dt), [], []
    for t in dt * np.arange(steps + early + 1):
        seen = x[[0, 2]] + [2e-5, 4e-4] * rng.normal(size=2)
        rates = rates if was is None else 0.5 * rates + 0.5 * (seen - was) / dt
        was, slope = seen, (path(t + dt) - path(t - dt)) / 2 / dt
        states.append([seen[0], rates[0], seen[1], rates[1]])
        off = np.array([path(t) - seen[0], slope - rates[0], seen[1]])
        sent.append([np.dot(gains, off) + back_emf * slope / 2.4])
        for _ in range(10):
            x = real.system.step(x[None], np.array([sent[max(0, len(sent) - 2)]]), [2.4], dt / 10)[
                0
            ]
    names = real.state_names, real.input_names
    return Trial(np.array(states[early:]), np.array(sent[:steps]), dt, *names, id="t0001")


def every(model):
    return range(model.n)


REAL = craft(lag=0.15, drag=0.7, gain=0.8)


@pytest.mark.parametrize("early", [8, 23, 40])
@pytest.mark.parametrize("blind", [False, True])
def test_states_before_their_commands_are_told_by_how_much(early, blind):
    trial = driven(REAL, early=early)
    if blind:  # no sensor of the speeds
        trial = replace(trial, states=trial.states * [1, 1, np.nan, np.nan])
    found = answers_early(craft(), trial, every(craft()))
    assert found is not None and found.seconds == pytest.approx(0.02 * early, abs=0.04)
    assert found.mended < found.logged / 2 and found.state in range(2 if blind else 4)


@pytest.mark.parametrize("early", [0, 13, 25])
def test_a_controller_with_another_clock_is_told_whatever_friction_the_model_lacks(early):
    def path(t):
        return float(0.15 * np.sin(1.5 * t + 0.2 * t**2))

    found = answers_early(pole_cart(), steered(path, seconds=20.0, early=early), range(4))
    if not early:
        assert found is None
    else:
        assert found is not None and found.seconds == pytest.approx(0.02 * (early - 1), abs=0.06)


def test_a_diagnosis_stops_at_them_and_names_the_delay():
    trials = [driven(REAL, early=23 * k, seed=k) for k in range(2)]
    with pytest.raises(GroundedError) as stopped:
        gr.diagnose(craft(), trials)
    said = str(stopped.value)
    assert holds(said, "t0001", "clocks", "[log.state.x]", "[log.state.r]")
    assert "t0000" not in said and stopped.value.then.arguments == ("t0001",)
    judge_clocks(craft(), trials[:1], range(4))
