"""Single steps of trials that were left out: what they bear out where white noise is left."""

from dataclasses import replace

import numpy as np
import pytest

from grounded import Model, Param, Trial
from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.likelihood.refine import refine
from grounded.diagnosis.validation import decide
from grounded.diagnosis.validation.gain import Gain
from grounded.diagnosis.validation.ruler import folds
from grounded.diagnosis.validation.single_steps import borne_out, left_out
from grounded.effects import Library
from grounded.filter.tempering import Tempering

DT, TRIALS = 0.05, 5
FRICTION, LIMIT = "viscous_friction:v", "saturation:u"


def sled():
    """Five runs with friction; half a second of the fourth is beyond the drive's limit."""
    model = Model(
        states={"x": "m", "v": "m/s"},
        inputs={"u": "m/s^2"},
        params={"k": Param(1.0, "1", std=0.3)},
        derivative=lambda s, a, p: {"x": s.v, "v": p.k * a.u},
        roles={"position": ("x",), "speed": "v"},
        name="sled",
    )
    rng, found = np.random.default_rng(0), []
    for k in range(TRIALS):
        u = np.repeat(rng.uniform(-1, 1, 12), 10)
        u[80:90] = 2.2 if k == 3 else u[80:90]
        x, states = np.zeros(2), [np.zeros(2)]
        for value in u:
            for _ in range(10):
                x = x + DT / 10 * np.array([x[1], np.clip(value, -1.5, 1.5) - 0.5 * x[1]])
            states.append(x)
        y = np.array(states) + 2e-3 * rng.standard_normal((len(u) + 1, 2))
        found.append(Trial(y, u[:, None], DT, ("x", "v"), ("u",), start_inputs=u[:1], id=f"t{k}"))
    return model, found


@pytest.fixture(scope="module")
def search():
    model, trials = sled()
    data = prepare(model, trials, np.zeros(1))
    named = {e.name: e for e in Library().candidates(model, data.scales)}
    offered = [named[n] for n in (FRICTION, LIMIT, "input_gain:u", "parameter:k")]
    search = HypothesisSearch(data, offered)
    start = search.fresh(Hypothesis())
    friction, limit, gain, k = (
        Hypothesis().plus(effect, values)
        for effect, values in zip(
            offered, ({"k": 0.4}, {"c": 1.6}, {"g": 0.1}, {"d": 0.1}), strict=True
        )
    )
    both = friction.plus(named[LIMIT], {"c": 1.6})
    hypotheses = [Hypothesis(), friction, limit, both, gain, k]
    search.refined([(h, *start[1:]) for h in hypotheses], 25)
    return search


def fit_of(search, *names):
    wanted = tuple(sorted(names))
    return next(f for (_, w, found), f in search.fits.items() if found == wanted and not w)


def test_what_one_trial_shows_the_others_do_not_claim(search):
    bare, both, rubs = fit_of(search), fit_of(search, FRICTION, LIMIT), fit_of(search, FRICTION)
    rest = fit_of(search, LIMIT)
    friction = left_out(search.predictor, rest, both)
    assert friction.min() > 100 and friction.max() < 2 * friction.min()
    limit = left_out(search.predictor, rubs, both)
    assert abs(limit[3]) < 1 and np.delete(limit, 3).min() > 1000
    assert borne_out(search, rest, both) and borne_out(search, bare, rubs)
    assert not borne_out(search, rubs, both)


def test_what_the_others_say_is_their_own_likelihood(search):
    """Against fits of the other trials by themselves, under the same noise."""
    model, trials = sled()
    both, rest = fit_of(search, FRICTION, LIMIT), fit_of(search, LIMIT)
    fewer = prepare(model, [t for t in trials if t.id != "t1"], np.zeros(1))
    others = np.flatnonzero(folds(search.data) != 1)
    starts = [(fit.hypothesis, both.noise, fit.track[:, others]) for fit in (rest, both)]
    less, own = refine(Predictor(fewer), starts, iterations=10, fixed_noise=True)
    found = left_out(search.predictor, rest, both)[1]
    assert found == pytest.approx(own.loglik - less.loglik, rel=0.02)


class Coarse:
    """A ruler that sees nothing clearly: `mean` scatters are gained, and as many in pieces."""

    held_out = True

    def __init__(self, mean, largest=0.05):
        self.mean, self.largest = mean, largest

    def gain(self, before, after):
        part = np.full(TRIALS, 0.01 * self.mean if self.mean else 0.01)
        channel = np.array([0.02 * self.mean]), np.array([0.02])
        return Gain(0.02 * self.mean, 0.02, self.largest, *channel, part, np.arange(TRIALS))


def test_what_steps_of_several_trials_bear_out_need_not_stand_out_a_second_ahead(
    search, monkeypatch
):
    rest, both, rubs = (fit_of(search, *n) for n in ((LIMIT,), (FRICTION, LIMIT), (FRICTION,)))
    bare = fit_of(search)

    def pays(before, after, ruler, white=True):
        return decide._pays(search, ruler, before, after, white)

    assert pays(bare, rubs, Coarse(0.01)) and pays(rest, both, Coarse(0.01))
    assert not pays(rubs, both, Coarse(0.01))  # one trial's
    assert not pays(bare, rubs, Coarse(0.01), white=False)
    assert not pays(bare, rubs, Coarse(-0.01))  # worse
    assert not pays(bare, rubs, Coarse(0.01, largest=0.001))  # nothing that matters
    monkeypatch.setattr(search, "tempering", Tempering(1e-6))
    assert not pays(bare, rubs, Coarse(0.01))


def test_a_rival_under_the_same_noise_does_not_overrule_what_steps_bear_out(search):
    rest, both, rubs = (fit_of(search, *n) for n in ((LIMIT,), (FRICTION, LIMIT), (FRICTION,)))
    assert decide._beyond_doubt(search, both, rest)
    assert not decide._beyond_doubt(search, both, rubs)
    free = replace(rest, hypothesis=replace(rest.hypothesis, spread=0.1))
    assert not decide._beyond_doubt(search, both, free)


def test_what_ties_with_a_parameter_is_named_as_that(search):
    gain, own = fit_of(search, "input_gain:u"), fit_of(search, "parameter:k")
    assert abs(search.score(gain) - search.score(own)) < 3
    assert decide._own_numbers(search, gain, Coarse(0.0)).hypothesis.names == ("parameter:k",)
    likelier = replace(gain, evidence=gain.evidence + 10.0)
    assert decide._own_numbers(search, likelier, Coarse(0.0)) is likelier
    better = Coarse(3.0, largest=0.1)
    assert decide._own_numbers(search, gain, better) is gain
    rubs = fit_of(search, FRICTION)
    assert decide._own_numbers(search, rubs, Coarse(0.0)) is rubs
