"""Damaged and lacking logs: what is lost is said; no commands, nothing to use, a step at once."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from cli import grounded, plain
from facts import holding, holds, of_code
from grounded.errors import GroundedError
from grounded_trials import Workspace
from grounded_trials.logs.inspection.inspect_log import inspect_log
from grounded_trials.logs.recover import recover_log
from grounded_trials.starting.begin import begin
from reported import copied
from ros_bags import START, T, bag, joints
from shared_data import DATA, needs_data


@pytest.fixture
def trial(cart, tmp_path):
    """A trial of 40 steps as the store has it, in a folder of its own."""
    (path,) = copied(cart, tmp_path / "w").glob("trials/t0001-*")
    target = tmp_path / "run.mcap"
    target.write_bytes(path.read_bytes())
    return target


def words(done):
    return " ".join((done.out + done.err).split())


def test_a_trial_that_was_cut_off_is_counted_in_messages(trial, tmp_path):
    data = trial.read_bytes()
    trial.write_bytes(data[: int(0.9 * len(data))])
    done = grounded("recover", trial, "-o", tmp_path / "s.mcap")
    found = grounded("recover", trial, "-o", tmp_path / "t.mcap", "--json")
    assert done.code == found.code == 3
    assert 20 < found.json["messages"]["/state"] < 41
    assert re.search(r"\bbyte \d+", done.err)
    assert re.search("^next: grounded ingest --data", done.out, re.M)
    assert max(map(len, (done.out + done.err).splitlines())) <= 80 + len(str(tmp_path))


def test_a_trial_whose_index_is_missing_lost_nothing(trial, tmp_path):
    trial.write_bytes(trial.read_bytes()[:-20])
    done = grounded("recover", trial, "-o", tmp_path / "s.mcap")
    assert done.code == 3 and "index" in words(done)
    assert "/state: 41" in done.out and re.search("^next: grounded ingest [^-]", done.out, re.M)


def test_a_trial_with_a_hole_is_refused_where_it_is_ingested(cart, trial, tmp_path):
    data = bytearray(trial.read_bytes())
    found = None
    for at in range(len(data) // 2, len(data), 200):  # until a block in the middle is hit
        bad = bytearray(data)
        bad[at] ^= 0xFF
        trial.write_bytes(bytes(bad))
        done = grounded("recover", trial, "-o", tmp_path / f"{at}.mcap")
        if done.code == 3 and re.search(r"second \d+\.\d+ to \d+\.\d+", words(done)):
            found = done
            break
    assert found is not None and " lost" in found.out
    refused = grounded("-C", cart, "ingest", "--data", tmp_path / f"{at}.mcap")
    assert refused.code == 1 and f"{at}.mcap" in refused.err and "[log]" not in refused.err


@needs_data
def test_a_foreign_log_says_which_seconds_are_gone(tmp_path):
    assert DATA is not None
    (path,) = Path(DATA).glob("mcap_format_fixtures/derived_corrupt/dart_fast_bitrot_chunk3.mcap")
    done = grounded("recover", path, "-o", tmp_path / "s.mcap")
    assert done.code == 3 and "12.11 to 18.22" in done.err
    assert "/vicon/jetracer1: 2617, 610 lost" in done.out
    assert "next: grounded inspect" in done.out


def test_what_is_no_log_is_said_to_be_none(tmp_path):
    (tmp_path / "notes.mcap").write_text("it drove well")
    done = grounded("recover", tmp_path / "notes.mcap")
    assert done.code == 1 and holds(done.err, "notes.mcap")
    folder = grounded("recover", tmp_path)
    assert folder.code == 1 and holds(folder.err, "folder")
    nowhere = grounded("recover", tmp_path / "nowhere.mcap")
    assert nowhere.code == 1 and "nowhere.mcap" in nowhere.err


def test_a_sound_file_is_called_so(trial, tmp_path):
    done = grounded("recover", trial, "-o", tmp_path / "s.mcap")
    assert done.code == 0 and "s.mcap" in done.out and not done.err


def test_a_candidate_is_written_again_rather_than_repaired(cart, tmp_path):
    path = copied(cart, tmp_path / "w") / "candidates" / "c0001.mcap"
    path.chmod(0o644)
    path.write_bytes(path.read_bytes()[:-500])
    done = grounded("recover", path)
    assert done.code == 3 and re.search("^next: grounded propose", plain(done.out), re.M)


MODEL = """import grounded as gr

