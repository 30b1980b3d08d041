"""The commands: exit codes, JSON documents, data on stdout and narration on stderr."""

import csv
import json
import re
import tomllib
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from cli import grounded, plain, process
from facts import holds
from grounded.effects import Library
from grounded.findings.catalogue import WEIGHTS
from grounded.policy import load
from grounded_cli.commands import cli
from grounded_trials.starting.examples import EXAMPLES
from grounded_trials.workspace.folder import Folder
from shared_data import data, needs_data
from workspaces import make

COMMANDS = list(cli.commands)


@pytest.fixture
def w(tmp_path):
    return make(tmp_path / "w").folder


def step(w):
    """One propose, run and ingest; the documents of the three."""
    proposed = grounded("-C", w, "propose", "--json").json
    run = grounded("-C", w, "run", "--json").json
    return proposed, run, grounded("-C", w, "ingest", run["trial_file"], "--json").json


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_explains_itself(name):
    done = grounded(name, "--help")
    assert done.code == 0 and not done.err
    assert done.out.startswith(f"Usage: grounded {name}")
    text = done.out.split("Options:")[0]
    assert len(text.split("\n\n", 1)[1].strip()) > 20, "a sentence that says what it does"
    options = re.findall(r"^  (-[^ ,]*,? ?--[\w-]+|--[\w-]+).*", done.out, re.M)
    for line in re.findall(r"^  --[\w-]+(?: [A-Z\[][^ ]*)?$", done.out, re.M):
        raise AssertionError(f"'{line}' has no help")
    assert options


def test_the_list_of_commands_is_in_the_order_of_use():
    done = grounded("--help")
    listed = re.findall(r"^  (\w+)  ", done.out.split("Commands:")[1], re.M)
    assert listed == COMMANDS and done.code == 0
    assert grounded("-h").out == done.out
    assert re.search("grounded demo +car-figure8", done.out)


def test_a_code_is_explained():
    one = grounded("explain", "plan.small")
    assert one.code == 0 and WEIGHTS["note"].split(";")[0] in one.out and "remedy" in one.out
    listed = grounded("explain", "--json").json
    assert {"log.unit", "plan.no_limits"} <= {*listed["findings"]}
    assert {*listed["effects"]} == {family.name for family in Library().families}


@pytest.mark.parametrize(
    ("name", "example", "units"),
    [
        ("side_slip", "side_slip:x+y", {"k": "s^2/m"}),
        ("sensor_bias:theta", "sensor_bias:theta", {"b": "rad"}),
        ("sensor_bias:elsewhere", "sensor_bias:delta", {"b": "rad"}),
    ],
)
def test_an_effect_is_explained(name, example, units):
    family = name.partition(":")[0]
    told = grounded("explain", name, "--json").json["effects"][family]
    assert (told["example"], told["quantities"]) == (example, units)
    assert not re.search(r"[{}|&]|\[|\]", told["sentence"]) and told["lookalikes"]
    assert told["equation"].split()[0] in grounded("explain", name).out


@pytest.mark.parametrize(
    ("wrong", "near"), [("log.unti", "log.unit"), ("dead_zonne:u", "dead_zone"), ("qqqq", "")]
)
def test_an_unknown_name_gets_one_of_either_kind(wrong, near):
    done = grounded("explain", wrong)
    assert done.code == 1 and near in done.err and len(done.err) < 200


def test_version():
    done = grounded("--version")
    assert done.code == 0 and re.search(r"\d+\.\d+\.\d+", done.out)


@pytest.mark.parametrize(
    ("args", "match"),
    [
        (["propse"], "no command 'propse': did you mean 'propose'"),
        (["propose", "--jsn"], "--json"),
        (["init"], "--from LOG"),
        (["init", "x"], "--blank --model"),
        (["ingest"], "Missing argument"),
        (["learn", "--trials", "0"], "0 is not in the range"),
        (["learn", "--trials", "many"], "not a valid integer"),
        (["export", "c0001", "--format", "xml"], "'xml' is not one of"),
        (["-C"], "requires an argument"),
    ],
    ids=lambda v: " ".join(v) if isinstance(v, list) else "",
)
def test_wrong_usage_is_exit_2(args, match):
    done = grounded(*args)
    assert done.code == 2 and match in done.err and not done.out
    assert "Traceback" not in done.err


