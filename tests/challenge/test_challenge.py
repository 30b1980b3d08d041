"""The blind challenge on disk: nothing in a workspace says the answer, and seals hold."""

import json
import re
import shutil

import pytest
from click.testing import CliRunner

from cli import grounded
from facts import holding, holds
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
