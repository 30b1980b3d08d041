"""How far a run is off its target; candidates of a diagnosis; a system that repeats itself."""

import math
import sys
from dataclasses import replace

import numpy as np
import pytest

from cli import grounded
from grounded import Model, Task, Trial
from grounded.effects import Library
from grounded.errors import GroundedError, NextCommand
from grounded.result import measured_alike
from grounded.task import Reward
from grounded_trials import Workspace
from grounded_trials.report.gathering import gather
from grounded_trials.report.tables import improved
from grounded_trials.workspace.candidates.handover import checked_candidate
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.last_diagnosis import read_diagnosis
from grounded_trials.workspace.next_step import to_run
from grounded_trials.workspace.off_target import off_target_of
from reported import copied
from workspaces import CONFIG, MODEL, edit, make

NAMES = ("x", "y", "psi", "v")
ROVER = Model(
    states=dict(zip(NAMES, ("m", "m", "rad", "m/s"), strict=True)),
    inputs={"turn": "rad/s", "push": "m/s^2"},
    angles=("psi",),
    roles={"position": ("x", "y")},
    derivative=lambda s, a, p: {"x": s.v, "y": 0 * s.v, "psi": a.turn, "v": a.push},
)
H, DT = 20, 0.1


def task(state=(0, 0, 0, 0), terminal=(0, 0, 0, 0)):
    """To stay at zero; the speed is free."""
    target = np.zeros((H + 1, 4))
    target[:, 3] = np.nan
    weights = Reward(np.array(state, float), np.array(terminal, float), np.ones(2), np.ones(2))
    limits = {"low": np.full(2, -1.0), "high": np.ones(2)}
    return Task(ROVER, DT, target, weights, start=np.zeros(4), past=np.zeros(2), **limits)


def run(states):
    names = (ROVER.state_names, ROVER.input_names)
    return Trial(states, np.zeros((len(states) - 1, 2)), DT, *names)


def off(x=0.0, y=0.0, psi=0.0, steps=H):
    states = np.zeros((steps + 1, 4))
    states[:, 0], states[:, 1], states[:, 2] = x, y, psi
    return states


ALONG = (1, 1, 0.1, 0)


def test_the_position_is_one_distance_and_angles_are_wrapped():
    states = off(0.003, 0.004, 2 * np.pi - 0.01)
    states[15, :2] = (0.03, 0.04)
    position, psi = off_target_of(task(ALONG), [run(states)])
    assert (position.what, position.unit) == ("position", "m")
    assert position.most == pytest.approx(0.05) and position.at_s == pytest.approx(1.5)
    assert position.rms == pytest.approx(math.sqrt((20 * 0.005**2 + 0.05**2) / 21))
    assert math.isnan(position.end)
    assert (psi.what, psi.most) == ("psi", pytest.approx(0.01))


def test_status_and_ingest_say_the_number_of_the_page(cart, tmp_path):
    folder = copied(cart, tmp_path / "cart")
    w = Workspace(folder)
    (told, *_) = w.status().off_target
    (first, *_) = off_target_of(w.task, [w.trials()[0].trial])
    rows = dict(map(reversed, improved(gather(Folder(folder)))))
    both = measured_alike([first.rms, told.rms], told.unit)
    assert rows[f"{told.what} off target, rms"] == " -> ".join(both)
    document = w.status().to_json()["best"]["off_target"][0]
    assert (document["what"], document["rms"]) == (told.what, pytest.approx(told.rms))
    best = w.trials()[-1]
    again = w.ingest(best.stored.path)
    assert again.off_target == off_target_of(w.task, [best.trial])
    assert again.to_json()["off_target"][0]["unit"] == told.unit


def test_propose_says_how_far_the_predicted_run_is_off(cart, tmp_path):
    folder = copied(cart, tmp_path / "cart")
    w = Workspace(folder)
    way = np.linspace(0, 1, w.task.horizon + 1)
    w.target({"x": 0.3 * way**2 * (3 - 2 * way)})
    proposed = w.propose()
    target = w.task.target[:, 0]
    error = np.abs(proposed.candidate.predicted_states[:, 0] - target)
    told = next(one for one in proposed.off_target if one.what == "x")
    assert told.rms == pytest.approx(np.sqrt(np.mean(error**2))) and told.most == error.max() > 0
    assert proposed.to_json()["off_target"][0]["what"] == "x"


