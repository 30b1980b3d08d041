"""grounded inspect: what a file is, and what to do with it."""

import re
import tomllib

import pytest

from cli import grounded, plain
from facts import holds
from grounded_trials.workspace.folder import Folder
from reported import cart, copied
from shared_data import data, needs_data
from workspaces import make

__all__ = ["cart"]


@pytest.fixture
def w(cart, tmp_path):
    return copied(cart, tmp_path / "w")


def last(done):
    assert done.code == 0, done.err
    return plain(done.out).rstrip().splitlines()[-1]


def test_a_trial_of_ours_needs_no_log_table(w, tmp_path):
    (stored,) = w.glob("trials/t0001-*")
    done = grounded("-C", w, "inspect", stored)
    assert holds(done.out, stored.name, "trial", "c0001") and "[log." not in done.out
    assert last(done) == "next: grounded report"
    path = tmp_path / "run.mcap"
    path.write_bytes(stored.read_bytes())
    done = grounded("-C", w, "inspect", path)
    assert last(done) == f"next: grounded ingest {path}"
    assert grounded("-C", w, "inspect", path, "--json").json["log_table"] == ""


def test_a_candidate_is_said_to_be_one(w):
    done = grounded("-C", w, "inspect", w / "candidates" / "c0002.mcap")
    assert holds(done.out, "c0002.mcap", "candidate") and "[log." not in done.out
    assert last(done) == "next: grounded run c0002"


def test_a_cut_trial_is_damaged_and_recover_is_next(w, tmp_path):
    (stored,) = w.glob("trials/t0001-*")
    path = tmp_path / "cut.mcap"
    path.write_bytes(stored.read_bytes()[:-3000])
    done = grounded("-C", w, "inspect", path)
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