@pytest.mark.parametrize("name", ["propose", "run", "learn", "status", "fit", "verify"])
def test_a_folder_that_is_no_workspace_is_exit_1(name, tmp_path):
    done = grounded("-C", tmp_path, name)
    assert done.code == 1 and not done.out
    assert done.err.startswith("error: ") and holds(done.err, tmp_path)
    assert done.err.endswith("\nnext: grounded init DIR --example car-turn\n")


def test_colour_only_on_a_terminal(w):
    for env in ({"NO_COLOR": "1"}, {}):
        done = process("-C", w, "propse" if not env else "run", **env)
        assert "\x1b" not in done.err + done.out


def test_studies_are_listed_as_words_and_as_json():
    listed = grounded("experiment", "--json").json["studies"]
    assert "flight" in listed and all(listed.values())
    assert list(listed) == [line.split()[0] for line in grounded("experiment").out.splitlines()]


def test_init_lists_and_makes_workspaces(tmp_path):
    listed = grounded("init", "--list", "--json").json["examples"]
    assert list(listed) == list(EXAMPLES)
    assert {"car-turn", "car-circle", "car-figure8", "flight-figure8", "pendulum"} <= set(listed)
    for name in EXAMPLES:
        done = grounded("init", tmp_path / name, "--example", name, "--json")
        assert done.json["workspace"] == str(tmp_path / name)
        here = {p.name for p in (tmp_path / name).iterdir()}
        assert {"grounded.toml", "model.py", "target.csv", "trials", "candidates"} <= here
    assert grounded("init", tmp_path / "pendulum", "--example", "pendulum").code == 1
    wrong = grounded("init", tmp_path / "x", "--example", "car-trun")
    assert wrong.code == 1 and holds(wrong.err, "car-trun", "'car-turn'")
    assert not (tmp_path / "x").exists()


def test_the_loop_by_hand(w):
    status = grounded("-C", w, "status", "--json").json
    assert (status["phase"], status["trials"], status["best"]) == ("propose", 0, None)
    proposed, run, ingested = step(w)
    assert {"candidate", "file", "iteration", "alpha", "predicted_utility", "phase"} <= set(
        proposed
    )
    assert (proposed["candidate"], proposed["iteration"], proposed["alpha"]) == ("c0001", 0, 1.0)
    assert proposed["phase"] == "await-trial" and Path(proposed["file"]).is_file()
    assert Path(run["trial_file"]).name == "c0001-1.mcap"
    (trial,) = ingested["trials"]
    fields = {"trial", "sha256", "known", "candidate", "utility", "accepted", "warnings"}
    assert fields <= set(trial)
    assert (trial["trial"], trial["candidate"], trial["known"]) == ("t0001", "c0001", False)
    assert trial["accepted"] is True and trial["warnings"] == [] and trial["utility"] < 0
    assert len(trial["sha256"]) == 64
    second, _, _ = step(w)
    assert (second["candidate"], second["iteration"]) == ("c0002", 1)
    status = grounded("-C", w, "status", "--json").json
    assert {"phase", "iteration", "best", "utilities", "trials"} <= set(status)
    assert status["trials"] == 2 and status["iteration"] == 1 and len(status["utilities"]) == 2
    best = {"candidate": "c0002", "utility": status["utilities"][-1]}
    assert best.items() <= status["best"].items()
    assert second["best_utility"] == status["utilities"][0]


def test_learn_runs_to_the_end_and_says_what_is_next(w):
    part = grounded("-C", w, "learn", "--trials", "2", "--json")
    assert part.json["trials"] == 2 and part.code == 0
    assert part.err.count("c000") == 2  # narration, a line a trial
    done = grounded("-C", w, "learn", "--json").json
    assert {"utilities", "trials", "phase"} <= set(done)
    assert done["phase"] in ("converged", "stopped") and done["trials"] <= 12
    status = grounded("-C", w, "status", "--json").json
    assert status["phase"] == done["phase"] and status["utilities"] == done["utilities"]
    ended = grounded("-C", w, "propose", "--json")
    assert ended.code == 0 and ended.json["candidate"] is None
    assert ended.json["phase"] == done["phase"] and ended.json["sentence"]
    again = grounded("-C", w, "learn", "--json")
    assert again.json["trials"] == done["trials"] and again.code == 0
    assert not grounded("-C", w, "status").err