DRIVE = """
import sys
from grounded.plant import Plant
from grounded_trials.store.candidate_file import read_candidate
from grounded_trials.store.trial_file import write_trial
from grounded_trials.workspace.user_files.model_file import load_module, model_in
from dataclasses import replace
from pathlib import Path
import numpy as np

candidate, trial = map(Path, sys.argv[1:])
policy, _, _, meta = read_candidate(candidate)
model = model_in(load_module(Path("."), file="real.py", key="real"))
start, rng = {"x": 0.0, "v": 0.0}, np.random.default_rng(0)
ran = Plant(model, latency={"force": 0.02}).run(policy, start, rng)
about = {"kind": "trial", "task": meta["task"]}
units = {"state_units": {"x": "m", "v": "m/s"}, "input_units": {"force": "N"}}
made = replace(ran, candidate=meta["id"])
write_trial(trial, made, about, policy=candidate.read_bytes(), **units)
"""


EARLY = "tolerance = 0.02"  # the end comes after few trials, each a process


@pytest.fixture
def workspace(tmp_path):
    system = CONFIG[CONFIG.index("[system]") :]
    command = f'[system]\ncommand = "{sys.executable} drive.py {{candidate}} {{trial}}"\n'
    folder = make(tmp_path / "w", config=CONFIG.replace(system, command)).folder
    (folder / "drive.py").write_text(DRIVE)
    return Workspace(folder)


def test_learn_ends(workspace, repeats=2):
    config = workspace.folder / "grounded.toml"
    more = f"max_trials = 12\nrepeats = {repeats}\n{EARLY}"
    config.write_text(config.read_text().replace("max_trials = 12", more))
    status = workspace.learn()
    assert status.standing.phase == "converged" and status.standing.ending
    assert status.standing.trials < 12


def test_run_and_ingest_by_hand_end_too_and_an_old_file_is_no_repeat(workspace):
    config, files = workspace.folder / "grounded.toml", []
    config.write_text(config.read_text().replace("max_trials = 12", f"max_trials = 12\n{EARLY}"))
    for _ in range(12):
        if workspace.propose().candidate is None:
            break
        ran = workspace.run()
        workspace.ingest(ran.trial_file)
        again = workspace.ingest(ran.trial_file)  # the same file twice is one trial
        assert again.known
        files.append(ran.trial_file)
    assert workspace.propose().candidate is None
    assert workspace.status().standing.trials == len(files)


def test_learn_stops_at_a_trial_in_other_units_and_goes_on_where_it_is_asked_again(workspace):
    drive = workspace.folder / "drive.py"
    drive.write_text(
        DRIVE.replace("candidate=meta", "states=ran.states * [1000, 1], candidate=meta")
    )
    told = []
    status = workspace.learn(each=lambda _, found: told.append(found))
    (first,) = told
    assert first.faults and {*first.faults} <= {*first.warnings}
    assert status.then == first.then == NextCommand("discard", (first.trial,))
    assert any("learn stops here" in note for note in status.notes)
    workspace.learn(2, each=lambda _, found: told.append(found))
    assert len(told) == 3


