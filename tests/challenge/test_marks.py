"""The systems of the challenge, and what counts as a mark."""

import numpy as np
import pytest

from cli import grounded
from grounded.challenge import judge, make, of_crude, summary
from grounded.challenge.draws import draw_withheld, values_of
from grounded.challenge.mechanism import Mechanism, arm_built, cart_built
from grounded.challenge.score import Oracle, share
from grounded.challenge.systems import SYSTEMS
from grounded.effects import Library, Scales


def case_of(system, **about):
    return next(make("none", 1, 7, only=system, noise="white", **about))


@pytest.mark.parametrize("system", ["buggy", "lift"])
def test_kinked_systems_run_closed_loop_at_a_rate_of_theirs(system):
    case = case_of(system)
    assert 1 / case.dt == pytest.approx(20) or 1 / case.dt in (50, 100)
    assert len(case.trials) >= 3 and len(case.fresh) == 2
    assert all(np.isfinite(t.states).all() for t in case.trials)
    assert all((t.inputs >= case.low).all() and (t.inputs <= case.high).all() for t in case.trials)


@pytest.mark.parametrize("system", ["car", "lift", "aircraft"])
def test_every_effect_is_drawn_in_a_size_that_its_bounds_allow(system):
    model, rng = SYSTEMS[system].model, np.random.default_rng(0)
    names = (*model.state_names, *model.input_names)
    scales = Scales(dict.fromkeys(names, -1.0), dict.fromkeys(names, 1.0), dt=0.05, duration=8.0)
    visited = rng.normal(size=(9, model.n))
    for effect in Library().candidates(model, scales):
        for mechanism in (False, True):
            values = values_of(effect, scales, rng, visited, mechanism)
            assert np.isfinite([*values.values()]).all()
            assert any(values[q.name] for q in effect.free), effect.name
            assert effect.complete(values) == values


@pytest.mark.parametrize("mechanism", [False, True])
def test_what_no_family_describes_changes_inputs_or_rates(mechanism):
    model, drawn = SYSTEMS["car"].model, {}
    for seed in range(40):
        rng = np.random.default_rng(seed)
        one = draw_withheld(rng, model, np.ones(model.m), "v", 1.0, 8.0, mechanism)
        drawn[one.name] = one
        if one.joint:
            continue
        own, t = {"rng": rng, "v": 1.0}, 0.02 * np.arange(400)
        commands = np.outer(0.63 * np.sin(3 * t), np.ones(model.m))
        each = list(zip(commands, t, strict=True))
        sent = [act(u, own, k, 0.02) for act in one.actuators for u, k in each]
        rates = [rate(None, u, k, own)["v"] for rate in one.rates for u, k in each]
        assert any(rates) or not np.allclose(sent, commands)
    known = {"resonance", "dropouts", "fault", "quantised", "crosstalk"}
    assert drawn.keys() == known | ({"spring", "hung"} if mechanism else {"gusts", "hysteresis"})


def test_a_gyro_shows_a_drift_of_the_heading_from_the_first_sample():
    from grounded.challenge.truth import Truth
    from grounded.effects import Library, scales_of

    model = SYSTEMS["car"].model
    still = np.zeros((4, model.n))
    drift = Library().effect(
        "offset:psi", model, scales_of(model, still, np.zeros((4, model.m)), 0.02, 0.06)
    )
    truth, rng = Truth(model, ((drift, {"c": 0.7}),)), np.random.default_rng(0)
    run = truth.run(rng, lambda t, y: np.zeros(2), still[0], np.zeros(2), 3, 0.02)
    np.testing.assert_allclose(run.states[:, model.state_names.index("psi_rate")], 0.7, atol=1e-9)


@pytest.mark.parametrize(
    ("system", "built", "motor"), [("arm", arm_built, "tau2"), ("cart_pole", cart_built, "force")]
)
def test_the_simulator_is_the_crude_model_but_for_what_is_withheld(system, built, motor):
    pytest.importorskip("mujoco")
    model, rng = SYSTEMS[system].model, np.random.default_rng(1)
    x, u = rng.normal(size=model.n), 2 * rng.normal(size=model.m)

    def after(**part):
        kinds = {kind: part.get(kind, {}) for kind in ("friction", "armature", "lag")}
        true = dict(zip(model.param_names, model.values, strict=True)) | part.get("true", {})
        plant, at = Mechanism(built, kinds | {"true": true}).plant(0.005), x
        for _ in range(10):
            at = plant.advance(at, u)
        return at

    ours = x
    for _ in range(10):
        ours = model.system.step(ours[None], u[None], model.values, 0.005)[0]
    plain = after()
    np.testing.assert_allclose(plain, ours, atol=5e-4)
    for part in ({"friction": {motor: 2.0}}, {"armature": {motor: 2.0}}):
        assert np.abs(after(**part) - plain).max() > 0.02
    heavier = {"load": 0.5} if system == "arm" else {"m": 0.5}
    changed = model.with_values(heavier)
    ours = x
    for _ in range(10):
        ours = changed.system.step(ours[None], u[None], changed.values, 0.005)[0]
    np.testing.assert_allclose(after(true=heavier), ours, atol=5e-4)


def test_without_mujoco_its_systems_are_refused(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "mujoco", None)
    words = ["challenge", "make", tmp_path / "d", "--kind", "none", "--cases", "1", "--seed", "5"]
    alone = grounded(*words, "--systems", "mujoco")
    assert alone.code == 1 and "mujoco" in alone.err


