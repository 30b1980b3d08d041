"""The dry friction of a motor's joint: one cause, at its plainest, beside a gain and a lag."""

from dataclasses import replace

import numpy as np
import pytest

from grounded import Model, Param, Trial
from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.hypotheses.variations import variations, varied
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.effects import Library

FRICTION, K, TAU, DT = 0.35, 0.88, 0.06, 0.02
MOTOR = Model(
    name="motor",
    states={"q": "rad", "w": "rad/s"},
    inputs={"volt": "V"},
    params={
        "K": Param(1.0, "rad/s/V", 0.5, 2.0),
        "tau": Param(0.05, "s", 0.02, 0.15),
    },
    derivative=lambda s, a, p: {"q": s.w, "w": (p.K * a.volt - s.w) / p.tau},
)
JOINT, LOADED = "joint_friction:volt<-w", "load_friction:volt<-w"


def driven(trials=4, steps=150, soft=0.0):
    """Logs of a motor driven to and fro with stops.

    Its gear holds at rest; or its grease does not, which brakes less below `soft` [rad/s].
    """
    rng, found = np.random.default_rng(1), []
    for k in range(trials):
        t = DT * np.arange(steps)
        u = (1.0 + 0.3 * k) * np.sin((2.0 + 0.7 * k) * t) * (np.sin(1.3 * t + k) > -0.4)
        x, rows = np.zeros(2), [np.zeros(2)]
        for volt in u:
            for _ in range(20):
                w = x[1] + 1e-3 * (K * volt - x[1]) / TAU
                brake = 1e-3 * K * FRICTION / TAU
                w -= brake * np.tanh(w / soft) if soft else np.clip(w, -brake, brake)
                x = np.array([x[0] + 1e-3 * w, w])
            rows.append(x)
        noise = rng.standard_normal((steps + 1, 2)) * [5e-4, 0.01]
        found.append(Trial(np.array(rows) + noise, u[:, None], DT, ("q", "w"), ("volt",)))
    return found


def searched(trials):
    data = prepare(MOTOR, trials)
    library = Library()
    candidates = library.candidates(MOTOR, data.scales)
    joints = library.joints(MOTOR, data.scales)
    found = HypothesisSearch(data, candidates, joints=joints)
    found.nulls()
    return found


@pytest.fixture(scope="module")
def search():
    return searched(driven())


def fitted(search, *effects, start=(-0.1, 0.01)):
    """A hypothesis of effects with values, refined from a start of its own."""
    h = Hypothesis(shift=np.array(start), spread=1.0)
    for effect, values in effects:
        h = h.plus(effect, {**effect.fixed, **values})
    return search.refined([search.fresh(h)], 30)[0]


def test_a_friction_that_holds_a_joint_takes_the_place_of_one_that_does_not(search):
    """A motor that a knob turned to and fro: a time constant of 0.073 +- 0.0003 s, truly 0.070 s.

    Its friction holds it at rest, and an added rate can't.
    """
    effects = {e.name: e for e in search.candidates}
    fit = fitted(search, (effects["coulomb_friction:w"], {"c": 5.2}))
    search.fits = {key: one for key, one in search.fits.items() if key[2] != (JOINT,)}
    held = varied(search, fit)
    assert held.hypothesis.names == (JOINT,)
    assert search.score(held) > search.score(fit) + 20
    assert held.hypothesis.values[0]["c"] == pytest.approx(FRICTION, rel=0.03)


def test_two_names_of_one_friction_are_compared_with_one(search):
    effects = {e.name: e for e in search.candidates}
    h = Hypothesis().plus(effects["coulomb_friction:w"], {"c": 5.2})
    assert [one.names for one in variations(search, h)] == [(JOINT,)]
    h = h.plus(effects["stiction:w"], {"c": 5.0}).plus(effects["quadratic_drag:w"], {"k": 0.1})
    forms = {frozenset(one.names): one for one in variations(search, h)}
    plain = forms[frozenset({JOINT, "quadratic_drag:w"})]
    assert plain.values[plain.names.index(JOINT)]["c"] == pytest.approx(5.2 * 0.05, rel=0.01)


def test_a_friction_at_its_plainest_has_no_plainer_form(search):
    joint = search.joints["w"]
    both = tuple(replace(q, fixed=False) if q.name == "b" else q for q in joint.quantities)
    viscous = replace(joint, quantities=both)
    values = {**joint.fixed, "c": FRICTION, "b": 0.0}
    dearer = search.price(viscous, values) - search.price(joint, values)
    assert dearer == pytest.approx(0.5 * np.log(search.N))
    fit = fitted(search, (viscous, values), start=(-0.1, 0.01))
    fit = replace(fit, hypothesis=replace(fit.hypothesis, values=(values,)))
    plain = varied(search, fit)
    assert "b" in plain.hypothesis.effects[0].fixed
    assert not list(variations(search, plain.hypothesis))


def test_open_loop_predictions_of_an_unstable_plant_run_away():
    """Balanced by a feedback for four seconds: errors grow by exp(5 t), the log stays small."""
    crude, true = (
        Model(
            name="balanced",
            states={"x": "m", "v": "m/s"},
            inputs={"u": "m/s^2"},
            params={"k": Param(k)},
            derivative=lambda s, a, p: {"x": s.v, "v": p.k * s.x + a.u},
        )
        for k in (25.0, 27.0)
    )
    rng, trials = np.random.default_rng(0), []
    for _ in range(3):
        x, rows, inputs = np.array([[0.05, 0.0]]), [np.array([0.05, 0.0])], []
        for k in range(80):
            u = -60 * x[0, 0] - 12 * x[0, 1] + np.sin(0.2 * k) + rng.normal(0, 0.3)
            inputs.append([u])
            x = true.system.step(x, np.array([[u]]), true.values, 0.05)
            rows.append(x[0])
        y = np.array(rows) + rng.normal(0, 1e-3, (81, 2))
        trials.append(Trial(y, np.array(inputs), 0.05, ("x", "v"), ("u",)))
    library = Library(tuple(f for f in Library().families if f.name == "input_bias"))
    options = DiagnosisOptions(library=library, max_effects=1)
    rows = diagnose(crude, trials, options).prediction_error
    assert rows[-1].whole_trial and set(rows[-1].runs_away["crude"]) == {"x", "v"}
    assert rows[-1].crude["x"] > 1e3 and not rows[0].runs_away