FEW = Library(tuple(map(Library().family, ("viscous_friction", "input_gain", "delay"))))
TIE = ("delay:force", "input_gain:force")
NOISY = CONFIG + "[system.noise.measurement]\nx = 0.02\nv = 0.05\n"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A noisy cart after three trials, and its diagnosis."""
    w = Workspace(make(tmp_path_factory.mktemp("w") / "w", config=NOISY).folder)
    w.learn(3)
    return w.folder, w.diagnose(library=FEW)


@pytest.fixture
def diagnosed(made, tmp_path, monkeypatch):
    """A copy of it in which `diagnose` finds that again, with a tie that any probe tells."""
    folder, found = made
    tied = replace(found, indistinguishable=(TIE,), equivalent=())
    monkeypatch.setattr("grounded_trials.workspace.diagnosing.diagnose", lambda *_, **__: tied)
    monkeypatch.setattr("grounded.search.design.NATS", 0.0)
    w = Workspace(copied(folder, tmp_path / "w"))
    return w, w.diagnose(library=FEW)


@pytest.mark.slow
def test_every_probe_that_is_offered_is_handed_over(diagnosed):
    w, found = diagnosed
    assert found.probe
    reached = w.candidate(found.probe)[0].predicted_states[:, 0]
    handed = []
    for room in (0.5, 0.05, 0.0):
        edit(w.folder, safety=f"x = [-1.0, {reached.max() + room}]")
        if identity := w.diagnose(library=FEW).probe:
            handed.append(checked_candidate(w, identity))
    assert len(handed) >= 2 and all(one.overridden == () for one in handed)
    edit(w.folder, safety=f"x = [{reached.min() - 0.01}, {reached.max() + 0.5}]")
    assert w.diagnose(library=FEW).probe == ""


def test_people_export_a_probe(diagnosed, tmp_path):
    w, found = diagnosed
    assert to_run(w, found.probe, found.probe) == NextCommand("run", (found.probe,))
    bare = make(tmp_path / "bare", config=CONFIG.partition("[system]")[0])
    assert to_run(bare, "c0004", "c0004") == NextCommand("export", ("c0004", "--runner"))


def test_without_safety_a_probe_stays_near_where_trials_have_been(diagnosed):
    w, found = diagnosed
    been = np.vstack([trial.states for trial in w.task_trials()])
    room = 0.5 * np.ptp(been, axis=0) + 1e-9
    made = w.candidate(found.probe)[0].predicted_states
    assert (made > been.min(axis=0) - room).all() and (made < been.max(axis=0) + room).all()


def test_a_probe_that_fails_costs_no_diagnosis(diagnosed, monkeypatch, caplog):
    w, before = diagnosed

    def broken(*args):
        raise KeyError("lag_1")

    monkeypatch.setattr("grounded_trials.workspace.diagnosing.probe", broken)
    found = w.diagnose(library=FEW)
    assert found.verdict == before.verdict and found.probe == ""
    assert caplog.records[-1].exc_info[0] is KeyError  # the traceback of our mistake is not lost
    kept = read_diagnosis(w.reports)
    assert kept is not None and kept.next_trial == found.next_trial


BARE = CONFIG.replace('target = "target.csv"\n', "").replace("state = { x = 10.0 }\n", "")
SAFE = BARE + "\n[safety]\nx = [-2.0, 2.0]\n"


def codes(done):
    return [one["code"] for one in done["findings"]]


def test_from_a_bare_model_to_fitted_values(tmp_path):
    w = make(tmp_path / "w", config=SAFE).folder
    made = grounded("-C", w, "excite", "--seconds", "5", "--json").json
    assert made["seconds"] == 5.0 and not made["feedback"] and codes(made) == []
    for one in made["parameters"].values():
        assert one["std_after"] < 0.1 * one["std"]
    ran = grounded("-C", w, "run", made["candidate"], "--json").json
    assert grounded("-C", w, "ingest", ran["trial_file"]).code == 0
    fitted = grounded("-C", w, "fit", "--json").json["params"]
    assert fitted["mass"]["value"] == pytest.approx(1.4, rel=0.2)  # its latency is not in the model
    assert grounded("-C", w, "fit", "--apply").code == 0  # what is known better is begun with
    again = grounded("-C", w, "excite", "--seconds", "5", "--json").json["parameters"]["mass"]
    assert again["std"] < 0.1 * made["parameters"]["mass"]["std"]
    csv = grounded("-C", w, "export", made["candidate"], "-o", tmp_path / "drive.csv")
    assert csv.code == 0 and (tmp_path / "drive.csv").read_text().count("\n") > 100


CERTAIN = MODEL.replace(', "kg", 0.1, 10.0', "").replace(', "N s/m", 0.0, 5.0', "")
STUCK = MODEL.replace("a.force", "0.0 * a.force")


@pytest.mark.parametrize(
    ("files", "seconds", "code"),
    [
        ({"config": BARE}, None, "plan.no_drive"),
        ({"config": SAFE.replace("force = [-5.0, 5.0]", "")}, None, "plan.no_limits"),
        ({"config": SAFE, "model": CERTAIN}, None, "given.constant"),
        ({"config": SAFE, "model": STUCK}, None, "plan.without_effect"),
        ({"config": SAFE}, 0.01, "given.value"),
        ({"config": SAFE + "v = [0.5, 0.6]\n"}, None, "plan.no_drive"),
    ],
)
def test_what_is_missing_is_told(tmp_path, files, seconds, code):
    w = Workspace(make(tmp_path / "w", **files).folder)
    with pytest.raises(GroundedError) as refused:
        w.excite(seconds)
    assert refused.value.finding.code == code
