"""Effects that are one thing, that cancel, or that remember: named, refused, told apart."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from grounded import Model, Param, Trial, diagnose
from grounded.diagnosis.causes import meaning
from grounded.diagnosis.diagnose import DiagnosisOptions
from grounded.diagnosis.hypotheses.explored import FittedHypotheses
from grounded.diagnosis.hypotheses.lookalike import lookalikes, moving, one_clock, twins
from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.parts import Estimate
from grounded.diagnosis.validation.limits import knowable
from grounded.effects import Library, memory_of, wrap
from grounded.models.pendulum import model as pendulum
from stepped import levels, library, logged, stepped

DT = 0.05


def turner(tau=0.10, gain=1.0, **known):
    """A heading rate that follows its command; `known`: of its time constant."""
    return Model(
        name="turner",
        states={"psi": "rad", "w": "rad/s"},
        inputs={"c": "rad/s"},
        params={"tau": Param(tau, "s", **known)},
        angles=("psi",),
        roles={"heading": "psi", "heading_rate": "w"},
        derivative=lambda s, a, p: {"psi": s.w, "w": (gain * a.c - s.w) / p.tau},
    )


def trials(count=4, steps=150, gain=0.88):
    """Runs from rest of one that turns 12 % less, and takes 20 % longer."""
    real, rng = turner(0.12, gain), np.random.default_rng(2)
    sent = [levels(rng, steps // 10, 10, 1.2) for _ in range(count)]
    return [logged(real, stepped(real, u, DT), u, DT, [1e-3, 4e-3], rng) for u in sent]


@pytest.mark.parametrize(
    ("one", "other", "known", "same"),
    [
        ("viscous_friction:w", "input_gain:c", {"low": 0.03, "high": 0.6}, True),
        ("input_gain:c", "viscous_friction:w", {"low": 0.03, "high": 0.6}, True),
        ("viscous_friction:w", "input_gain:c", {}, False),  # a constant does not move
        ("coulomb_friction:w", "input_gain:c", {"low": 0.03, "high": 0.6}, False),
        ("quadratic_drag:w", "viscous_friction:w", {"low": 0.03, "high": 0.6}, False),
    ],
)
def test_two_effects_are_one_thing_beside_a_parameter_that_moves(one, other, known, same):
    model = turner(**known)
    data = prepare(model, trials(2, 60))
    a, b = (Library().effect(name, model, data.scales) for name in (one, other))
    free = moving(data, Hypothesis(spread=0.3))
    assert twins(Predictor(data), a, b, free) is same
    blamed = [Library().effect("parameter:tau", model)] if known else []
    assert moving(data, Hypothesis(tuple(blamed), ({"d": 0.02},) * len(blamed))) == free
    assert moving(data, Hypothesis((a,), ({},))) == []


def test_what_a_parameter_does_alone_makes_no_two_effects_one_thing():
    model = Model(
        name="fan",
        states={"psi": "rad", "w": "rad/s"},
        inputs={"u": "V"},
        params={"K": Param(2.0, "1", 0.5, 8.0), "D": Param(1.0, "1/s", 0.2, 5.0)},
        derivative=lambda s, a, p: {"psi": s.w, "w": p.K * a.u - p.D * s.w},
    )
    made = [replace(t, state_names=("psi", "w"), input_names=("u",)) for t in trials(2, 60)]
    data = prepare(model, made)
    names = ("input_gain:u", "viscous_friction:w", "rate_gain:w")
    effects = [Library().effect(name, model, data.scales) for name in names]
    free = moving(data, Hypothesis(spread=0.3))
    for one, other in itertools.permutations(effects, 2):
        assert not twins(Predictor(data), one, other, free)


@pytest.mark.parametrize(("law", "same"), [("linear", True), ("quadratic", False)])
def test_a_gain_and_the_scale_of_a_sensor_are_one_thing_if_all_else_is_linear(law, same):
    model = Model(
        name="motor",
        states={"w": "rad/s"},
        inputs={"u": "V"},
        params={"K": Param(2.0, "rad/s^2/V", 0.5, 8.0)},
        derivative=lambda s, a, p: {"w": p.K * a.u - s.w * (np.abs(s.w) if law != "linear" else 1)},
    )
    rng = np.random.default_rng(0)
    made = [Trial(rng.normal(size=(61, 1)), rng.normal(size=(60, 1)), DT, ("w",), ("u",))]
    data = prepare(model, made)
    a, b = (Library().effect(n, model, data.scales) for n in ("parameter:K", "sensor_scale:w"))
    assert twins(Predictor(data), a, b, []) is twins(Predictor(data), b, a, [0]) is same


@pytest.fixture(scope="module")
def search():
    """The friction alone, beside the time constant."""
    data = prepare(turner(low=0.03, high=0.6), trials(2))
    names = ("viscous_friction:w", "input_gain:c", "coulomb_friction:w")
    effects = [Library().effect(name, data.model, data.scales) for name in names]
    found = HypothesisSearch(data, effects)
    with np.errstate(all="ignore"):
        null = found.nulls()
        plain = found.exact_null() if null.hypothesis.spread else null
        found.extended(plain)
        found.beside_parameters()
        friction = next(f for f in found.of_size(1) if f.hypothesis.names == names[:1])
        found.calibrated(friction)
    return found


def test_a_look_alike_is_fitted_in_the_place_of_its_effect(search):
    own = ("viscous_friction:w",)
    best = max((f for f in search.fits.values() if f.hypothesis.names == own), key=search.score)
    assert best.hypothesis.spread > 0
    with np.errstate(all="ignore"):
        found = [like for _, like in lookalikes(search, best)]
    assert "input_gain:c" in found and own[0] not in found
    h = best.hypothesis
    other = [f for k, f in search.fits.items() if k[1] > 0 and k[2] == ("input_gain:c",)]
    assert max(map(search.score, other)) > search.score(best) - 3.0 and h.names == own


@pytest.mark.slow
def test_what_is_one_thing_beside_a_parameter_is_named_together():
    families = ("viscous_friction", "input_gain", "coulomb_friction")
    few = DiagnosisOptions(library=Library(tuple(map(Library().family, families))))
    found = diagnose(turner(low=0.03, high=0.6), trials(2), few)
    pair = {"viscous_friction:w", "input_gain:c"}
    assert len(pair & set(found.effects)) == 1
    assert "tau" in found.parameters or "parameter:tau" in found.effects
    assert pair in [set(group) for group in found.indistinguishable]
    assert pair in [set(group) for group in found.equivalent]
    (one,) = [one for one in found.findings if one.code == "gap.equivalent"]
    assert {*one.about} == pair
    rows = {row.effect: row for row in found.ranking}
    assert pair <= set(rows) and sum(rows[name].claimed for name in pair) == 1


def test_an_input_that_acts_the_other_way_round_is_found_at_its_size():
    library = Library(tuple(map(Library().family, ("input_gain", "offset"))))
    found = diagnose(turner(0.12), trials(2, gain=-1.0), DiagnosisOptions(library=library))
    assert found.effects == ("input_gain:c",)
    assert found.ranking[0].params["g"].value == pytest.approx(-2.0, abs=0.02)


@pytest.fixture(scope="module")
def turned():
    model = turner(0.12, 0.88)
    data = prepare(model, trials(1, 300))
    return FittedHypotheses(data, Library().candidates(model, data.scales))


LESS = {
    "rate_gain:w": {"g": 0.498},
    "input_gain:c": {"g": -0.317},
    "viscous_friction:w": {"k": -3.9},
}


def of(known, values):
    h, by_name = Hypothesis(), {effect.name: effect for effect in known.candidates}
    for name, some in values.items():
        h = h.plus(by_name[name], some)
    return h


@pytest.mark.parametrize(
    ("change", "refused"),
    [
        ({}, True),
        ({"viscous_friction:w": {"k": 1.0}}, False),  # it adds to what the weaker input does
        ({"rate_gain:w": {"g": 0.04}, "viscous_friction:w": {"k": -0.3}}, False),  # all weaker
    ],
)
def test_three_effects_that_cancel_are_refused(turned, change, refused):
    """Half as fast again, of a weaker input, with less friction: a 3 % shorter time constant."""
    h = of(turned, LESS | change)
    assert turned.cancelling(h) == refused
    for name in LESS:  # two of them do something
        assert not turned.cancelling(h.minus(name))


@pytest.mark.parametrize("family", ["viscous_friction", "coulomb_friction", "quadratic_drag"])
def test_less_friction_than_modelled_is_said_so(turned, family):
    effect = {effect.name: effect for effect in turned.candidates}[f"{family}:w"]
    name = effect.free[0].name
    more, less = (meaning(effect, {name: Estimate(v, unit="1/s")}) for v in (3.9, -3.9))
    assert "3.9 1/s" in more and "less" not in more
    assert "3.9 1/s" in less and "less" in less and "-" not in less


AXES = Model(
    name="axes",
    states={"x": "m", "y": "m", "vx": "m/s", "vy": "m/s"},
    inputs={"F": "N", "G": "N"},
    derivative=lambda s, a, p: {"x": s.vx, "y": s.vy, "vx": a.F - s.vx, "vy": 2 * a.G - s.vy},
)


@pytest.mark.parametrize("model", [pendulum, AXES])
def test_a_delay_of_every_command_is_one_of_every_sensor(model):
    effect = Library().effect(f"delay:{'+'.join(model.input_names)}", model)
    (one,) = one_clock(model, [effect], model.state_names)
    assert one[1] == f"sensor_delay:{'+'.join(model.state_names)}"


@pytest.mark.slow
def test_a_diagnosis_that_claims_the_one_says_the_other():
    runs = []
    for seed in range(2):  # a pendulum whose commands arrive two steps late
        rng = np.random.default_rng(seed)
        u = levels(rng, 40, 6)
        x = stepped(pendulum, np.r_[np.zeros((2, 1)), u[:-2]], DT)
        runs.append(logged(pendulum, x, u, DT, [2e-3, 1e-2], rng, id=f"t{seed:04}"))
    few = library("delay", "input_gain", "viscous_friction")
    found = diagnose(pendulum, runs, DiagnosisOptions(library=few))
    assert found.effects == ("delay:torque",)
    assert ("delay:torque", "sensor_delay:theta+omega") in found.equivalent
    assert "gap.equivalent" in {one.code for one in found.findings}


STEP, J, B = 0.01, 0.02, 0.02
JOINT = Model(
    states={"q": "rad", "w": "rad/s"},
    inputs={"tau": "N m"},
    params={"J": Param(J, "kg m^2", 0.01, 0.04), "b": Param(B, "N m s/rad", 0.0, 0.1)},
    derivative=lambda s, a, p: {"q": s.w, "w": (a.tau - p.b * s.w) / p.J},
)
DAHL, ELASTIC, LOAD = (
    f"{family}:tau<-w" for family in ("dahl_friction", "elastic_joint", "elastic_load")
)


def bristle(x, u, c=0.15, way=0.02):
    _, w, y = x
    return np.array([w, (u - B * w - c * y) / J, (w - abs(w) * y) / way])


def spring(x, u, part, stiff, driven, damping=0.02):
    """q, w of the side that is shown, and twist z with its rate; `part` of J is hidden."""
    _, w, z, r = x
    hidden, pull = part * J, stiff * z + damping * r
    rate = (u - B * w - (driven * u - pull)) / (J - hidden)
    return np.array([w, rate, r, (driven * u - pull) / hidden - rate])


def dry(x, u, c=0.1):
    return np.array([x[1], (u - B * x[1] - c * np.tanh(x[1] / 0.005)) / J])


def late(x, u, lag=0.03):
    return np.array([x[1], (x[2] - B * x[1]) / J, (u - x[2]) / lag])


def wound(x, u):
    return np.array([x[1], (u - B * x[1] - 0.5 * x[0]) / J])


def motor_behind(x, u):
    return spring(x, u, 0.5, 13.0, 1.0)


def load_behind(x, u):
    return spring(x, u, 0.4, 8.0, 0.0)


def logs(rates, count, seed, steps=250):
    """Runs under multisines, with process noise and sensor noise."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(4):
        t = STEP * np.arange(steps)
        waves = zip((0.25, 0.2, 0.15), rng.uniform(0.5, 6, 3), rng.uniform(0, 6, 3), strict=True)
        u = sum(a * np.sin(2 * np.pi * f * t + at) for a, f, at in waves)
        disturbed = 1e-3 * np.eye(count)[1]
        x = stepped(
            lambda x, u: rates(x, u[0]), u, STEP, np.zeros(count), disturbed=disturbed, rng=rng
        )
        found.append(logged(JOINT, x[:, :2], u, STEP, [2e-4, 5e-3], rng))
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rates", "count", "name", "known"),
    [
        (bristle, 3, DAHL, {"c": 0.15, "x": 0.02}),
        (motor_behind, 4, ELASTIC, {"f": np.sqrt(13.0 * J / (0.01 * 0.01)) / (2 * np.pi)}),
        (load_behind, 4, LOAD, {"J": 0.4 * J, "f": np.sqrt(8.0 / (0.4 * J)) / (2 * np.pi)}),
    ],
    ids=["dahl", "motor", "load"],
)
def test_a_withheld_memory_is_named_first_with_its_values(rates, count, name, known):
    found = diagnose(JOINT, logs(rates, count, 0))
    first = found.ranking[0]
    assert first.effect == name and first.claimed and found.effects == (name,)
    for quantity, value in known.items():
        assert first.values[quantity] == pytest.approx(value, rel=0.02)
    ahead = next(row for row in found.prediction_error if row.horizon_s == 0.5)
    assert ahead.with_effects["w"] < 0.2 * ahead.crude["w"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rates", "count"), [(dry, 2), (late, 3), (wound, 2)], ids=["dry", "lag", "spring"]
)
def test_none_is_named_where_there_is_none(rates, count):
    found = diagnose(JOINT, logs(rates, count, 0))
    assert found.effects and not {DAHL, ELASTIC, LOAD} & {*found.effects}


