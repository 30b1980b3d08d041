"""Constants of large effects are set by the data: over which speed a dry friction builds up."""

import numpy as np
import pytest

from grounded import Model, Param, Trial
from grounded.diagnosis.diagnose import diagnose
from grounded.diagnosis.hypotheses.attribution import attribute
from grounded.diagnosis.hypotheses.explored import price
from grounded.diagnosis.likelihood.data import prepare
from grounded.effects import Library
from small_tasks import pushed_cart

DT, FRICTION, WIDTH = 0.05, 0.4, 0.15


def rate_of(x, u, friction):
    return np.array([x[1], 2.0 * u - x[1] - friction * np.tanh(x[1] / WIDTH)])


def pushed(friction, trials=4, steps=120, seed=0):
    """A cart whose friction builds up over WIDTH, and its crude model."""
    model, _ = pushed_cart(trials=1, steps=2)
    rng, found = np.random.default_rng(seed), []
    for _ in range(trials):
        t, x, states = np.arange(steps) * DT, np.zeros(2), [np.zeros(2)]
        u = 0.6 * np.sin(rng.uniform(1, 3) * t + rng.uniform(0, 6))
        for value in u:
            for _ in range(5):  # midpoints
                half = x + DT / 10 * rate_of(x, value, friction)
                x = x + DT / 5 * rate_of(half, value, friction)
            states.append(x)
        y = np.array(states) + np.array([0.002, 0.01]) * rng.standard_normal((steps + 1, 2))
        found.append(Trial(y, u[:, None], DT, ("x", "v"), ("u",), start_inputs=np.zeros(1)))
    return model, found


@pytest.mark.slow
def test_the_width_of_a_large_friction_is_found():
    model, trials = pushed(FRICTION)
    found = diagnose(model, trials)
    assert found.effects == ("coulomb_friction:v",)
    row = found.ranking[0]
    assert row.fixed["width"] == pytest.approx(WIDTH, rel=0.25)
    assert row.params["c"].value == pytest.approx(FRICTION, rel=0.05)


@pytest.mark.slow
def test_frictions_are_compared_at_the_width_that_each_needs():
    crude, trials = carts(0.02)
    found = diagnose(crude, trials)
    row = found.ranking[0]
    assert row.effect == "joint_friction:force<-v"
    assert "load_friction:force<-v" not in found.effects
    assert row.params["c"].value == pytest.approx(1.0, rel=0.15)
    assert row.fixed["width"] == pytest.approx(0.02, rel=0.5)


def carts(width, trials=2, steps=120):
    """A cart with a hanging pole that a dry friction of 1 N opposes, and its crude model."""

    def rates(s, a, p, friction):
        force = a.force - p.b * s.v - friction * np.tanh(s.v / width)
        sn, c = np.sin(s.th), np.cos(s.th)
        push = (force + 0.2 * sn * (0.4 * s.w**2 + 9.81 * c)) / (p.M + 0.2 * sn**2)
        return {"x": s.v, "th": s.w, "v": push, "w": (-push * c - 9.81 * sn) / 0.4}

    crude, true = (
        Model(
            name="cart-pole",
            states={"x": "m", "th": "rad", "v": "m/s", "w": "rad/s"},
            inputs={"force": "N"},
            params={"M": Param(1.0, "kg", 0.3, 3.0), "b": Param(0.1, "N s/m", 0.0, 2.0)},
            roles={"position": ("x",), "hanging": ("th",)},
            derivative=lambda s, a, p, friction=friction: rates(s, a, p, friction),
        )
        for friction in (0.0, 1.0)
    )
    part, found = np.clip(np.arange(steps) / 100, 0, 1), []
    aim = 0.5 * part**3 * (10 - 15 * part + 6 * part**2)  # from rest to rest, 0.5 m
    for k in range(trials):
        states, inputs = [np.zeros((1, 4))], []
        for there in aim:
            x = states[-1]
            inputs.append((15.0 + 5 * k) * (there - x[0, 0]) - 3.0 * x[0, 2])
            for _ in range(10):
                x = true.system.step(x, np.array([[inputs[-1]]]), true.values, 0.002)
            states.append(x)
        names = crude.state_names, crude.input_names
        found.append(Trial(np.concatenate(states), np.array(inputs)[:, None], 0.02, *names))
    return crude, found


@pytest.mark.slow
def test_a_constant_that_the_data_set_pays_as_a_number():
    model, trials = pushed(FRICTION)
    data = prepare(model, trials, np.zeros(1))
    search, best = attribute(data, Library().candidates(model, data.scales))
    (effect,) = best.hypothesis.effects
    values = dict(best.hypothesis.values[0])
    plain = next(e for e in Library().candidates(model, data.scales) if e.name == effect.name)
    assert plain.fixed["width"] < 0.2 * effect.fixed["width"] == 0.2 * values["width"]
    more = price(search.predictor, effect, values) - price(search.predictor, plain, values)
    assert more == pytest.approx(0.5 * np.log(data.steps))


def test_a_small_friction_keeps_its_width():
    model, trials = pushed(0.01)
    data = prepare(model, trials, np.zeros(1))
    search, _ = attribute(data, Library().candidates(model, data.scales))
    (plain,) = [e for e in search.candidates if e.name == "coulomb_friction:v"]
    fits = [f for f in search.fits.values() if "coulomb_friction:v" in f.hypothesis.names]
    assert fits
    for fit in fits:
        at = fit.hypothesis.names.index("coulomb_friction:v")
        assert fit.hypothesis.effects[at].fixed == plain.fixed
