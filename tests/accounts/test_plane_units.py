"""Positions in another unit, where only the commands say how far a robot moves."""

import numpy as np
import pytest
from grounded.instruments.units.plane_units import judge_positions, positions_off

from grounded import GroundedError, Model, Param, Trial
from grounded.accounts.motion import predicted
from grounded.accounts.sound_trials import sound_trials
from grounded.effects import Library, wrap

DT = 0.02


def cart(s, a, p):
    v = p.r * (a.left + a.right) / 2
    turn = p.r * (a.right - a.left) / p.track
    return {"x": v * np.cos(s.psi), "y": v * np.sin(s.psi), "psi": turn}


MODEL = Model(
    states={"x": "m", "y": "m", "psi": "rad"},
    inputs={"left": "rad/s", "right": "rad/s"},
    params={"r": Param(0.05, "m", 0.045, 0.055), "track": Param(0.28, "m", 0.24, 0.36)},
    angles=("psi",),
    derivative=cart,
)


def driven(slip=1.0, left=0.88, lag=0.08, delay=2, seed=0, steps=900):
    """A log of a robot whose wheels are weaker and later than the model's, with sensor noise."""
    rng = np.random.default_rng(seed)
    sent = np.repeat(rng.uniform(-2, 10, (steps // 30, 2)), 30, axis=0)
    s, wheel, rows = np.zeros(3), np.zeros(2), [np.zeros(3)]
    for k in range(steps):
        wheel += DT / lag * (sent[max(0, k - delay)] * [left, 1.0] - wheel)
        v, w = slip * 0.05 * wheel.mean(), 0.05 * (wheel[1] - wheel[0]) / 0.30
        s = s + DT * np.array([v * np.cos(s[2]), v * np.sin(s[2]), w])
        rows.append(s)
    x = np.array(rows) + rng.normal(0, [1e-3, 1e-3, 4e-3], (steps + 1, 3))
    return Trial(x, sent, DT, MODEL.state_names, MODEL.input_names)


def scaled(trial, *factors):
    return Trial(trial.states * factors, trial.inputs, DT, MODEL.state_names, MODEL.input_names)


@pytest.mark.parametrize("factor", [1000.0, 100.0, 0.01, 0.001])
def test_both_positions_in_another_unit_are_named_with_the_scale(factor):
    found = positions_off(MODEL, scaled(driven(), factor, factor, 1.0), range(3))
    assert found is not None and found.names == ("x", "y") and found.factor == factor
    assert f"by {1 / factor:.6g} " in found.mend and "[log.state.y]" in found.mend


def test_one_position_in_another_unit_is_named_alone():
    found = positions_off(MODEL, scaled(driven(), 1.0, 0.001, 1.0), range(3))
    assert found is not None and found.names == ("y",) and found.factor == 0.001


@pytest.mark.parametrize(
    "log",
    [
        driven(),
        driven(slip=0.4),  # on ice
        driven(slip=0.01),  # the wheels turn it, but hardly move it: the noise is larger
        driven(slip=0.0),
        driven(slip=-1.0),
        driven(left=0.3),
        driven(left=0.0),
        scaled(driven(), 0.0, 0.0, 0.0),  # it stands
        scaled(driven(), 0.001, 0.001, 0.001),  # nothing moves as the commands say
        scaled(driven(), 0.03, 0.03, 1.0),  # no unit
    ],
)
def test_real_robots_are_not(log):
    assert positions_off(MODEL, log, range(3)) is None


def test_a_diagnosis_stops_at_the_trial():
    trials = [driven(), scaled(driven(seed=1), 0.001, 0.001, 1.0)]
    judge_positions(MODEL, trials[:1])
    with pytest.raises(GroundedError, match=r"trial number 2 x and y.*by 1000"):
        sound_trials(MODEL, trials)


def rolling(s, a, p):
    """A ball on a beam that follows its servo with a lag."""
    return {
        "x": s.v,
        "v": 5 / 7 * p.g * np.sin(s.beam) - p.c * s.v,
        "beam": (a.servo - s.beam) / p.tau,
    }


BALL = Model(
    states={"x": "m", "v": "m/s", "beam": "rad"},
    inputs={"servo": "rad"},
    params={"g": Param(9.81, "m/s^2"), "tau": Param(0.05, "s", 0.01, 0.3), "c": Param(0.1, "1/s")},
    derivative=rolling,
)


def rolled(factor=1.0, speed_too=True, seed=0, steps=1500):
    """A log of a ball on a beam that is slower and not level; the speed is a late, filtered one."""
    rng = np.random.default_rng(seed)
    sent = np.repeat(rng.uniform(-0.2, 0.2, (steps // 30, 1)), 30, axis=0)
    x, v, beam, old, rows = 0.0, 0.0, 0.0, 0.0, []
    for k in range(steps + 1):
        old += DT / 0.09 * (v - old)
        rows.append([x, old, beam])
        pulled = sent[min(k, steps - 1), 0] - 0.4 * x - 0.5 * v  # by hand, so that it stays there
        sent[min(k, steps - 1), 0] = np.clip(pulled, -0.35, 0.35)
        beam += DT / 0.09 * (sent[min(k, steps - 1), 0] - beam)
        v += DT * (5 / 7 * 9.81 * np.sin(beam + 0.008) - 0.15 * v - 0.035 * np.sign(v))
        x += DT * v
    noisy = np.array(rows) + rng.normal(0, [2e-3, 8e-3, 1e-3], (steps + 1, 3))
    noisy[:, : 1 + speed_too] *= factor
    return Trial(noisy, sent, DT, BALL.state_names, BALL.input_names)


@pytest.mark.parametrize(
    ("factor", "unit"), [(1000.0, "in mm"), (100.0, "in cm"), (0.001, "in km")]
)
def test_lengths_and_speeds_in_another_unit_are_named_together(factor, unit):
    """A ball logged in mm was accelerated by 6930 m/s^2 per rad, the diagnosis said."""
    found = positions_off(BALL, rolled(factor), range(3))
    assert found is not None and found.names == ("x", "v") and found.factor == factor
    assert unit in found.described and "[log.state.v]" in found.mend
    with pytest.raises(GroundedError, match="x and v look"):
        sound_trials(BALL, [rolled(factor)])


def test_a_ball_in_metres_is_right_also_with_a_crude_model():
    assert positions_off(BALL, rolled(), range(3)) is None
    for g in (1.0, 40.0):
        crude = BALL.with_values({"g": g})
        assert positions_off(crude, rolled(), range(3)) is None


BOAT = Model(
    states={"x": "m", "y": "m", "psi": "rad", "u": "m/s", "v": "m/s", "r": "rad/s"},
    inputs={"left": "1", "right": "1"},
    params={"thrust": Param(1.1, "m/s^2", 0.3, 3.0), "c": Param(1.1, "1/s", 0.3, 3.0)},
    angles=("psi",),
    derivative=lambda s, a, p: {
        "x": s.u * np.cos(s.psi) - s.v * np.sin(s.psi),
        "y": s.u * np.sin(s.psi) + s.v * np.cos(s.psi),
        "psi": s.r,
        "u": p.thrust * (a.left + a.right) - 0.3 * s.u - 0.5 * np.abs(s.u) * s.u,
        "v": -p.c * s.v - 1.4 * np.abs(s.v) * s.v - 0.6 * s.u * s.r,
        "r": 2.0 * (a.right - a.left) - 0.8 * s.r,
    },
)


def turned(late=2, factor=1.0, steps=400, dt=0.1):
    """A log of a boat whose speed ahead is logged some steps late, with its true values unknown."""
    rng = np.random.default_rng(2)
    sent = np.repeat(rng.uniform(-1, 1, (steps // 16, 2)), 16, axis=0)
    rows = [np.zeros(6)]
    for a in sent:
        rows.append(BOAT.system.step(rows[-1][None], a[None], BOAT.values, dt)[0])
    x = np.array(rows)
    x[:, 3] = x[np.maximum(np.arange(len(x)) - late, 0), 3]
    x += rng.normal(0, [0.01, 0.01, 0.004, 0.006, 0.006, 0.004], x.shape)
    x[:, [0, 1, 3, 4]] *= factor
    return Trial(x, sent, dt, BOAT.state_names, BOAT.input_names)


@pytest.mark.parametrize("effect", ["sensor_delay", "sensor_lag"])
@pytest.mark.parametrize("factor", [1.0, 1000.0])
def test_a_speed_that_is_known_to_be_late_is_in_no_other_unit(effect, factor):
    """A boat's `sensor_delay:u` was adopted; all its runs were to be discarded as logged in cm.

    Its sway follows from the true speed behind that log, which was taken as 0.
    """
    values = {"d": 0.2} if effect == "sensor_delay" else {"tau": 0.2}
    model = wrap(Library().effect(f"{effect}:u", BOAT), values, 0.1)
    one = turned(factor=factor)
    unknown = np.full((len(one.states), model.n - 6), np.nan)
    log = Trial(
        np.hstack([one.states, unknown]), one.inputs, 0.1, model.state_names, model.input_names
    )
    found = positions_off(model, log, range(6))
    assert (found and (found.names, found.factor)) == (
        None if factor == 1 else (("x", "y", "u", "v"), 1000.0)
    )
    if factor == 1:
        start, then, logged = predicted(model, log, range(6))
        missed = 0.3 if effect == "sensor_delay" else 0.7  # of a lag, the log stands for the start
        assert np.std((then - logged)[:, 3]) < missed * np.std((logged - start)[:, 3])
