"""The blind challenge: nothing in a workspace says the answer, seals hold, marks count."""

import json
import re
import shutil

import numpy as np
import pytest
from click.testing import CliRunner

from cli import grounded
from facts import holding, holds
from grounded.challenge import judge, make, of_crude, summary
from grounded.challenge.draws import draw_withheld, values_of
from grounded.challenge.mechanism import Mechanism, arm_xml, cart_xml
from grounded.challenge.score import Oracle, share
from grounded.challenge.systems import SYSTEMS
from grounded.effects import Library, Scales
from grounded.errors import GroundedError
from grounded_cli.main import cli
from grounded_trials.challenge import diagnose_case, open_label, read_manifest, score_case
from grounded_trials.store.documents import write_document
from grounded_trials.store.store import Store
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.last_diagnosis import read_diagnosis


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("challenge") / "cases"
    words = ["challenge", "make", str(folder), "--kind", "single", "--cases", "2", "--seed", "3"]
    result = CliRunner().invoke(cli, [*words, "--json"])
    assert result.exit_code == 0, result.output
    return folder, folder.with_name("cases-labels"), json.loads(result.output)


def test_cases_are_workspaces_that_can_be_read(made):
    folder, _, document = made
    assert document["cases"] == ["single-0000", "single-0001"]
    for name in document["cases"]:
        workspace = Folder(folder / name)
        assert len(workspace.task_trials()) >= 3
        assert all(not t.trial.candidate for t in workspace.trials())


def test_no_file_of_a_case_holds_the_answer(made):
    folder, labels, document = made
    for name in document["cases"]:
        truth = json.loads((labels / f"{name}.json").read_text())["effects"][0]["effect"]
        for path in (folder / name).rglob("*"):
            if path.is_file():
                content = re.sub(rb"#.*", b"", path.read_bytes())  # the template's comments
                assert truth.partition(":")[0].encode() not in content, path


def test_a_label_that_was_changed_is_not_opened(made, tmp_path):
    folder, labels, document = made
    name = document["cases"][0]
    entry = read_manifest(folder)[name]
    assert open_label(labels, name, entry)["case"] == name
    label = json.loads((labels / f"{name}.json").read_text())
    label["effects"][0]["effect"] = "dead_zone:somewhere"
    (tmp_path / f"{name}.json").write_text(json.dumps(label, sort_keys=True))
    with pytest.raises(GroundedError, match=holding(f"{name}.json")):
        open_label(tmp_path, name, entry)


def test_a_case_without_a_diagnosis_says_what_to_run(made):
    folder, labels, document = made
    name = document["cases"][1]
    with pytest.raises(GroundedError, match=holding(name)):
        score_case(folder, labels, name, read_manifest(folder)[name])


@pytest.mark.slow
def test_cases_are_run_and_scored_as_jobs_and_a_run_goes_on(tmp_path):
    folder = tmp_path / "cases"

    def say(*words):
        result = CliRunner().invoke(cli, ["challenge", *words, "--json"])
        assert result.exit_code == 0, result.output
        return json.loads(result.stdout)

    say("make", str(folder), "--kind", "none", "--cases", "2", "--seed", "5")
    (folder / "none-0000" / "reports").mkdir()
    done = {"verdict": {"kind": "none", "effects": []}, "ranking": [], "indistinguishable": []}
    done |= {"leftover": [], "gap": {"after": 1.0}}
    write_document(folder / "none-0000" / "reports" / "diagnosis.json", done)
    found = say("run", str(folder))  # the other one had been
    assert found["cases"] == ["none-0001"] and found["cpu_s"]["none-0001"] > 0.05
    assert say("run", str(folder))["cases"] == []
    scored = say("score", str(folder), "--jobs", "2")
    assert [m["case"] for m in scored["cases"]] == ["none-0000", "none-0001"]
    row = scored["summary"]["none"]
    assert row["cases"] == 2
    assert sum(row["verdicts"].values()) == 2


def test_a_case_that_is_refused_counts_and_the_others_go_on(made, tmp_path, monkeypatch):
    folder, labels, document = made
    name = document["cases"][0]
    case = tmp_path / name
    shutil.copytree(folder / name, case)

    def refuse(*args, **kwargs):
        raise GroundedError("the clocks of states and commands differ")

    monkeypatch.setattr("grounded_trials.challenge.diagnose_in", refuse)
    assert diagnose_case(str(tmp_path), name, ())["case"] == name
    found = read_diagnosis(Folder(case).reports)
    assert found is not None and found.verdict.kind == "unknown" and not found.effects
    assert [one.code for one in found.findings] == ["gap.refused"]
    entry = read_manifest(folder)[name]
    mark = score_case(str(tmp_path), str(labels), name, entry)
    assert mark["verdict"] == "unknown" and not mark["named"]


