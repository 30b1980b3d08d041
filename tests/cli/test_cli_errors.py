"""What goes wrong: one clear message, the right exit code, nothing stored, no traceback."""

import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from cli import grounded, plain, process
from facts import holds
from grounded_trials import Workspace
from grounded_trials.store.documents import write_document
from grounded_trials.store.trial_file import read_trial
from reported import DIAGNOSIS
from workspaces import CONFIG, MODEL, make

DART_LOG = """
[log]
[log.state.x]
path = "/vicon/jetracer1.pose.pose.position.x"
[log.state.v]
path = "/vicon/jetracer1.pose.pose.position.y"
[log.input.force]
path = "/throttle_1.data"
clock = "log"
"""


def stored(folder):
    return sorted(p.name for p in (folder / "trials").iterdir() if p.suffix == ".mcap")


def refused(folder, *args, holds=()):
    """A command fails with one message that names these, prints no document, stores nothing."""
    before = stored(folder)
    done = grounded("-C", folder, *args, "--json")
    assert done.code == 1 and not done.out and "Traceback" not in done.err, done.err
    assert len([line for line in done.err.splitlines() if line.startswith("error: ")]) == 1
    for part in holds:
        assert part in plain(done.err), done.err
    assert stored(folder) == before


@pytest.fixture
def w(tmp_path):
    return make(tmp_path / "w", config=CONFIG + DART_LOG).folder


@pytest.fixture
def trial(w):
    """A trial file of the outstanding candidate, not yet ingested."""
    grounded("-C", w, "propose")
    return Path(grounded("-C", w, "run", "--json").json["trial_file"])


def test_files_that_are_no_log(w, tmp_path):
    (tmp_path / "empty.mcap").write_bytes(b"")
    (tmp_path / "photo.mcap").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(range(64)))
    (tmp_path / "notes.txt").write_text("it drove well")
    (tmp_path / "zeros.mcap").write_bytes(bytes(4096))
    (tmp_path / "folder").mkdir()
    names = ("empty.mcap", "photo.mcap", "notes.txt", "zeros.mcap", "folder", "nowhere.mcap")
    for name in names:
        for how in ([], ["--data"]):
            refused(w, "ingest", tmp_path / name, *how, holds=[name])


def test_a_trial_of_another_robot_clock_task_or_workspace(w, trial, tmp_path):
    refused(w, "ingest", w / "candidates" / "c0001.mcap", holds=["c0001.mcap", "candidate"])
    refused(w, "ingest", trial, "--candidate", "c0002", holds=["c0002"])
    refused(w, "ingest", trial, "--candidate", "c0001", "--data", holds=["--data"])
    other = make(tmp_path / "o", "pendulum").folder
    for more in ([], ["--data"]):
        refused(other, "ingest", trial, *more, holds=["states"])
    half = CONFIG.replace("dt = 0.05", "dt = 0.025").replace("horizon = 40", "horizon = 20")
    rows = "\n".join(f"{0.025 * i:.3f},0.0" for i in range(21))
    slow = make(tmp_path / "slow", config=half, target="t,x\n" + rows + "\n").folder
    refused(slow, "ingest", trial, holds=["0.05 s", "dt", "0.025 s"])
    twin = make(tmp_path / "twin").folder
    refused(twin, "ingest", trial, holds=["--data"])  # it never proposed that
    heavier = make(tmp_path / "heavier", model=MODEL.replace("Param(1.0", "Param(2.0")).folder
    grounded("-C", heavier, "propose")
    refused(heavier, "ingest", trial, holds=[trial.name, "c0001"])
    assert grounded("-C", twin, "ingest", trial, "--data").code == 0
    config = (w / "grounded.toml").read_text()
    (w / "grounded.toml").write_text(config.replace("x = 10.0", "x = 11.0"))
    refused(w, "ingest", trial, holds=["earlier task", "--data"])
    kept = grounded("-C", w, "ingest", trial, "--data", "--json").json["trials"][0]
    assert kept["candidate"] is None and kept["utility"] is None