def test_run_may_name_any_candidate_and_needs_one(w):
    none = grounded("-C", w, "run")
    assert none.code == 1 and plain(none.err).endswith("next: grounded propose\n")
    step(w)
    again = grounded("-C", w, "run", "c0001", "--json").json
    assert Path(again["trial_file"]).name == "c0001-2.mcap"
    wrong = grounded("-C", w, "run", "c0009")
    assert wrong.code == 1 and holds(wrong.err, "c0009", "c0001")


def test_exports_hold_the_same_policy_with_units_and_time_base(w, tmp_path):
    step(w)
    for form in ("json", "npz", "csv"):
        path = tmp_path / f"c.{form}"
        done = grounded("-C", w, "export", "best", "--format", form, "-o", path, "--json")
        assert done.json["file"] == str(path) and done.json["candidate"] == "c0001"
        assert b"kg" not in path.read_bytes()  # units of states and inputs, not of parameters
    units = {"x": "m", "v": "m/s", "force": "N"}
    made = load(tmp_path / "c.npz", states=("x", "v"), inputs=("force",)).policy
    assert (made.dt, made.horizon) == (0.05, 40)
    with np.load(tmp_path / "c.npz") as arrays:
        assert json.loads(str(arrays["units"])) == units and str(arrays["time_unit"]) == "s"
    document = json.loads((tmp_path / "c.json").read_text())
    assert (document["dt"], document["time_unit"], document["units"]) == (0.05, "s", units)
    np.testing.assert_array_equal(made.gain, document["gain"])
    lines = (tmp_path / "c.csv").read_text().splitlines()
    assert "# dt [s]: 0.05" in lines and any('"v": "m/s"' in line for line in lines)
    rows = list(csv.DictReader(line for line in lines if line[0] != "#"))
    assert [float(row["feedforward.force"]) for row in rows] == made.feedforward[:, 0].tolist()
    assert rows[1]["t"] == "0.05"


def test_verify_names_what_is_damaged_and_fails(w):
    step(w)
    step(w)
    good = grounded("-C", w, "verify", "--json")
    assert (good.code, good.json["damaged"], good.json["checked"]) == (0, [], 6)
    path = sorted((w / "trials").glob("t0002*"))[0]
    path.chmod(0o644)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(bytes(data))
    bad = grounded("-C", w, "verify", "--json")
    assert bad.code == 1 and [d["file"] for d in bad.json["damaged"]] == [str(path)]
    stopped = grounded("-C", w, "propose")
    assert stopped.code == 1 and "t0002" in stopped.err and "damaged" in stopped.err
    candidate = w / "candidates" / "c0001.mcap"
    candidate.write_bytes(candidate.read_bytes()[:-100])
    worse = grounded("-C", w, "verify", "--json").json["damaged"]
    assert len(worse) == 2 and worse[1]["file"] == str(candidate)


def test_fit_shows_values_with_intervals_and_applies_them(w):
    grounded("-C", w, "learn", "--trials", "3")
    found = grounded("-C", w, "fit", "--json").json
    assert {"value", "std", "unit"} <= set(found["params"]["mass"])
    assert found["params"]["mass"]["value"] == pytest.approx(1.4, rel=0.1)
    assert found["params"]["mass"]["unit"] == "kg" and not found["applied"]
    text = (w / "grounded.toml").read_text()
    applied = grounded("-C", w, "fit", "--apply")
    assert applied.code == 0 and "mass" in applied.out
    changed = (w / "grounded.toml").read_text()
    assert changed != text and "params = " in changed
    assert changed.split("[task]")[1] == text.split("[task]")[1]  # the rest is left alone
    made = grounded("-C", w, "propose", "--json").json
    assert made["candidate"] and made["alpha"] == 1.0
    only = grounded("-C", w, "fit", "--params", "drag", "--json").json
    assert set(only["params"]) == {"drag"}
    wrong = grounded("-C", w, "fit", "--params", "drg")
    assert wrong.code == 1 and holds(wrong.err, "drg", "'drag'")


def last(done):
    assert done.code == 0, done.err
    return plain(done.out).rstrip().splitlines()[-1]


def test_a_trial_of_ours_needs_no_log_table(learnt, tmp_path):
    (stored,) = learnt.glob("trials/t0001-*")
    done = grounded("-C", learnt, "inspect", stored)
    assert holds(done.out, stored.name, "trial", "c0001") and "[log." not in done.out
    assert last(done) == "next: grounded report"
    path = tmp_path / "run.mcap"
    path.write_bytes(stored.read_bytes())
    done = grounded("-C", learnt, "inspect", path)
    assert last(done) == f"next: grounded ingest {path}"
    assert grounded("-C", learnt, "inspect", path, "--json").json["log_table"] == ""


