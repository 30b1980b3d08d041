"""What is claimed: the rule on made-up options, what held-out trials confirm, what is noise."""

from copy import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from grounded import Model, Param
from grounded.diagnosis.hypotheses.attribution import attribute
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.parts import Unconfirmed
from grounded.diagnosis.validation import measured
from grounded.diagnosis.validation.choose import Comparison, Errors, Option, Rule
from grounded.diagnosis.validation.claims import Claims
from grounded.diagnosis.validation.decide import Decision, decide
from grounded.diagnosis.validation.limits import limits
from grounded.diagnosis.validation.measured import Measured
from grounded.diagnosis.validation.ruler import Ruler
from grounded.diagnosis.writer import unconfirmed
from grounded.effects import Library
from stepped import levels, library, logged, stepped

TRIALS = 6
COMPARE = Comparison([0], np.full((2, 1), 1e-6), np.arange(TRIALS))
NATS = {}  # evidence by option


def option(causes, nats, rms, order=0, scatter=0.0, sites=1):
    """A set of causes with an rms error, of each trial or differing by `scatter` of it."""
    apart = 1 + scatter * np.cos(np.arange(TRIALS) * 2.5)
    total = np.tile((np.array(rms) * apart) ** 2, (2, 1))[..., None]
    errors = Errors(total, np.ones_like(total))
    made = Option(frozenset(causes.split()), errors, (order, sites))
    NATS[made] = nats
    return made


def chosen(*options, held_out=True):
    known = {one.causes: one for one in options}

    def less(one, cause):
        return known.get(one.causes - {cause})

    def nats(before, after):
        return NATS[after] - NATS[before]

    return Rule(options, COMPARE, nats, less, held_out=held_out).choose()


NONE = option("", 0.0, 1.0)
DRAG, BIAS = option("drag", 80.0, 0.3), option("bias", 30.0, 0.8)


@pytest.mark.parametrize(
    ("options", "causes"),
    [
        ([NONE], ""),
        ([NONE, DRAG], "drag"),
        ([NONE, option("drag", 2.0, 0.3)], ""),  # predicts well by chance
        ([NONE, option("drag", 80.0, 1.0)], ""),  # likely, and of no use
        ([NONE, option("drag", 80.0, [0.1, *[1.1] * 5])], ""),  # one trial gains, others lose
        ([NONE, option("drag", 80.0, 0.3), option("lag", 90.0, 0.28)], "lag"),  # and likelier
        ([NONE, option("drag", 80.0, 0.3), option("lag", 70.0, 0.28)], "drag"),  # a little better
        ([NONE, DRAG, BIAS, option("bias drag", 110.0, 0.1)], "bias drag"),
        ([NONE, DRAG, BIAS, option("bias drag", 81.0, 0.1)], "drag"),  # one is not needed
        ([NONE, DRAG, BIAS, option("bias drag", 110.0, 0.299)], "drag"),  # as good without
        ([NONE, DRAG, option("bias drag", 110.0, 0.1)], "drag"),  # the rest was never fitted
        ([NONE, DRAG, option("lag", 85.0, 0.301)], "lag"),  # as small and as good: the likelier
        ([NONE, DRAG, option("lag", 85.0, 0.5)], "drag"),  # likelier, and predicts worse
        # nothing is named that predicts worse than the calibrated model
        ([NONE, DRAG, option("calibration", 70.0, 0.2)], "calibration"),
        (
            [NONE, DRAG, option("calibration", 70.0, 0.2), option("calibration drag", 82.0, 0.15)],
            "calibration drag",
        ),
        ([NONE, DRAG, option("calibration", 90.0, 0.2)], "calibration"),
        ([NONE, option("drag", 80.0, 0.3, order=1), option("mass", 78.0, 0.3)], "mass"),
        ([NONE, option("wave", 80.0, 0.3, order=2), option("drag", 78.0, 0.3, order=1)], "drag"),
        ([NONE, option("both", 80.0, 0.3, sites=2), option("left", 78.0, 0.3)], "left"),
        # a smaller error is not sure, but the set is likelier and no larger
        ([NONE, option("drag", 80.0, 0.3), option("lag", 90.0, 0.299)], "lag"),
        ([NONE, option("wave", 90.0, 0.3, order=2), option("drag", 78.0, 0.3, order=1)], "wave"),
    ],
)
def test_the_smallest_supported_set_that_predicts_as_well_is_chosen(options, causes):
    assert chosen(*options).chosen.causes == set(causes.split())


def test_what_the_reference_has_more_is_told():
    whole = option("bias drag", 110.0, 0.1)
    found = chosen(NONE, DRAG, BIAS, whole)
    assert found.reference is whole and found.lost == 0.0
    scattered = option("bias drag", 110.0, 0.29, scatter=0.2)
    found = chosen(NONE, DRAG, BIAS, scattered)
    assert found.chosen is DRAG and found.lost <= max(found.standard_error, 0.05)


def test_without_anything_held_out_evidence_decides():
    found = chosen(NONE, option("drag", 80.0, 2.0), held_out=False)
    assert found.chosen.causes == {"drag"}