def marks_of(truth, named, *, kind="single", param_error=0.0, known=None, **document):
    """Return the marks of names, beside true effects: a name, several with their values, or ""."""
    true = {truth: {}} if isinstance(truth, str) else truth
    label = {"effects": [{"effect": e, "params": p} for e, p in true.items() if e], "case": "x"}
    label |= {"kind": kind, "noise": "white", "system": "car", "param_error": param_error}
    row = {"whole_trial": False, "crude": {"v": 1.0}, "with_effects": {"v": 1.0}}
    found = {"verdict": {"kind": "effect", "effects": named}, "indistinguishable": []}
    found["ranking"] = [{"effect": n, "params": {}, "claimed": True} for n in named]
    found |= {"gap": {"after": 1.0}, "leftover": [], "prediction_error": [row]}
    return judge(label, found | document, known)


def test_a_value_whose_uncertainty_is_unknown_covers_nothing():
    params = {"c": {"value": 3.0, "std": None}, "x0": {"value": 1.1, "interval": [0.9, 1.3]}}
    ranking = [{"effect": "patch:a", "params": params, "claimed": True}]
    marks = marks_of({"patch:a": {"c": 2.0, "x0": 1.0}}, ["patch:a"], ranking=ranking)
    assert marks["covered"] == [True]


@pytest.mark.parametrize(
    ("after", "leftover", "misleads"), [(2.0, [], 1), (1.0, [], 0), (2.0, [{}], 0), (None, [], 0)]
)
def test_a_name_for_what_the_library_lacks_misleads_where_a_gap_is_not_told(
    after, leftover, misleads
):
    document = {"gap": {"after": after}, "leftover": leftover}
    marks = marks_of("", ["delay:a"], kind="withheld", **document)
    row = summary([marks, marks_of("", [], kind="withheld")])["withheld"]
    assert (row["misleading"]["count"], row["claimed"]["count"]) == (misleads, 1)
    assert row["leftover"]["count"] == len(leftover) and row["verdicts"]["effect"] == 2


def test_a_second_name_that_nothing_makes_is_counted():
    assert not marks_of("delay:a", ["delay:a"])["false_second"]
    assert marks_of("delay:a", ["delay:a", "stall:a"])["false_second"]
    assert not marks_of("delay:a", ["stall:a"])["false_second"]  # wrong, but no second one
    assert not marks_of("delay:a", ["delay:a", "parameter:L"], param_error=0.05)["false_second"]
    assert marks_of("delay:a", ["delay:a", "parameter:L"])["false_second"]
    assert not marks_of("parameter:L", ["parameter:L"], param_error=0.05)["false_second"]


def test_what_is_likeliest_and_not_named_is_not_first():
    ranking = [{"effect": "delay:a", "params": {}, "claimed": False}]
    marks = marks_of("delay:a", [], ranking=ranking)
    assert not (marks["first"] or marks["in_group"])


def test_beside_parameters_that_are_off_the_effect_has_to_be_first_of_the_others():
    named = ["parameter:L", "delay:a", "stall:a"]
    assert marks_of("delay:a", named, param_error=0.05)["first"]
    assert not marks_of("stall:a", named, param_error=0.05)["first"]
    assert not marks_of("delay:a", named)["first"]  # the model's parameters are right
    assert not marks_of("delay:a", ["parameter:L"], param_error=0.05)["first"]
    assert not marks_of("parameter:a1", named, param_error=0.05)["first"]


def test_a_shift_of_a_parameter_is_counted_from_the_crude_value():
    effects = [{"effect": "parameter:L", "params": {"d": 0.1}}]
    effects.append({"effect": "delay:steering", "params": {"d": 0.1}})
    label = {"effects": effects, "param_error": 0.05, "system": "car"}
    true = SYSTEMS["car"].model
    crude = true.with_values({"L": true.params["L"].value * 1.04})
    parameter, delay = of_crude(label, crude)["effects"]
    assert parameter["params"]["d"] == pytest.approx(0.1 - 0.04 * true.params["L"].value)
    assert delay == effects[1]
    assert of_crude(label | {"param_error": 0.0}, true)["effects"] == effects


def test_what_is_not_detectable_is_not_counted():
    named = {20.0: "stall:a", 9.0: "delay:a", 2.0: "delay:a"}
    known = {nats: Oracle(nats, {"delay:a": nats}) for nats in named}
    marks = [marks_of("delay:a", [name], known=known[nats]) for nats, name in named.items()]
    row = summary(marks)["single"]
    assert row["first"]["of"] == 2 and row["first"]["share"] == 0.5


def test_shares_have_the_interval_of_wilson():
    found = share([True] * 17 + [False])
    assert (found["count"], found["of"]) == (17, 18)
    assert found["interval"] == pytest.approx([0.742, 0.990], abs=1e-3)
    assert share([])["share"] is None


def test_parameters_that_the_sentence_calls_off_and_ties_count_for_both_of_a_double():
    def both(named, ties=(), off=()):
        verdict = {"kind": "several", "effects": named, "parameters": off}
        document = {"verdict": verdict, "indistinguishable": ties, "ranking": []}
        marks = marks_of({"delay:a": {}, "parameter:L": {}}, [], kind="double", **document)
        return marks["both"], marks["both_in_group"], marks["false_second"]

    assert both(["delay:a"], off=["L"]) == (True, True, False)
    assert both(["lag:a"], [["lag:a", "delay:a"]], ["L"]) == (False, True, False)
    assert both(["lag:a"], [["lag:a", "delay:a"]]) == (False, False, False)
    assert both(["delay:a"], off=["L", "m"]) == (True, True, True)