def test_a_candidate_is_said_to_be_one(learnt):
    done = grounded("-C", learnt, "inspect", learnt / "candidates" / "c0002.mcap")
    assert holds(done.out, "c0002.mcap", "candidate") and "[log." not in done.out
    assert last(done) == "next: grounded run c0002"


def test_a_cut_trial_is_damaged_and_recover_is_next(learnt, tmp_path):
    (stored,) = learnt.glob("trials/t0001-*")
    path = tmp_path / "cut.mcap"
    path.write_bytes(stored.read_bytes()[:-3000])
    done = grounded("-C", learnt, "inspect", path)
    assert f"{path}: DAMAGED, trial of c0001" in done.out and "[log." not in done.out
    assert last(done) == f"next: grounded recover {path}"
    assert path.name in done.err


@needs_data
def test_a_foreign_log_ends_with_a_table_that_can_be_pasted(tmp_path):
    log = data("dart_small_car", "dart_4_sept_random_driving_slow_ros2.mcap")
    folder = make(tmp_path / "w", "car-turn").folder
    done = grounded("-C", folder, "inspect", log)
    assert last(done).startswith("# next: ")
    table = tomllib.loads(done.out[done.out.index("# for grounded.toml") :])
    assert table["log"]["input"]["throttle"]["path"] == "/throttle_1.data"
    assert re.search(r"header .*\d\.\d ms", done.out)
    model = Folder(folder).base_model
    lost = [n for n in model.state_names if n not in table["log"].get("state", {})]
    sent = [n for n in model.input_names if n not in table["log"].get("input", {})]
    file = folder / "grounded.toml"
    file.write_text(file.read_text() + done.out[done.out.index("# for grounded.toml") :])
    more = "".join(f'\n[log.state.{name}]\npath = "/{name}.data"\n' for name in lost)
    more += "".join(f'\n[log.input.{name}]\npath = "/{name}.data"\n' for name in sent)
    file.write_text(file.read_text() + more)  # as a user maps what was not found
    done = grounded("-C", folder, "inspect", log)
    assert last(done).startswith("# next: grounded")


@needs_data
def test_outside_a_workspace_one_is_asked_for(tmp_path):
    log = data("dart_small_car", "dart_4_sept_random_driving_slow_ros2.mcap")
    done = grounded("-C", tmp_path, "inspect", log)
    said = " ".join(done.err.split())
    assert holds(said, "this folder is no workspace", "make one from the log", "-C DIR")
    assert "grounded init DIR --from" in done.out


@pytest.mark.slow
def test_demo_prints_utilities_and_trials(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    there = find_spec  # no recording without rerun
    monkeypatch.setattr(
        "grounded_cli.demo.find_spec", lambda name: None if name == "rerun" else there(name)
    )
    done = grounded("demo", "pendulum", "--json")
    assert done.code == 0, done.err
    found = done.json
    assert {"workspace", "utilities", "verdict", "trials"} <= set(found)
    assert found["utilities"][-1] > 0.65 * found["utilities"][0]
    folder = tmp_path / found["workspace"]
    assert (folder / "grounded.toml").is_file() and (folder / "reports").is_dir()
    assert "rrd" not in found["paths"] and found["paths"]["html"]
    assert all((tmp_path / path).is_file() for path in found["paths"].values())
    again = grounded("demo", "pendulum")
    assert again.code == 1 and holds(again.err, found["workspace"])


def test_demo_of_an_unknown_example(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = grounded("demo", "car-figure9")
    assert done.code == 1 and holds(done.err, "car-figure9", "'car-figure8'")
    assert not list(tmp_path.iterdir())


def test_a_workspace_without_trials_has_a_report_and_no_diagnosis(tmp_path):
    folder = make(tmp_path / "w").folder
    assert grounded("-C", folder, "report").code == 0
    for command in ("diagnose", "fit"):
        done = grounded("-C", folder, command)
        assert done.code == 1 and holds(done.err, "ingest", "--data")


def test_fit_then_learn_reaches_as_far(learnt):
    before = grounded("-C", learnt, "status", "--json").json["best"]["utility"]
    assert grounded("-C", learnt, "fit", "--latency", "--apply").code == 0
    done = grounded("-C", learnt, "learn", "--json").json
    assert done["best"]["utility"] >= before
