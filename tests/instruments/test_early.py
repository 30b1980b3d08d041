"""States that answer commands before they are sent, and what only looks so."""

from dataclasses import replace

import numpy as np
import pytest

import grounded as gr
from facts import holds
from grounded import Model, Param
from grounded.errors import GroundedError
from grounded.instruments.early import answers_early, judge_clocks
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


def servo(lag):
    return Model(
        name="servo",
        states={"x": "m"},
        inputs={"u": "m"},
        derivative=lambda s, a, p: {"x": (a.u - s.x) / lag},
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


def controlled(model, gains, path, *, late=0, push=1.0, dt=0.02, steps=600):
    """A controller that follows a path on noisy states, against pushes that last for a second."""
    rng, x, states, sent, w = np.random.default_rng(1), np.zeros(2), [], [], 0.0
    for k in range(steps):
        seen = x + 0.003 * rng.normal(size=2)
        states.append(seen)
        sent.append(np.array([gains[0] * (path(k * dt) - seen[0]) - gains[1] * seen[1]]))
        w = 0.98 * w + 0.2 * push * rng.normal()
        u = sent[max(0, k - late)] + w
        x = model.system.step(x[None], u[None], model.values, dt)[0]
    names = model.state_names, model.input_names
    return Trial(np.array([*states, x]), np.array(sent), dt, *names, id="t0001")


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


@pytest.mark.parametrize("early", [0, -5, -15])
def test_a_robot_that_answers_at_once_or_late_is_not_early(early):
    for seed in range(2):
        assert answers_early(craft(), driven(REAL, early=early, seed=seed), range(4)) is None


@pytest.mark.parametrize(("crude", "real"), [(0.5, 0.05), (0.2, 0.03), (0.3, 0.1)])
def test_a_model_that_is_too_slow_is_no_clock(crude, real):
    assert answers_early(servo(crude), driven(servo(real)), range(1)) is None


@pytest.mark.parametrize("gains", [(20.0, 6.0), (100.0, 15.0), (4.0, 1.0)])
@pytest.mark.parametrize("late", [0, 3])
@pytest.mark.parametrize("push", [0.3, 3.0])
def test_a_controller_that_follows_the_states_is_not_early(gains, late, push):
    for path in (lambda t: np.sin(1.5 * t), lambda t: 0.0, lambda t: float((t // 1.5) % 2)):
        trial = controlled(cart(1.4, 0.6), gains, path, late=late, push=push)
        assert answers_early(cart(), trial, range(2)) is None


def test_a_diagnosis_stops_at_them_and_names_the_delay():
    """Four effects were claimed of a log that was put together half a second wrong."""
    trials = [driven(REAL, early=23 * k, seed=k) for k in range(2)]
    with pytest.raises(GroundedError) as stopped:
        gr.diagnose(craft(), trials)
    said = str(stopped.value)
    assert holds(said, "t0001", "clocks", "[log.state.x]", "[log.state.r]", "before thrust")
    assert "t0000" not in said and stopped.value.then.arguments == ("t0001",)
    judge_clocks(craft(), trials[:1])


def test_short_runs_gaps_and_commands_that_never_change_tell_nothing():
    trial = driven(REAL, early=23)
    assert answers_early(craft(), trial.until(20), range(4)) is None
    assert answers_early(craft(), trial.until(0), range(4)) is None
    still = replace(trial, inputs=0 * trial.inputs)
    assert answers_early(craft(), still, range(4)) is None
    states = np.array(trial.states)
    states[100:200] = np.nan
    assert answers_early(craft(), replace(trial, states=states), range(4)) is not None
