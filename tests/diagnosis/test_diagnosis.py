"""The diagnosis end to end: verdicts on known answers, on noise alone, on groups of trials."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from cli import grounded
from grounded import GroundedError, Trial
from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.diagnosis.error_report import Correction, Curve, Remainder
from grounded.diagnosis.levels import NATS
from grounded.diagnosis.parts import Diagnosis, Ranked, Verdict
from grounded.diagnosis.validation.claims import fewest
from grounded.diagnosis.validation.ruler import repeated
from grounded.diagnosis.writer import verdict_of
from grounded.effects import Library, wrap
from grounded.models.pendulum import model as pendulum
from grounded.search.design import probe
from grounded_trials import Workspace
from grounded_trials.store.documents import write_document
from small_tasks import DT, plain_task, pushed_cart
from stepped import library, logged, stepped


def codes(found):
    return {one.code for one in found.findings}


FEW = "coulomb_friction viscous_friction dead_zone input_gain delay offset trend"
OPTIONS = DiagnosisOptions(library=library(*FEW.split()))


@pytest.mark.slow
def test_one_effect_is_named_with_its_size():
    model, trials = pushed_cart(friction=0.4)
    found = diagnose(model, trials)
    assert found.ranking[0].effect == "coulomb_friction:v"
    assert found.kind == "effect", found.sentence
    assert found.ranking[0].params["c"].value == pytest.approx(0.4, rel=0.1)
    assert found.gap.after < 1.25 < found.gap.before
    assert found.where.channels[0].name == "v"


def test_as_few_parameters_are_selected_as_leave_nothing_to_the_others():
    ratios = np.array([[-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]])  # K, m, I: K / m and K / I are known
    H, b = 3000 * ratios.T @ ratios + np.eye(3), np.array([-0.02, 1.8, 2.1])
    free, _ = fewest(H, b, range(3))
    assert {*free} == {0, 1, 2}  # the first alone would do most of it
    free, left = fewest(H, b, [1, 2])
    assert {*free} == {1, 2} and left < NATS


@pytest.mark.slow
def test_one_trial_names_no_cause():
    model, trials = pushed_cart(friction=0.5, trials=1)
    found = diagnose(model, trials)
    assert found.kind == "unknown"
    assert found.effects == ()


@pytest.mark.slow
def test_a_constant_input_is_not_blamed():
    model, trials = pushed_cart(friction=0.5)
    flat = [
        Trial(t.states, np.full_like(t.inputs, 0.3), t.dt, t.state_names, t.input_names)
        for t in trials
    ]
    found = diagnose(model, flat, OPTIONS)
    assert found.kind == "unknown" and "model.still" in codes(found)
    assert not any(r.effect.endswith(":u") for r in found.ranking)


def test_no_trials_and_foreign_trials_are_refused():
    model, trials = pushed_cart()
    with pytest.raises(GroundedError, match="no trial"):
        diagnose(model, [])
    with pytest.raises(GroundedError, match="states"):
        diagnose(pendulum, trials)


@pytest.mark.slow
def test_a_probe_tells_two_explanations_apart():
    model, trials = pushed_cart(dead=0.1, steps=60, trials=3)
    H = 100
    task = plain_task(model, DT, np.zeros((H + 1, 2)), 1.0, 1.0)
    found = diagnose(task, trials)
    tied = replace(
        found,
        verdict=replace(found.verdict, effects=("dead_zone:u",)),
        indistinguishable=(("dead_zone:u", found.ranking[1].effect),),
    )
    base = task.policy(0.3 * np.ones((H, 1)), None, None)
    best = probe(task, base, tied, trials)
    assert best is not None
    assert best.expected > 3
    assert (best.policy.feedforward >= -1).all()
    assert (best.policy.feedforward <= 1).all()
    assert not best.little
    assert probe(task, base, replace(tied, equivalent=tied.indistinguishable), trials) is None


def test_the_diagnosis_does_not_reach_the_simulated_truth():
    import subprocess
    import sys

    code = (
        "import sys, grounded.diagnosis.diagnose, grounded.search.design;"
        "bad = [m for m in sys.modules if m.startswith(('grounded.models', 'grounded.plant',"
        " 'grounded.experiments', 'grounded.challenge'))]; assert not bad, bad"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    ("most", "error", "more"),
    [(3, 0.056, True), (2, 0.056, False), (3, 0.033, False)],
)
def test_where_as_many_as_were_looked_for_leave_more_than_noise_more_are_looked_for(
    most, error, more
):
    claimed = [f"viscous_friction:{k}" for k in range(max(most, 3))]
    rows = tuple(Ranked(name, {}, {}, 50.0, claimed=True) for name in claimed)
    left = (Remainder("u", 0.1, "m/s^2", 9.0, None, error, 0.032, 1.0, "m/s", True),)
    said = Diagnosis(Verdict("several"), ranking=rows, leftover=left)
    found = verdict_of(said, (), (), (), full=len(claimed) == most)
    assert found.again is more


def test_without_an_effect_the_error_is_noise():
    model, trials = pushed_cart()
    found = diagnose(model, trials)
    for row in found.prediction_error[:-1]:
        assert row.with_effects == row.crude and row.floor_from == "short horizon"
        assert all(e < 1.1 * row.noise_floor[name] for name, e in row.crude.items())
    where = found.to_json()["where"]  # shares of noise would differ from day to day
    assert found.kind == "none" and where["times"] == where["regions"] == []
    assert {c["share"] for c in where["channels"]} == {None}


def test_a_trial_beside_itself_confirms_nothing():
    model, trials = pushed_cart(friction=0.4, trials=1)
    few = DiagnosisOptions(library=Library((Library().family("coulomb_friction"),)))
    found = diagnose(model, [trials[0], trials[0]], few)
    assert found.no_cause and not found.effects and found.trials == 1


def test_repeats_of_a_candidate_tell_the_noise():
    model, (trial,) = pushed_cart(trials=1)
    rng, u = np.random.default_rng(3), trial.inputs
    paths = [stepped(model, u, DT, disturbed=np.array([3e-4, 3e-3]), rng=rng) for _ in range(4)]
    same = [logged(model, path, u, DT, [2e-3, 0.01], rng, candidate="c0001") for path in paths]
    for row in diagnose(model, same).prediction_error[:-1]:
        assert row.floor_from == "repeats"
        assert all(e < 1.2 * row.noise_floor[name] for name, e in row.with_effects.items())


@pytest.mark.slow
def test_a_value_that_differs_by_trial_is_told():
    trials = [pushed_cart(friction=0.25 + 0.05 * k, trials=1, seed=k)[1][0] for k in range(6)]
    found = diagnose(pushed_cart()[0], trials, OPTIONS)
    (one,) = (a for a in found.agreement if a.effect == "coulomb_friction:v")
    assert not one.agrees
    values = [v.value for v in found.per_trial if v.effect == one.effect]
    assert np.polyfit(np.arange(6), values, 1)[0] == pytest.approx(0.05, rel=0.25)
    assert "gap.disagree" in codes(found)


@pytest.mark.slow
def test_what_changed_between_two_groups():
    model, before = pushed_cart(friction=0.3, trials=2, seed=1)
    _, after = pushed_cart(friction=0.5, trials=2, seed=2)
    found = diagnose(model, before, OPTIONS, compare=after)
    assert found.trials == 4 and found.changed is not None
    (one,) = found.changed
    assert one.effect == "coulomb_friction:v"
    assert {"gap.next.changed", "gap.changed"} <= {*codes(found)}
    assert (one.first.value, one.second.value) == pytest.approx((0.3, 0.5), abs=0.06)
    assert one.evidence > 20 and one.chance < 1e-6
    assert abs(one.first.value - one.second.value) > 3 * np.hypot(one.first.std, one.second.std)
    again = Diagnosis.from_json(json.loads(json.dumps(found.to_json())))
    assert again == found and again.changed == found.changed


def test_groups_that_overlap_are_refused(workspace_of):
    folder = workspace_of().folder
    done = grounded("-C", folder, "diagnose", "--compare", "t0001,t0002", "t0002")
    assert done.code == 1 and "--compare" in done.err


def test_trials_of_two_groups_are_no_repeats():
    _, trials = pushed_cart(trials=1)
    trials = [replace(trials[0], candidate="c0001")] * 4
    data = SimpleNamespace(lengths=np.array([trial.steps for trial in trials]))
    assert repeated(trials, data, 4) == [[0, 1, 2, 3]]
    assert repeated(trials, data, 2) == [[0, 1], [2, 3]]
    assert repeated(trials[:2], data, 1) == []
    same = [replace(trial, candidate="") for trial in trials]
    assert repeated(same, data, 2) == [[0, 1], [2, 3]]


def one_second(model, trials):
    """Rms error of v a second ahead."""
    errors = []
    for trial in trials:
        x, u = trial.states[:-20], trial.inputs
        for k in range(20):
            x = model.system.step(x, u[k : len(u) - 19 + k], model.values, trial.dt)
        errors.append(x[:, 1] - trial.states[20:, 1])
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))


def test_a_curve_predicts_what_no_effect_of_the_library_does():
    model, trials = pushed_cart(dead=0.25, trials=5, seed=1)
    others = [f.name for f in Library().families if f.name not in PLAIN]
    found = diagnose(model, trials, DiagnosisOptions(library=Library().without(others)))
    left = found.correction
    assert left is not None and left.adoptable and left.held_out_gain > 0.3
    assert (left.channel, left.over) == ("v", ("u",)) and left.unit == "m/s^2"
    assert len(left.curves[0].at) == len(left.curves[0].value) == len(left.curves[0].std)
    again = Diagnosis.from_json(json.loads(json.dumps(found.to_json())))
    assert again.correction == left

    calibrated = model.with_values({n: e.value for n, e in found.parameters.items()})
    better = calibrated
    for curve in left.curves:
        assert found.values(curve.effect) == curve.quantities
        better = wrap(Library().effect(curve.effect, better), curve.quantities, trials[0].dt)
    fresh = pushed_cart(dead=0.25, trials=4, seed=9)[1]
    assert one_second(better, fresh) < 0.7 * one_second(calibrated, fresh)


def test_where_nothing_is_left_there_is_no_correction():
    model, trials = pushed_cart(trials=4)
    assert diagnose(model, trials).correction is None


def kept(folder, **changes):
    """A diagnosis of a workspace with a correction over two variables."""
    ends = {"lo": -1.0, "hi": 1.0} | {f"w{k}": 0.1 * k for k in range(7)}
    curves = tuple(Curve(f"correction:v<-{r}", r, quantities=ends) for r in ("x", "force"))
    values = {"held_out_gain": 0.5, "adoptable": True} | changes
    left = Correction("v", ("x", "force"), unit="m/s^2", curves=curves, **values)
    found = Diagnosis(Verdict("unknown"), correction=left)
    (folder / "reports").mkdir(exist_ok=True)
    write_document(folder / "reports" / "diagnosis.json", found.to_json())


@pytest.mark.parametrize("asked", ["correction:v", "correction:v<-x"])
def test_a_correction_is_adopted_as_part_of_the_model(workspace_of, asked):
    workspace = Workspace(workspace_of().folder)
    workspace.learn(trials=2)
    kept(workspace.folder, adoptable=False)
    with pytest.raises(GroundedError, match="does not predict"):
        workspace.adopt(asked)
    kept(workspace.folder)
    done = workspace.adopt(asked)
    names = [effect["name"] for effect in done.effects]
    assert names == ["correction:v<-x", "correction:v<-force"] and done.claimed
    again = Workspace(workspace.folder)
    assert [e["w6"] for e in again.config.model.effects.values()] == [pytest.approx(0.6)] * 2
    assert again.propose().candidate


PLAIN = ("offset", "delay", "slope")  # families, so that none has a threshold