def test_a_gain_of_one_channel_is_not_lost_among_the_others():
    compare = Comparison(range(12), np.full((2, 12), 1e-6), np.arange(TRIALS))
    noise = np.random.default_rng(0).uniform(0.7, 1.4, (2, TRIALS, 12))
    before = Errors(np.ones_like(noise), np.ones_like(noise))
    after = noise.copy()
    after[..., 3] = 0.2
    assert compare(before, Errors(after, before.count)).pays
    assert not compare(before, Errors(np.ones_like(noise), before.count)).pays


FRICTION, PUSH, WAVE = 0.4, -0.08, 0.05
DT = 0.02


def pushed(x, u):
    return np.array([x[1], u[0] - FRICTION * x[1] + PUSH + WAVE * np.sin(60 * x[0])])


def axis(trials=2, steps=500):
    """An axis with friction and a bias, and a force that depends on the place; its crude model."""
    model = Model(
        states={"x": "m", "v": "m/s"},
        inputs={"u": "m/s^2"},
        params={"k": Param(1.0, "1", std=0.3)},
        roles={"position": ("x",), "speed": "v"},
        derivative=lambda s, a, p: {"x": s.v, "v": p.k * a.u},
        name="axis",
    )
    rng, found = np.random.default_rng(0), []
    for _ in range(trials):
        aim = 0.2 * np.sign(np.sin(2 * np.pi * np.arange(steps) * DT / rng.uniform(2, 3)))
        x, inputs = np.zeros((1, 2)), []
        for speed in aim:
            inputs.append([4.0 * (speed - x[-1, 1])])
            x = np.r_[x, stepped(pushed, [inputs[-1]], DT, x[-1], fine=4)[1:]]
        found.append(logged(model, x, inputs, DT, [1e-5, 5e-4], rng, start_inputs=inputs[0]))
    return model, found


@pytest.fixture(scope="module")
def wavy():
    model, trials = axis()
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
    worth = [one.share for one in Measured(decision, ruler, axis()[1], 0).credits]
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


@pytest.fixture(scope="module")
def rare():
    """Five runs with friction; half a second of the fourth is beyond the drive's limit."""
    model = Model(
        states={"x": "m", "v": "m/s"},
        inputs={"u": "m/s^2"},
        derivative=lambda s, a, p: {"x": s.v, "v": 1.0 * a.u},
        roles={"position": ("x",), "speed": "v"},
        name="sled",
    )

    def rates(x, u):
        return np.array([x[1], np.clip(u[0], -1.5, 1.5) - 0.5 * x[1]])

    rng, trials = np.random.default_rng(0), []
    for k in range(5):
        u = levels(rng, 20, 10)
        if k == 3:
            u[80:90] = 2.2
        x = stepped(rates, u, 0.05, np.zeros(2), fine=2)
        trials.append(logged(model, x, u, 0.05, 2e-3, rng, start_inputs=u[0], id=f"t{k}"))
    data = prepare(model, trials, np.zeros(1))
    few = "viscous_friction saturation coulomb_friction quadratic_drag offset input_gain"
    some = library(*few.split(), "slew_limit", "delay")
    return attribute(data, some.candidates(model, data.scales), max_effects=2)


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


SCATTER = np.array([[0.01, 0.005], [0.016, 0.0168], [np.nan, np.nan]])  # x, u at two horizons
CARRIED = np.array([[0.02, 0.004], [0.019, 0.0058], [np.nan, np.nan]])


def measuring(left):
    """Two runs of one candidate, and what is left in some states."""
    runs = [SimpleNamespace(candidate="c0004")] * 2
    errors = SimpleNamespace(rms=np.full((3, 2), 0.026))
    ruler = SimpleNamespace(
        steps=(1, 10),
        shown=[0, 1],
        measured=[(None, errors)],
        scatter=lambda fit, repeats: (SCATTER.copy(), np.array([0.3, 0.35, 1.0])),
    )
    return SimpleNamespace(
        exact=False,
        is_white=False,
        first=2,
        trials=runs,
        data=SimpleNamespace(model=SimpleNamespace(state_names=("x", "u"))),
        best=None,
        search=None,
        left=[SimpleNamespace(channel=name) for name in left],
        flexible={},
        units={"x": "m", "u": "m/s"},
        ruler=ruler,
        carried=CARRIED,
        sensors=lambda: np.zeros(2),
    )


@pytest.mark.parametrize("left", [(), ("u",), ("x", "u")])
def test_the_smaller_bound_is_the_noise_of_a_state_with_a_gap(monkeypatch, left):
    """Repeats that begin apart scatter by what the model misses in each as well."""
    monkeypatch.setattr(measured, "repeated", lambda *_: [[0, 1]])
    monkeypatch.setattr(measured, "carried", lambda *_: CARRIED.copy())
    monkeypatch.setattr(measured, "plain", lambda *_: None)
    found = measuring(left)
    floor, source = Measured.noise_floor(found)
    assert source == "repeats"
    assert floor[1].tolist() == [0.016, 0.0058 if left else 0.0168]
    sure = found.unsure[1] == 0.0  # how few repeats there are is no reason to doubt the other bound
    assert sure.tolist() == ([False, True] if left else [False])