def test_a_friction_that_builds_up_is_offered_only_where_the_motion_reverses():
    turning, (one, *_) = logs(dry, 2, 0), logs(dry, 2, 1)
    ahead = Trial(np.abs(one.states), np.abs(one.inputs), STEP, ("q", "w"), ("tau",))
    for trials, shown in ((turning, True), ([ahead], False)):
        data = prepare(JOINT, trials)
        offered = knowable(data, Library().candidates(JOINT, data.scales))
        assert (DAHL in {effect.name for effect in offered}) is shown


@pytest.mark.parametrize(
    ("name", "rates", "count"),
    [(DAHL, bristle, 3), (ELASTIC, motor_behind, 4), (LOAD, load_behind, 4)],
)
def test_an_adopted_memory_is_the_one_that_was_diagnosed(name, rates, count):
    (trial, *_) = logs(rates, count, 0, steps=100)
    predictor = Predictor(prepare(JOINT, [trial]))
    effect = Library().effect(name, JOINT, predictor.data.scales)
    values = {"c": 0.15, "x": 0.02, "J": 0.4 * J, "f": 5.03, "zeta": 0.04}
    values |= {"J": 0.5 * J, "f": 8.115, "zeta": 0.028} if name == ELASTIC else {}
    values = {q.name: values[q.name] for q in effect.free}
    adopted = wrap(effect, values, STEP)
    assert adopted.system.how == "compiled"
    h, x = Hypothesis().plus(effect, values), trial.states[:-1, None]
    z = predictor.widened(h, x)[:, 0]
    want = predictor.advance(h, x, predictor.inputs(h), predictor.data.time)[:, 0]
    got = adopted.system.step(z, trial.inputs, adopted.values, STEP)
    np.testing.assert_allclose(got[:, :2], want, atol=1e-9)
    # along the log the adopted model's memory goes the same way
    along = memory_of(adopted, JOINT, trial)
    assert np.abs(along[1:-1] - z[1:, 2:]).max() < 0.1 * np.abs(along).max()
    np.testing.assert_array_equal(along[0], 0.0)


