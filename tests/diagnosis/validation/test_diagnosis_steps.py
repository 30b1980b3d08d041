"""Single steps of trials that were left out: what they bear out where white noise is left."""

from copy import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from grounded import Model, Param, Trial
from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.likelihood.refine import refine
from grounded.diagnosis.validation import decide, own_numbers
from grounded.diagnosis.validation.averaged import averaged
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


CLEAR = Gain(0.2, 0.01, 0.3, np.array([0.2]), np.array([0.01]), np.full(TRIALS, 0.2))


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
    with monkeypatch.context() as one_log:
        one_log.setattr(type(search.data), "count", property(lambda data: 1))
        assert pays(bare, rubs, Coarse(-0.01))  # of its pieces: no worse than by chance
        assert not pays(bare, rubs, Coarse(-2.0))
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
    assert own_numbers.own_numbers(search, gain, Coarse(0.0)).hypothesis.names == ("parameter:k",)
    likelier = replace(gain, evidence=gain.evidence + 10.0)
    assert own_numbers.own_numbers(search, likelier, Coarse(0.0)) is likelier
    better = Coarse(3.0, largest=0.1)
    assert own_numbers.own_numbers(search, gain, better) is gain
    rubs = fit_of(search, FRICTION)
    assert own_numbers.own_numbers(search, rubs, Coarse(0.0)) is rubs


def test_a_parameter_that_is_the_effect_itself_ties_however_far_off_it_is(search, monkeypatch):
    """A drag adopted at its bound became a state that "changes 216 % faster than modelled"."""
    price = search.price
    far = lambda e, v: price(e, v) + 60.0 * (e.name == "parameter:k")  # noqa: E731
    monkeypatch.setattr(search, "price", far)
    gain, rubs = fit_of(search, "input_gain:u"), fit_of(search, FRICTION)
    assert search.score(gain) - search.score(fit_of(search, "parameter:k")) > 50
    assert own_numbers.own_numbers(search, gain, Coarse(0.0)).hypothesis.names == ("parameter:k",)
    assert own_numbers.own_numbers(search, rubs, Coarse(0.0)) is rubs
    better = Coarse(3.0, largest=0.1)
    assert own_numbers.own_numbers(search, gain, better) is gain


@pytest.fixture(scope="module")
def calibrated(search):
    """Friction and a gain that is the parameter k; friction alone with k free, as likely."""
    gain = next(e for e in search.candidates if e.name == "input_gain:u")
    rubs = fit_of(search, FRICTION)
    both = rubs.hypothesis.plus(gain, {"g": 0.05})
    free = replace(rubs.hypothesis, shift=np.zeros(1), spread=0.1)
    search.refined([(both, rubs.noise, rubs.track)], 25)
    search.refined([(free, rubs.noise, rubs.track)], 25)
    key = next(k for k in search.fits if k[1] == 0.1 and k[2] == (FRICTION,))
    fit = fit_of(search, FRICTION, "input_gain:u")
    near = replace(fit, evidence=search.fits[key].evidence)
    off = search.score(search.fits[key]) - search.score(near)  # prices differ
    return replace(near, evidence=near.evidence + off / search.tempering.factor), search.fits[key]


def more_likely(search, fit, nats):
    return replace(fit, evidence=fit.evidence + nats / search.tempering.factor)


def test_calibration_takes_the_place_of_a_further_effect_unless_that_is_beyond_doubt(
    search, calibrated
):
    fit, free = calibrated
    near, sure = (more_likely(search, fit, nats) for nats in (6.0, 10.0))
    assert own_numbers._calibrated_instead(search, near, Coarse(0.0)) is free
    assert own_numbers._calibrated_instead(search, sure, Coarse(0.0)) is sure
    assert own_numbers._calibrated_instead(search, near, Coarse(3.0, largest=0.1)) is near
    alone = fit_of(search, FRICTION)
    assert own_numbers._calibrated_instead(search, alone, Coarse(0.0)) is alone


def test_calibration_takes_the_place_of_several_effects_that_are_not_each_beyond_doubt(
    search, calibrated
):
    """A gain of both inputs and a friction stood for parameters that were 5 % off."""
    free = calibrated[1]
    limit = next(e for e in search.candidates if e.name == LIMIT)
    fit = fit_of(search, FRICTION, "input_gain:u")
    three = replace(fit, hypothesis=fit.hypothesis.plus(limit, {"c": 1.5}))
    nats = search.score(free) - search.score(three)
    near, sure = (more_likely(search, three, nats + more) for more in (14.0, 18.0))
    assert own_numbers._calibrated_instead(search, near, Coarse(0.0)) is free
    assert own_numbers._calibrated_instead(search, sure, Coarse(0.0)) is sure


def test_effects_are_also_fitted_with_parameters_that_seem_right_without_them():
    """An offset and an input that is 5 % off hid each other: neither was likely alone."""
    model, trials = sled()
    data = prepare(model, trials, np.zeros(1))
    offered = [e for e in Library().candidates(model, data.scales) if e.name == FRICTION]
    found = HypothesisSearch(data, offered)
    with np.errstate(all="ignore"):
        found.refined([found.fresh(Hypothesis())], 20)
        found.refined([found.fresh(Hypothesis().plus(offered[0], {"k": 0.4}))], 20)
        assert not found.calibrates()
        found.beside_parameters()
    assert {w for _, w, names in found.fits if names == (FRICTION,)} > {0.0}


