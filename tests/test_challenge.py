"""The blind challenge on disk: nothing in a workspace says the answer, and seals hold."""

import json

import pytest
from click.testing import CliRunner

from grounded.errors import GroundedError
from grounded_cli.main import cli
from grounded_trials.challenge_files import open_label, read_manifest, score_case
from grounded_trials.workspace import Workspace


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
        workspace = Workspace(folder / name)
        assert len(workspace.task_trials()) >= 3
        assert all(t.is_data for t in workspace.trials())


def test_no_file_of_a_case_holds_the_answer(made):
    folder, labels, document = made
    for name in document["cases"]:
        truth = json.loads((labels / f"{name}.json").read_text())["effects"][0]["effect"]
        family = truth.split(":")[0]
        for path in (folder / name).rglob("*"):
            if path.is_file():
                assert family.encode() not in path.read_bytes(), path


def test_the_same_seed_makes_the_same_bytes(made, tmp_path):
    folder, _, _ = made
    words = ["--kind", "single", "--cases", "2", "--seed", "3"]
    assert (
        CliRunner().invoke(cli, ["challenge", "make", str(tmp_path / "c"), *words]).exit_code == 0
    )
    again = (tmp_path / "c" / "manifest.json").read_bytes()
    assert again == (folder / "manifest.json").read_bytes()


def test_a_label_that_was_changed_is_not_opened(made, tmp_path):
    folder, labels, document = made
    name = document["cases"][0]
    entry = read_manifest(folder)[name]
    assert open_label(labels, name, entry)["case"] == name
    label = json.loads((labels / f"{name}.json").read_text())
    label["effects"][0]["effect"] = "dead_zone:somewhere"
    (tmp_path / f"{name}.json").write_text(json.dumps(label, sort_keys=True))
    with pytest.raises(GroundedError, match="it was changed"):
        open_label(tmp_path, name, entry)


def test_a_case_without_a_diagnosis_says_what_to_run(made):
    folder, labels, document = made
    name = document["cases"][1]
    with pytest.raises(GroundedError, match=r"was not diagnosed: run `grounded challenge run "):
        score_case(folder, labels, name, read_manifest(folder)[name])


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
    (folder / "none-0000" / "reports" / "diagnosis.json").write_text(json.dumps(done))
    assert list(say("run", str(folder))["cpu_s"]) == ["none-0001"]  # the other one had been
    found = say("run", str(folder))
    assert found["cases"] == ["none-0001"] and found["cpu_s"]["none-0001"] > 0.05
    scored = say("score", str(folder), "--jobs", "2")
    assert [m["case"] for m in scored["cases"]] == ["none-0000", "none-0001"]
    row = scored["summary"]["none"]
    assert row["cases"] == 2 and row["cpu_s_mean"] == found["cpu_s"]["none-0001"]
    assert sum(row["verdicts"].values()) == 2


def test_labels_inside_the_cases_are_refused(tmp_path):
    words = ["--kind", "none", "--cases", "1", "--seed", "0", "--labels", str(tmp_path / "c" / "l")]
    result = CliRunner().invoke(cli, ["challenge", "make", str(tmp_path / "c"), *words])
    assert isinstance(result.exception, GroundedError)
    assert "must lie outside" in str(result.exception)
