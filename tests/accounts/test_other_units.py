"""A position in mm beside a velocity in m/s: the diagnosis had blamed a friction of 16 km/s^2."""

import numpy as np
import pytest
from grounded.accounts.sound_trials import sound_trials as preflight
from test_swapped import PLANE, SLED, driven

from grounded import Model, Param
from grounded.errors import GroundedError
from grounded.trial import Trial

BEAM = Model(
    name="ball and beam",
    states={"r": "m", "rd": "m/s", "th": "rad", "thd": "rad/s"},
    inputs={"volt": "V"},
    params={"K": Param(1.0, "rad/s/V", 0.5, 2.0)},
    derivative=lambda s, a, p: {
        "r": s.rd,
        "rd": 5 / 7 * (s.r * s.thd**2 - 9.81 * np.sin(s.th)),
        "th": s.thd,
        "thd": 20 * (p.K * a.volt + 1.5 * s.r + 2 * s.rd - 4 * s.th - s.thd),
    },
)


def scaled(trial: Trial, **by: float) -> Trial:
    """A trial with states times a factor, as they would be logged."""
    x = trial.states * [by.get(name, 1.0) for name in trial.state_names]
    names = (trial.state_names, trial.input_names)
    return Trial(x, trial.inputs, trial.dt, *names, id=trial.id)


def stopped(model: Model, trials: list[Trial]) -> GroundedError:
    with pytest.raises(GroundedError) as error:
        preflight(model, trials)
    return error.value


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "(in mm)"), (1e2, "(in cm)")])
def test_a_position_in_other_units_stops_the_diagnosis(factor, unit):
    trials = [scaled(driven(BEAM, k), r=factor) for k in range(2)]
    error = stopped(BEAM, trials)
    said = str(error)
    assert f"r looks {factor:g} times too large {unit}" in said
    assert f"[log.state.r] scale = {1 / factor:g}, or else" in said
    assert f"[log.state.rd] scale = {factor:g}" in said
    assert "th" not in said.partition("moves")[0].partition("trial")[0]
    assert error.then is not None and error.then.arguments == ("t0000", "t0001")


def test_angles_in_degrees_beside_it_change_nothing():
    turned = {"th": 180 / np.pi, "thd": 180 / np.pi}
    said = str(stopped(BEAM, [scaled(driven(BEAM), r=1e3, **turned)]))
    assert said.index("[log.state.r] scale = 0.001") < said.index("[log.state.rd]")
    assert "th looks" not in said and "stamps" not in said


def test_a_velocity_that_is_too_large_is_named_first():
    said = str(stopped(BEAM, [scaled(driven(BEAM), rd=1e3)]))
    assert said.index("rd looks 1000 times too large (in mm/s)") < said.index("r looks")


@pytest.mark.parametrize(("by", "first"), [({"x": 1e-3}, "x looks"), ({"v": 1e-3}, "v looks")])
def test_what_the_model_makes_of_the_velocity_says_which_is_off(by, first):
    """Logs have mm rather than km; but here commands tell how large the velocity must be."""
    said = str(stopped(SLED, [scaled(driven(SLED), **by)]))
    assert said.index(first) < said.index("or else") and "stamps" in said


@pytest.mark.parametrize(
    ("by", "named"), [({"v": 1e6}, "v"), ({"x": 1e-6}, "x"), ({"x": 1e6}, "x")]
)
def test_a_factor_of_a_million_is_named_with_the_one_that_it_is(by, named):
    """`v: shows 1e+08 % of the rate of x; either may be wrong`: a scale put upside down."""
    trial = scaled(driven(SLED), **by)
    said = str(stopped(SLED, [trial]))
    (factor,) = by.values()
    assert f"{named} looks 1e+06 times" in said and "or else" not in said
    assert f"[log.state.{named}] scale = {1 / factor:g}" in said
    (clause,) = units_apart(SLED, trial, range(SLED.n))
    assert clause in said
    assert not units_apart(SLED, driven(SLED), range(SLED.n))


def test_the_odd_one_among_sound_trials_is_named_alone():
    trials = [driven(BEAM, k) for k in range(3)]
    trials[1] = scaled(trials[1], rd=1e3)
    error = stopped(BEAM, trials)
    assert "t0001" in str(error) and "rd looks" in str(error) and "or else" not in str(error)
    assert error.then is not None and error.then.arguments == ("t0001",)


def test_two_positions_in_mm_are_no_stamps():
    """All that moves is a thousand times too fast: in a trial among others, and in all of them."""
    trials = [driven(PLANE, k) for k in range(3)]
    odd = scaled(trials[1], x=1e3, y=1e3)
    said = str(stopped(PLANE, [trials[0], odd, trials[2]]))
    assert "x looks" in said and "y looks" in said and "stamps" not in said
    assert "taken for milliseconds" in str(stopped(PLANE, [odd]))


def test_trials_in_the_models_units_are_let_through():
    assert not [f for f in preflight(BEAM, [driven(BEAM, 1)]).findings if f.kind == "degrees"]