def test_of_causes_that_can_each_be_spared_evidence_says_which(search, calibrated):
    fit, free = calibrated
    without = {"calibration": more_likely(search, fit, 20.0), FRICTION: free}
    both = [FRICTION, "calibration"]
    found = decide._least_needed(search, Coarse(0.0), without, FRICTION, both)
    assert found == "calibration"  # without it the rest is 20 nats likelier
    assert decide._least_needed(search, Coarse(3.0, 0.1), without, FRICTION, both) == FRICTION
    tied = {"calibration": more_likely(search, fit, 2.0), FRICTION: free}
    assert decide._least_needed(search, Coarse(0.0), tied, FRICTION, both) == FRICTION


def test_a_parameter_that_is_hardly_off_needs_predictions_not_single_steps(search, monkeypatch):
    bare, own = fit_of(search), fit_of(search, "parameter:k")
    monkeypatch.setattr(decide, "borne_out", lambda *_: True)
    sure = more_likely(search, own, 50.0)

    def off_by(share):  # of the 0.3 by which k is uncertain
        h = sure.hypothesis.with_theta(np.array([0.3 * share]))
        return replace(sure, hypothesis=h)

    assert decide._pays(search, Coarse(0.01), bare, off_by(0.2), True)
    assert not decide._pays(search, Coarse(0.01), bare, off_by(0.05), True)
    assert decide._pays(search, Coarse(3.0, 0.1), bare, off_by(0.05), True)


def test_a_sensor_that_is_wrong_for_certain_need_not_change_predictions(search, monkeypatch):
    monkeypatch.setattr(decide, "closes_the_gap", lambda *_: False)
    model, _ = sled()
    candidates = Library().candidates(model, search.data.scales)
    scale = next(e for e in candidates if e.name == "sensor_scale:v")
    bare, friction = fit_of(search), fit_of(search, FRICTION)
    sensed = replace(friction, hypothesis=Hypothesis().plus(scale, {"g": 0.1}))
    faint = Coarse(3.0, largest=0.05)
    base = search.score(search.best_null())
    sure = more_likely(search, sensed, 60.0 + base - search.score(sensed))
    unsure = more_likely(search, sensed, 20.0 + base - search.score(sensed))
    assert decide._seen(search, faint, bare, sure)
    assert not decide._seen(search, faint, bare, unsure)
    assert not decide._seen(search, faint, bare, more_likely(search, friction, 60.0))
    assert decide._seen(search, Coarse(3.0, largest=0.2), bare, unsure)
    monkeypatch.setattr(decide, "closes_the_gap", lambda *_: True)
    assert decide._seen(search, faint, bare, unsure)


def test_intervals_are_those_of_all_likely_fits_of_the_same_effects(search, calibrated):
    _, free = calibrated
    exact = fit_of(search, FRICTION)
    apart = float(free.hypothesis.theta[0] - exact.hypothesis.theta[0])
    sizes = {id(exact): (0.01, 0.03), id(free): (0.02, 0.05)}

    def of(fit):
        return tuple(np.array([a]) for a in sizes.get(id(fit), (0.0, 0.0)))

    def found(nats, ruler):
        both = {("", 0.0, (FRICTION,)): exact, ("", 0.1, (FRICTION,)): free}
        monkeyed = copy(search)
        monkeyed.fits = both
        monkeyed.score = lambda fit: nats if fit is free else 0.0
        return [float(a[0]) for a in averaged(monkeyed, exact, ruler, of)]

    std, half = found(0.0, Coarse(0.0))  # as likely: half and half
    assert std == pytest.approx(np.sqrt((0.01**2 + 0.02**2 + apart**2) / 2))
    assert half == pytest.approx(np.sqrt((0.03**2 + 0.05**2 + (1.96 * apart) ** 2) / 2))
    assert found(30.0, Coarse(0.0))[0] == pytest.approx(np.hypot(0.02, apart), rel=1e-6)
    assert found(-20.0, Coarse(0.0)) == [0.01, 0.03]
    assert found(30.0, Coarse(3.0, 0.1)) == [0.01, 0.03]  # refuted by predictions


def test_what_another_noise_s_claim_has_to_gain_grows_until_a_quarter_of_the_error_is_left(search):
    crude, found, rival = (fit_of(search, *n) for n in ((), (LIMIT,), (FRICTION,)))

    def overrules(more, whole, far=np.inf):
        means = {crude: whole, found: more}  # by what is compared with
        one = SimpleNamespace(gain=lambda before, _: replace(CLEAR, mean=means[before]))
        return decide._overrules(one, crude, found, rival, *decide.OVERRULES, far=far)

    assert overrules(0.13, 1.2, 1.5) and not overrules(0.11, 1.2, 1.5)
    assert overrules(0.16, 1.5, 1.5) and overrules(0.16, 4.0, 1.5) and not overrules(0.14, 4.0, 1.5)
    assert overrules(0.41, 4.0) and not overrules(0.39, 4.0)  # under the same noise