@pytest.mark.parametrize(
    ("name", "rates", "values"),
    [
        (DAHL, bristle, {"c": 0.15, "x": 0.02}),
        (ELASTIC, motor_behind, {"J": 0.5 * J, "f": np.sqrt(13.0 / (0.25 * J)) / (2 * np.pi)}),
        (LOAD, load_behind, {"J": 0.4 * J, "f": np.sqrt(8.0 / (0.4 * J)) / (2 * np.pi)}),
    ],
)
def test_a_memory_moves_as_the_equations_of_motion_say(name, rates, values):
    effect = Library().effect(name, JOINT)
    stiff = values.get("f", 1.0) * 2 * np.pi * np.sqrt(0.5 if name == ELASTIC else 1.0)
    zeta = 0.02 / (2 * stiff * values.get("J", 1.0))
    model = wrap(effect, values | ({} if name == DAHL else {"zeta": zeta}), STEP)
    t = STEP * np.arange(200)
    u = 0.4 * np.sin(7 * t) + 0.3 * np.sin(23 * t)
    x = stepped(model, u, STEP)[-1]
    z = stepped(lambda x, u: rates(x, u[0]), u, STEP, np.zeros(model.n), fine=50)[-1]
    np.testing.assert_allclose(x[:2], z[:2], atol=0.01 * np.abs(z[:2]).max())
