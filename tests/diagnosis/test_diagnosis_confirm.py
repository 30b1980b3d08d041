"""What held-out trials confirm: which noise, which hypothesis."""

import numpy as np
import pytest

from grounded import Model, Param, Trial
from grounded.diagnosis import held_out
from grounded.diagnosis.attribution import attribute
from grounded.diagnosis.data import prepare
from grounded.diagnosis.noise import Structure
from grounded.effects import Library

DT = 0.02
FRICTION, BIAS, WAVE = 0.4, -0.08, 0.05


def pushed(x, u, wave):
    return np.array([x[1], u - FRICTION * x[1] + BIAS + wave * np.sin(60 * x[0])])


def axis(wave, trials=2, steps=500, seed=0):
    """An axis with friction and a bias, and a force that depends on the place; its crude model."""
    model = Model(
        states={"x": "m", "v": "m/s"},
        inputs={"u": "m/s^2"},
        params={"k": Param(1.0, "1", std=0.3)},
        roles={"position": ("x",), "speed": "v"},
        derivative=lambda s, a, p: {"x": s.v, "v": p.k * a.u},
        name="axis",
    )
    rng, found = np.random.default_rng(seed), []
    for _ in range(trials):
        aim = 0.2 * np.sign(np.sin(2 * np.pi * np.arange(steps) * DT / rng.uniform(2, 3)))
        x, states, inputs = np.zeros(2), [np.zeros(2)], []
        for speed in aim:
            u = 4.0 * (speed - x[1])
            inputs.append(u)
            for _ in range(4):  # midpoints: what is left of the step is far below the noise
                at = x + DT / 8 * pushed(x, u, wave)
                x = x + DT / 4 * pushed(at, u, wave)
            states.append(x)
        y = np.array(states) + np.array([1e-5, 5e-4]) * rng.standard_normal((steps + 1, 2))
        u = np.array(inputs)[:, None]
        found.append(Trial(y, u, DT, ("x", "v"), ("u",), start_inputs=u[0]))
    return model, found


@pytest.fixture(scope="module")
def wavy():
    model, trials = axis(WAVE)
    data = prepare(model, trials, np.zeros(1))
    return attribute(data, Library().candidates(model, data.scales))


def test_what_predicts_down_to_the_noise_keeps_its_noise():
    model, trials = axis(0.0)
    data = prepare(model, trials, np.zeros(1))
    search, best = attribute(data, Library().candidates(model, data.scales))
    assert best.hypothesis.effects
    kept, same = held_out.noise_confirmed(search, best, 3, 1.0)
    assert kept is search and same is best


def test_another_noise_is_confirmed_where_the_likeliest_predicts_badly(wavy, monkeypatch):
    search, best = wavy
    named = {(f.noise.structure, f.hypothesis.spread) for f in search.fits.values()}
    assert len(named) > 2 and best.hypothesis.effects
    white = (Structure(), 0.0)
    other = next(k for k in named if k != (best.noise.structure, best.hypothesis.spread))
    wanted = white if (best.noise.structure, best.hypothesis.spread) != white else other

    def gaps(predictor, fits, where):
        keys = [(f.noise.structure, f.hypothesis.spread) for f in fits]
        return [1.1 if key == wanted else 3.0 for key in keys]

    monkeypatch.setattr(held_out, "gaps_of", gaps)
    found, chosen = held_out.noise_confirmed(search, best, 3, 1.0)
    assert (chosen.noise.structure, chosen.hypothesis.spread) == wanted
    assert chosen.hypothesis.effects
    assert {(s, w) for s, w, names in found.fits if names} == {wanted}
    assert found.score(chosen) > found.score(found.best_null()) + held_out.CLAIM

    monkeypatch.setattr(held_out, "gaps_of", lambda p, fits, w: [1.4 for _ in fits])
    assert held_out.noise_confirmed(search, best, 3, 1.0) == (search, best)  # not much better


def test_one_trial_alone_confirms_nothing():
    model, trials = axis(WAVE, trials=1)
    data = prepare(model, trials, np.zeros(1))
    search, best = attribute(data, Library().candidates(model, data.scales))
    assert held_out.noise_confirmed(search, best, 3, 1.0) == (search, best)


def test_in_a_misfit_an_effect_that_predicts_no_better_is_dropped(wavy, monkeypatch):
    search, best = wavy
    names = set(best.hypothesis.names)
    assert len(names) >= 2

    def judged(worst, without, bare=100.0):
        def gaps(predictor, fits, where):
            return [without if f.hypothesis.names else bare for f in fits]

        monkeypatch.setattr(held_out, "gaps_of", gaps)
        gap = type("Gap", (), {"gap_before": bare, "gap_after": worst})
        monkeypatch.setattr(held_out, "shrinkage", lambda *a: gap)
        return held_out.confirmed(search, best, 1.0)

    assert judged(1.2, 1.2) is best  # predicts down to the noise: the evidence decides
    assert judged(5.0, 9.0) is best  # each of them is worth naming
    fewer = judged(5.0, 5.0)
    assert len(fewer.hypothesis.names) == 1 and set(fewer.hypothesis.names) < names
    assert not judged(5.0, 5.0, bare=6.0).hypothesis.names  # nor is one that changes little
    assert judged(1.0, 3.0) is best
    assert len(judged(1.0, 3.0, bare=1000.0).hypothesis.names) == 1  # 0.3 % of the gap
    assert judged(1.0, 6.0, bare=1000.0) is best
