"""What held-out trials confirm: which noise, which hypothesis."""

from copy import copy
from dataclasses import replace

import numpy as np
import pytest

from grounded import Model, Param, Trial
from grounded.diagnosis.hypotheses.attribution import attribute
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.parts import Unconfirmed
from grounded.diagnosis.validation.claims import Claims
from grounded.diagnosis.validation.decide import Decision, decide
from grounded.diagnosis.validation.limits import limits
from grounded.diagnosis.validation.measured import Measured
from grounded.diagnosis.validation.ruler import Ruler
from grounded.diagnosis.writer import unconfirmed
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


@pytest.fixture(scope="module")
def ruler(wavy):
    return Ruler(wavy[0].predictor)


def test_the_ruler_measures_what_open_loop_predictions_miss(wavy, ruler):
    """Against the model stepped by hand from the same filtered states."""
    search, _ = wavy
    crude, data, model = search.exact_null(), search.data, search.data.model
    (at, run), k = ruler.starts, ruler.steps.index(25)
    total, count = np.zeros(2), 0
    for t, b in zip(at, run, strict=True):
        trial = data.trial_of[b]
        first = data.step_at[b, 0] - 500 * trial + t
        if first + 25 > 500:
            continue
        x = crude.states[t, b]
        for u in data.commands[trial, first : first + 25]:
            x = model.system.step(x[None], u[None], model.values, DT)[0]
        total += (data.states[501 * trial + first + 25] - x) ** 2
        count += 1
    np.testing.assert_allclose(ruler.errors(crude).rms[k], np.sqrt(total / count), rtol=1e-9)
    assert ruler.steps == (1, 5, 25, 50) and ruler.held_out


def test_what_predicts_better_is_claimed_with_its_worth(wavy, ruler):
    search, _ = wavy
    decision = decide(search, ruler)
    assert decision.causes and set(decision.without) == set(decision.causes)
    assert ruler.gain(decision.crude, decision.fit).mean > 1
    for less in decision.without.values():
        assert ruler.gain(less, decision.fit).pays
    worth = [one.share for one in Measured(decision, ruler, axis(WAVE)[1], 0).credits]
    assert max(worth) > 0.2 and sum(worth) <= 1 + 1e-9


def test_what_is_as_likely_with_free_parameters_ties(wavy, ruler):
    search = copy(wavy[0])
    one, other = (f for f in search.of_size(1)[:2])
    plain = replace(one, hypothesis=replace(one.hypothesis, shift=None, spread=0.0))
    free = replace(other.hypothesis, spread=0.1, shift=np.zeros(1))
    structure, name = plain.noise.structure, other.hypothesis.names[0]
    bare = {k: f for k, f in search.fits.items() if not k[2]}

    def rivals(nats, beside=None):
        tied = replace(other, hypothesis=free)
        search.fits = bare | {(structure, 0.0, plain.hypothesis.names): plain}
        off = search.score(plain) + nats - search.score(tied)
        tied = replace(tied, evidence=tied.evidence + off / search.tempering.factor)
        search.fits[structure, 0.1, (name,)] = tied
        if beside is not None:
            h = plain.hypothesis.plus(other.hypothesis.effects[0], other.hypothesis.values[0])
            own = plain.evidence + beside / search.tempering.factor
            both = replace(plain, hypothesis=h, evidence=own)
            search.fits[structure, 0.0, tuple(sorted(h.names))] = both
        decision = Decision(search, plain, search.exact_null(), {}, {}, None, (), (), {})
        claims = Claims(decision, {plain.hypothesis.names[0]: 1.0}, limits(search.data), ruler)
        return [found for found, _ in claims.rivals(plain.hypothesis.names[0])]

    assert rivals(1.0) == [name]
    assert not rivals(-4.0) and not rivals(4.0)
    worth = search.score(plain) - max(map(search.score, bare.values()))
    assert rivals(1.0, beside=0.2 * worth) == [name]
    assert not rivals(1.0, beside=worth + 100)  # it is another cause, not another name of this one


def pushed_hard_once(seed=0):
    """Five runs with friction; half a second of the fourth is beyond the drive's limit."""
    model = Model(
        states={"x": "m", "v": "m/s"},
        inputs={"u": "m/s^2"},
        derivative=lambda s, a, p: {"x": s.v, "v": 1.0 * a.u},
        roles={"position": ("x",), "speed": "v"},
        name="sled",
    )
    rng, found = np.random.default_rng(seed), []
    for k in range(5):
        u = np.repeat(rng.uniform(-1, 1, 20), 10)
        if k == 3:
            u[80:90] = 2.2
        x, states = np.zeros(2), [np.zeros(2)]
        for value in u:
            for _ in range(10):
                x = x + 0.005 * np.array([x[1], np.clip(value, -1.5, 1.5) - 0.5 * x[1]])
            states.append(x)
        y = np.array(states) + 2e-3 * rng.standard_normal((201, 2))
        found.append(Trial(y, u[:, None], 0.05, ("x", "v"), ("u",), start_inputs=u[:1], id=f"t{k}"))
    return model, found


@pytest.fixture(scope="module")
def rare():
    model, trials = pushed_hard_once()
    data = prepare(model, trials, np.zeros(1))
    families = ("viscous_friction", "saturation", "coulomb_friction", "quadratic_drag", "offset")
    library = Library(
        tuple(map(Library().family, (*families, "input_gain", "slew_limit", "delay")))
    )
    return attribute(data, library.candidates(model, data.scales), max_effects=2)


@pytest.mark.slow
def test_what_one_trial_shows_is_told_and_is_no_cause(rare):
    """Values from the other trials, which show nothing of it, do not predict that trial."""
    search, best = rare
    assert set(best.hypothesis.names) == {"viscous_friction:v", "saturation:u"}
    measure = Ruler(search.predictor)
    decision = decide(search, measure)
    assert decision.causes == ("viscous_friction:v",)
    assert "saturation:u" in {d.name for d in decision.doubtful}
    claims = Claims(decision, {}, limits(search.data), measure)
    (one,) = unconfirmed(claims, decision.doubtful)
    assert one.effect == "saturation:u" and one.trials == ("t3",)
    assert one.evidence > 10
    assert one.params["c"].value == pytest.approx(1.5, abs=0.05)
    assert Unconfirmed.from_json(one.to_json()) == one