def rewritten(trial, path, change):
    """The same trial with other arrays."""
    from dataclasses import replace

    from grounded_trials.store.trial_file import read_trial, write_trial

    found, meta, policy = read_trial(trial)
    states, inputs = change(np.array(found.states), np.array(found.inputs))
    keep = {k: meta[k] for k in ("kind", "iteration", "alpha", "task")}
    write_trial(path, replace(found, states=states, inputs=inputs), keep, policy)
    return path


def lost(k, of, values):
    return np.where((np.arange(of) >= k)[:, None], np.nan, values)


# what is done to states and inputs, and what the warning names; those before None failed
RUNS = {
    "short": (lambda s, u: (s[:21], u[:20]), ["20", "40"]),
    "nothing": (lambda s, u: (s[:1], u[:0]), ["0", "40"]),
    "nan": (lambda s, u: (lost(10, 41, s), u), ["x", "0.500 s"]),
    "nan at once": (lambda s, u: (lost(0, 41, s), u), ["x", "start"]),
    "input lost": (lambda s, u: (s, lost(7, 40, u)), ["force", "0.350 s"]),
    "gap": (
        lambda s, u: (np.where((np.arange(41) // 5 == 2)[:, None], np.nan, s), u),
        ["10", "x", "0.500 s"],
    ),
    "far start": (lambda s, u: (s + np.array([0.5, 0.0]), u), ["x"]),
    "beyond limits": (lambda s, u: (s, u * 0 + 9.0), ["force", "[limits]"]),
    "late": (lambda s, u: (s, np.vstack([u[:1], u[:-1]])), ["1 step"]),
    "longer": (lambda s, u: (np.vstack([s, s[-3:]]), np.vstack([u, u[-3:]])), []),
}
FAILED = ("short", "nothing", "nan", "nan at once", "input lost")


@pytest.mark.parametrize("name", RUNS)
def test_a_run_that_went_wrong_is_stored_with_a_warning_and_the_search_goes_on(w, trial, name):
    change, parts = RUNS[name]
    path = rewritten(trial, w / "runs" / "wrong.mcap", change)
    named = ("--candidate", "c0001") if name in ("far start", "beyond limits") else ()
    done = grounded("-C", w, "ingest", path, "--json", *named)
    assert done.code == 0, done.err
    (found,) = done.json["trials"]
    assert holds(" ".join(found["warnings"]), *parts)
    failed = name in FAILED
    assert found["failed"] == failed and (found["utility"] is None) == failed
    assert found["accepted"] == (not failed)
    following = grounded("-C", w, "propose", "--json")
    assert following.code == 0 and following.json["candidate"] == "c0002", following.err
    assert grounded("-C", w, "learn", "--trials", "1").code == 0


MODELS = {  # the text of model.py, and what the message names
    "syntax": (MODEL.replace("return {", "return {{"), ["model.py", "7"]),
    "raises": (MODEL + "\nraise RuntimeError('no battery')\n", ["18", "no battery"]),
    "exits": (MODEL + "\nimport sys; sys.exit(3)\n", ["SystemExit"]),
    "import": ("import no_such_module\n" + MODEL, ["'no_such_module'", "1"]),
    "missing state": (MODEL.replace('"x": s.v, ', ""), ["model.py", "x"]),
    "typo": (MODEL.replace('"x": s.v', '"xx": s.v'), ["model.py", "'xx'"]),
    "unknown state": (MODEL.replace('"x": s.v', '"x": s.w'), ["model.py", "'w'"]),
    "unknown param": (MODEL.replace("p.drag", "p.darg"), ["model.py", "darg", "drag"]),
    "wrong return": (MODEL.replace("return {", "return 3, {"), ["model.py", "dict"]),
    "returns none": (MODEL.replace("return {", "{"), ["model.py", "NoneType"]),
    "a text": (MODEL.replace('"x": s.v', '"x": "fast"'), ["model.py"]),
    "complex": (MODEL.replace('"x": s.v', '"x": 1j'), ["model.py"]),
    "in the function": (MODEL.replace("    return {", "    raise ValueError('no')\n    {"), ["no"]),
    "declared twice": (MODEL.replace('"v": "m/s"}', '"v": "m/s", "mass": "kg"}'), ["mass"]),
    "random": (MODEL.replace('"x": s.v', '"x": s.v + np.random.normal()'), ["model.py"]),
    "bytes": ("\x00\x01", ["model.py"]),
}


@pytest.mark.parametrize("name", MODELS)
def test_a_model_that_is_wrong_is_one_sentence_with_its_line(tmp_path, name):
    text, parts = MODELS[name]
    folder = make(tmp_path / "w", model=text).folder
    done = grounded("-C", folder, "propose")
    assert done.code == 1, done.out + done.err
    assert "Traceback" not in done.err and done.err.startswith("error: "), done.err
    assert done.err.strip().count("\n") == 0 and len(done.err) < 500, done.err
    assert holds(done.err, *parts), done.err
    assert not list((folder / "candidates").iterdir())


@pytest.mark.parametrize(("rate", "why"), [("1 / 0", "ZeroDivision"), ("s.v * np.nan", "finite")])
def test_a_model_without_numbers_proposes_nothing_and_says_why(tmp_path, rate, why):
    folder = make(tmp_path / "w", model=MODEL.replace('"x": s.v', f'"x": {rate}')).folder
    done = grounded("-C", folder, "propose")
    said = " ".join((done.out + done.err).split())
    assert done.code == 1 and "Traceback" not in said and why in said
    assert not list((folder / "candidates").iterdir())


GRID = "".join(f"{0.05 * i:.2f},0,1\n" for i in range(41))
TARGETS = {  # the text of target.csv, and what the message names
    "empty": ("", []),
    "header": ("t,x\n", []),
    "no t": ("x,t\n0,0\n", ["t", "'x'"]),
    "unknown": ("t,xx\n0,0\n", ["'xx'", "'x'"]),
    "text": ("t,x\n0,fast\n", ["line 2", "'fast'", "'x'"]),
    "nan": ("t,x\n0,nan\n", ["line 2", "nan", "'x'"]),
    "ragged": ("t,x\n0,0\n0.05\n", ["line 3"]),
    "short": ("t,x\n0,0\n0.05,0\n", ["41", "horizon = 1"]),
    "twice": ("t,x,x\n" + GRID, ["'x'"]),
    "grid": ("t,x\n" + "".join(f"{0.04 * i},0\n" for i in range(41)), ["0.05 s", "0.04"]),
    "semicolons": ("t;x\n0;0\n", ["'t;x'"]),
    "binary": ("\x00\x00", []),
}


@pytest.mark.parametrize("name", TARGETS)
def test_a_target_that_is_wrong_names_line_and_column(tmp_path, name):
    text, parts = TARGETS[name]
    folder = make(tmp_path / "w", target=text).folder
    done = grounded("-C", folder, "propose")
    assert done.code == 1 and "Traceback" not in done.err
    assert holds(done.err, "target.csv", *parts), done.err


DRIVE = """import sys

import numpy as np
from grounded_trials.store.trial_file import TrialWriter
from grounded_trials.store.candidate_file import read_candidate

from grounded.onboard import Runner

policy, _, _, meta = read_candidate(sys.argv[1])
runner = Runner(policy)
x = np.zeros(2)
with TrialWriter(
    sys.argv[2], policy.dt, {"x": "m", "v": "m/s"}, {"force": "N"}, {"task": meta["task"]},
    candidate=meta["id"],
) as trial:
    for k in range(policy.horizon):
        u = runner.action(k * policy.dt, x)
        trial.append(k * policy.dt, x, u)
        x = x + policy.dt * np.array([x[1], (u[0] - 0.5 * x[1]) / 1.4])
    trial.append(policy.horizon * policy.dt, x, None)
print("drove", meta["id"])
"""


def with_command(tmp_path, command, drive=DRIVE):
    config = CONFIG.replace('model = "real.py"', f"command = '{command}'")
    folder = make(tmp_path / "w", config=config).folder
    (folder / "drive.py").write_text(drive)
    return folder


@pytest.mark.slow
def test_the_users_own_command_end_to_end(tmp_path):
    folder = with_command(tmp_path, f"{sys.executable} drive.py {{candidate}} {{trial}}")
    done = process("-C", folder, "learn", "--trials", "3", "--json")
    assert done.code == 0, done.err
    assert done.json["trials"] == 3 and len(done.json["utilities"]) >= 2
    assert "drove c0001" in done.err  # its output is narration
    assert done.json["utilities"][-1] > done.json["utilities"][0]


COMMANDS = {  # [system] command, and what the message names
    "fails": ("python3 -c 'import sys; sys.exit(7)' {candidate} {trial}", ["7"]),
    "writes nothing": ("true {candidate} {trial} {speed} { }", ["trial"]),
    "not there": ("no_such_program {candidate} {trial}", ["no_such_program"]),
    "no {trial}": ("true {candidate}", ["{trial}"]),
    "no {candidate}": ("true {trial}", ["{candidate}"]),
    "unbalanced": ('true "{candidate} {trial}', ["[system] command"]),
    "none": ("", ["{candidate} {trial}"]),  # what to do is said
}


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_that_does_not_work_is_one_sentence(tmp_path, name):
    command, parts = COMMANDS[name]
    system = f"command = '''{command}'''" if command else ""
    config = CONFIG.replace('model = "real.py"', system)
    folder = make(tmp_path / "w", config=config).folder
    grounded("-C", folder, "propose")
    done = grounded("-C", folder, "run")
    assert done.code == 1 and "Traceback" not in done.err, done.err
    message = done.err[done.err.index("error: ") :]
    assert all(part in message for part in parts), done.err


def test_a_crash_of_the_users_drive_leaves_a_trial_that_says_how_far_it_came(tmp_path):
    stop = "        if k == 30:\n            raise OSError('motor')\n        x = x +"
    crash = DRIVE.replace("        x = x +", stop)
    command = f"{sys.executable} drive.py {{candidate}} {{trial}}"
    folder = with_command(tmp_path, command, crash)
    grounded("-C", folder, "propose")
    done = process("-C", folder, "run")
    (left,) = (folder / "runs").iterdir()
    assert done.code == 1 and "exit code 1" in done.err and left.name in done.err
    taken = grounded("-C", folder, "ingest", left, "--json")
    assert taken.code == 0 and taken.json["trials"][0]["failed"]
    assert holds(taken.json["trials"][0]["warnings"][0], 30, 40)


def test_strange_files_in_the_workspace_disturb_nothing(w, trial):
    assert grounded("-C", w, "ingest", trial).code == 0
    for path in ("candidates/c0001 (copy).mcap", "candidates/notes.txt", "candidates/cold.mcap"):
        (w / path).write_bytes((w / "candidates" / "c0001.mcap").read_bytes())
    (w / "candidates" / "c12.mcap").mkdir()
    (w / "trials" / "README").write_text("mine")
    (w / "trials" / "t0009-copy.mcap").write_text("mine")
    done = grounded("-C", w, "propose", "--json")
    assert done.code == 0 and done.json["candidate"] == "c0002"
    assert grounded("-C", w, "status").code == 0


def test_a_damaged_candidate_says_what_to_do(w, trial):
    grounded("-C", w, "ingest", trial)
    path = w / "candidates" / "c0001.mcap"
    path.write_bytes(path.read_bytes()[:500])
    done = grounded("-C", w, "propose")
    assert done.code == 1 and "c0001" in done.err and "Traceback" not in done.err
    path.unlink()
    assert grounded("-C", w, "propose").code == 0


def test_trials_may_be_given_as_a_list_with_commas_and_twice(learnt):
    before = len(list((learnt / "trials").glob("n*.json")))
    done = grounded("-C", learnt, "discard", "t0001,t0002", "T0001", "--json")
    assert done.code == 0 and list(done.json["trials"]) == ["t0001", "t0002"]
    assert len(list((learnt / "trials").glob("n*.json"))) == before + 2  # one note each
    done = grounded("-C", learnt, "restore", "t0001,t0002", "--json")
    assert list(done.json["trials"]) == ["t0001", "t0002"] and not done.json["discarded"]


# words at a workspace whose search has ended, the exit code, and what the message names
SLIPS = [
    (["adopt", "delay"], 1, "'delay:force'"),
    (["status", "-C", "grounded.toml"], 1, "-C"),
    (["ingest", "."], 1, "workspace"),
    (["ingest", "model.py"], 1, "model.py"),
    (["diagnose", "--trials", "t9,"], 1, "t0001"),
    (["diagnose", "--without", "delay,delai"], 1, "'delay'"),
    (["diagnose", "--trials", " , "], 1, "--trials"),
    (["fit", "--params", ","], 1, "--params"),
    (["recover", "trials"], 1, "folder"),
    (["recover", "model.py"], 1, "model.py"),
    (["ingest", "nofile.mcap"], 1, "nofile.mcap"),
    (["ingest", "no/nofile.mcap"], 1, "folder no"),
    (["inspect", "nowhere.mcap"], 1, "nowhere.mcap"),
    (["export", "best", "--format", "csv", "-o", "x.npz"], 2, "--format"),
    (["target", "line", "--to", "x=1", "--seconds", "1e9"], 1, "200000"),
    (["target", "step", "--hold", "1"], 2, "--hold"),
    (["target", "circle", "--seconds", "1"], 2, "--seconds"),
    *(
        (["target", "line", "--to", f"x={value}", "--seconds", "2"], 2, f"x={value}")
        for value in ("nan", "-inf", "fast", "")
    ),
]


@pytest.mark.parametrize(("words", "code", "named"), SLIPS)
def test_a_mistake_is_named(learnt, monkeypatch, words, code, named):
    monkeypatch.chdir(learnt)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        done = grounded(*words)
    assert done.code == code and named in " ".join(done.err.split()), done.err
    assert "Errno" not in done.err and "nan" not in done.err.replace("x=nan", "")


def test_nothing_was_diagnosed_yet(tmp_path):
    done = grounded("-C", make(tmp_path / "w").folder, "adopt", "x:y")
    assert done.code == 1 and plain(done.err).endswith("next: grounded diagnose\n")


def test_the_best_one_is_run_again_by_that_name(learnt, tmp_path):
    here = Workspace(learnt)
    best = here.status().standing.incumbent.candidate.id
    ran = here.run("best")
    assert ran.candidate == best and here.ingest(ran.trial_file).verdict == "run again"
    assert grounded("-C", make(tmp_path / "empty").folder, "run", "best").code == 1


def test_a_stored_trial_its_file_and_its_table_are_targets(learnt):
    table, (own,) = learnt / "t0001.csv", (learnt / "trials").glob("t0001-*.mcap")
    assert grounded("-C", learnt, "export", "t0001", "--format", "csv", "-o", table).code == 0
    ran = read_trial(own)[0].states
    for given in ("T0001", own, table):
        (learnt / "target.csv").write_text("")
        done = grounded("-C", learnt, "target", given, "--json")
        assert done.code == 0 and sorted(done.json["columns"]) == ["v", "x"], done.err
        drawn = np.genfromtxt(learnt / "target.csv", delimiter=",", names=True)
        np.testing.assert_allclose(drawn["x"], ran[:, 0], atol=1e-5)
    assert grounded("-C", learnt, "discard", "t0001").code == 0
    done = grounded("-C", learnt, "target", "t0001")
    assert done.code == 1 and "restore" in done.err


@pytest.mark.parametrize("changed", [True, False])
def test_nothing_is_adopted_from_two_robots_compared(learnt, changed):
    value = {"value": 0.1, "std": 0.01}
    one = {"effect": "parameter:m", "quantity": "m", "first": value, "second": value}
    made = {"trials": ["t0001", "t0002"], "named": ["t0002"], "compared": ["t0001"]}
    document = {**DIAGNOSIS, "changed": [one] * changed, "diagnosed": made}
    write_document(learnt / "reports" / "diagnosis.json", document)
    before = (learnt / "grounded.toml").read_text()
    done = grounded("-C", learnt, "adopt", "viscous_friction:v")
    assert done.code == changed and ((learnt / "grounded.toml").read_text() == before) == changed
