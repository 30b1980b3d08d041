"""Constants of large effects are set by the data: over which speed a dry friction builds up."""

import numpy as np
import pytest

from grounded import Trial
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