def test_labels_inside_the_cases_are_refused(tmp_path):
    words = ["--kind", "none", "--cases", "1", "--seed", "0", "--labels", str(tmp_path / "c" / "l")]
    result = CliRunner().invoke(cli, ["challenge", "make", str(tmp_path / "c"), *words])
    assert isinstance(result.exception, GroundedError)
    assert holds(str(result.exception), tmp_path / "c" / "l", tmp_path / "c")
    assert not (tmp_path / "c").exists()


@pytest.mark.slow
def test_an_interrupted_challenge_goes_on_with_the_same_command(made, tmp_path, monkeypatch):
    folder, labels, _ = made
    add, calls = Store.add, []
    last = len(Store(folder / "single-0000" / "trials").list()) + 2  # the second of the second case

    def interrupted(store, *args):
        calls.append(args)
        if len(calls) == last:
            raise KeyboardInterrupt
        return add(store, *args)

    words = ["challenge", "make", str(tmp_path / "c"), "--kind", "single", "--cases", "2", "--seed"]
    with monkeypatch.context() as patch:
        patch.setattr(Store, "add", interrupted)
        assert CliRunner().invoke(cli, [*words, "3"]).exit_code != 0
    assert Store(tmp_path / "c" / "single-0001" / "trials").list()
    other = CliRunner().invoke(cli, [*words, "4"])
    assert isinstance(other.exception, GroundedError)
    assert str(tmp_path / "c") in str(other.exception)
    again = CliRunner().invoke(cli, [*words, "3"])
    assert again.exit_code == 0, again.output
    for first, second in ((folder, tmp_path / "c"), (labels, tmp_path / "c-labels")):
        assert files_of(second) == files_of(first)


def files_of(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and not path.name.startswith(".")
    }


def said(*words, code=0):
    done = grounded("challenge", *words)
    assert done.code == code, done.err
    return done


def answered(folder):
    """As if every case had been diagnosed."""
    done = {"verdict": {"kind": "none", "effects": []}, "ranking": [], "indistinguishable": []}
    done |= {"leftover": [], "gap": {"after": 1.0}}
    for name in read_manifest(folder):
        (folder / name / "reports").mkdir()
        write_document(folder / name / "reports" / "diagnosis.json", done)


@pytest.mark.slow
def test_the_next_command_says_where_the_labels_are_to_be_looked_for(tmp_path):
    folder, labels = tmp_path / "cases", tmp_path / "sealed"
    words = ["make", folder, "--kind", "none", "--cases", "1", "--seed", "5"]
    assert holds(said(*words, "--labels", labels).out, "1 case")
    answered(folder)
    run = said("run", folder, "--without", "delay,offset", "--without", "stall").out
    assert holds(run, "grounded challenge score", folder, "--labels DIR")
    missing = said("score", folder, code=1).err
    assert holds(missing, f"{folder}-labels", "--labels")
    wrong = said("score", folder, "--labels", tmp_path / "nowhere", code=1).err
    assert holds(wrong, tmp_path / "nowhere", "none-0000.json")
    wrong = said("score", folder, "--labels", tmp_path, code=1).err
    assert holds(wrong, tmp_path, "none-0000.json") and "--labels DIR" not in wrong
    out = said("score", folder, "--labels", labels).out
    assert max(map(len, out.splitlines())) <= 80
    assert "\nnone\n  cases                1\n" in out


def test_what_is_no_challenge_is_said_to_be_none(tmp_path):
    for command in ("run", "score"):
        message = said(command, tmp_path / "nothere", code=1).err
        assert holds(message, tmp_path / "nothere") and "Errno" not in message
        labels = ["--labels", tmp_path] * (command == "score")
        message = said(command, tmp_path, *labels, code=1).err
        assert holds(message, tmp_path, "manifest.json")


def case_of(system, **about):
    return next(make("none", 1, 7, only=system, noise="white", **about))


@pytest.mark.parametrize("system", ["buggy", "lift"])
def test_kinked_systems_run_closed_loop_at_a_rate_of_theirs(system):
    case = case_of(system)
    assert 1 / case.task.dt == pytest.approx(20) or 1 / case.task.dt in (50, 100)
    assert len(case.trials) >= 3
    assert all(np.isfinite(t.states).all() for t in case.trials)
    low, high = case.task.low, case.task.high
    assert all((t.inputs >= low).all() and (t.inputs <= high).all() for t in case.trials)


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
    ("system", "built", "motor"), [("arm", arm_xml, "tau2"), ("cart_pole", cart_xml, "force")]
)
def test_the_simulator_is_the_crude_model_but_for_what_is_withheld(system, built, motor):
    pytest.importorskip("mujoco")
    model, rng = SYSTEMS[system].model, np.random.default_rng(1)
    x, u = rng.normal(size=model.n), 2 * rng.normal(size=model.m)

    def after(**part):
        kinds = {kind: part.get(kind, {}) for kind in ("friction", "armature", "lag")}
        true = dict(zip(model.param_names, model.values, strict=True)) | part.get("true", {})
        plant, at = Mechanism(built, kinds | {"true": true}, {}, 0.005), x
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