model = gr.Model(
    states={"boom": "rad", "stick": "rad", "boom_rate": "rad/s", "stick_rate": "rad/s"},
    inputs={"boom_valve": "1", "stick_valve": "1"},
    params={"k": gr.Param(0.6, "rad/s", 0.3, 1.2)},
    derivative=lambda s, a, p: {
        "boom": s.boom_rate,
        "stick": s.stick_rate,
        "boom_rate": 7 * (p.k * a.boom_valve - s.boom_rate),
        "stick_rate": 7 * (p.k * a.stick_valve - s.stick_rate),
    },
)
"""


COMMANDS = "/valve_controller/commands"
NAMES = ["boom_joint", "stick_joint"]


def excavator(folder, commands=True):
    """An arm of two joints for 6 s; its commands may be missing."""
    topic = "/joint_states"
    topics = {topic: "sensor_msgs/msg/JointState", COMMANDS: "std_msgs/msg/Float64MultiArray"}
    layout = T["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)

    def messages():
        q, w = np.array([0.3, -1.2]), np.zeros(2)
        for k in range(600):
            t = START + k * 10**7
            u = 0.5 * np.sin(np.array([0.02, 0.031]) * k)
            yield topic, t, joints(t, NAMES, q, w, np.zeros(2))
            if commands and k % 2 == 0:
                yield COMMANDS, t, T[topics[COMMANDS]](layout=layout, data=u)
            w = w + 0.07 * (0.6 * u - w)
            q = q + 0.01 * w

    return bag(folder, topics, messages())


@pytest.fixture
def model(tmp_path):
    (tmp_path / "own.py").write_text(MODEL)
    return tmp_path / "own.py"


def test_joint_positions_are_no_commands_if_these_were_not_recorded(tmp_path, model):
    log = excavator(tmp_path / "bag", commands=False)
    begun = begin(tmp_path / "w", log, model=model)
    assert [s.path for s in begun.states][:2] == [f"/joint_states.position[{i}]" for i in (0, 1)]
    assert [guess.path for guess in begun.inputs] == ["", ""]
    assert not any(one.sure or "joint_states" in str(one.others) for one in begun.inputs)
    assert all(one.reasons[-1].about == (COMMANDS,) for one in begun.inputs)
    assert begun.then.verb == "inspect"


def test_ingest_refuses_an_input_on_the_path_of_a_state(tmp_path, model):
    begin(tmp_path / "w", log := excavator(tmp_path / "bag"), model=model)
    toml = tmp_path / "w" / "grounded.toml"
    toml.write_text(toml.read_text().replace(f"{COMMANDS}.data[0]", "/joint_states.position[0]"))
    with pytest.raises(GroundedError, match=r"state\.boom\].*input\.boom_valve\]"):
        Workspace(tmp_path / "w").ingest(log, data=True)


@pytest.mark.parametrize("name", ["run.mcap", "run.csv", "run.db3", "run.npz", "run.bag", "run"])
def test_a_file_without_a_byte_is_called_empty(tmp_path, name):
    log = tmp_path / name
    log.write_bytes(b"")
    with pytest.raises(GroundedError, match=holding(name)):
        inspect_log(log)
    with pytest.raises(GroundedError, match=holding(name)):
        recover_log(log, tmp_path / "out.mcap")
    assert sorted(p.name for p in tmp_path.iterdir()) == [name]


def test_a_recovered_log_is_an_mcap_file_in_a_folder_that_exists(tmp_path):
    (tmp_path / "run.mcap").write_bytes(b"x" * 100)
    for target in ("out.csv", "nix/out.mcap"):
        with pytest.raises(GroundedError, match=r"\.mcap|folder does not exist"):
            recover_log(tmp_path / "run.mcap", tmp_path / target)
        assert not (tmp_path / target).exists()


@pytest.mark.parametrize(
    ("rows", "named"),
    [(["t,mode", "0,auto", "0.1,man", "0.2,man"], "mode"), (["t", "0", "0.1", "0.2"], "run.csv")],
)
def test_init_writes_nothing_for_a_log_without_numbers(tmp_path, rows, named):
    log = tmp_path / "run.csv"
    log.write_text("\n".join(rows) + "\n")
    done = grounded("init", tmp_path / "w", "--from", log)
    assert done.code == 1 and "holds no numbers" in plain(done.err) and named in done.err
    assert not (tmp_path / "w").exists()


STEPPED = """from grounded import Model, Param

model = Model(
    states={"T": "degC"},
    inputs={"Q1": "1"},
    params={"gain": Param(0.6, "degC", 0.1, 2.0), "tau": Param(150.0, "s", 20.0, 500.0)},
    derivative=lambda s, a, p: {"T": (23.0 + p.gain * a.Q1 - s.T) / p.tau},
)
"""


@pytest.fixture
def heater(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Workspace:
    """A heater at 50 % from its log's first row on, later at 20 %."""
    monkeypatch.chdir(tmp_path)
    t = np.arange(300.0)
    Q1, T = np.where(t < 200, 50.0, 20.0), np.full(300, 23.0)
    for i in range(1, 300):
        T[i] = T[i - 1] + (23 + 0.6 * Q1[i - 1] - T[i - 1]) / 150
    rows = np.column_stack([t, T, Q1])
    np.savetxt("heat.csv", rows, delimiter=",", header="t,T,Q1", comments="")
    Path("heater.py").write_text(STEPPED)
    done = grounded("init", "w", "--from", "heat.csv", "--model", "heater.py", "--yes")
    assert done.code == 0, done.err
    return Workspace("w")


def test_what_was_sent_before_is_given(heater: Workspace) -> None:
    done = heater.ingest("heat.csv", data=True, before={"Q1": 0.0})
    assert not of_code(done, "log.from")
    (stored,) = heater.trials()
    trial = stored.trial
    assert trial.start_inputs.tolist() == [0.0]
    assert trial.inputs[0] in (0.0, 50.0) and trial.states[0] == pytest.approx(23.0, abs=0.2)
    assert 299 <= trial.steps <= 301
    with pytest.raises(GroundedError, match="Q1"):
        heater.ingest("heat.csv", data=True, before={"Q2": 0.0})
