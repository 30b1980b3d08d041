"""A real system that repeats itself to the last bit: the search ends, by `learn` and by hand."""

import sys

import pytest

from grounded.errors import NextCommand
from grounded_trials import Workspace
from workspaces import CONFIG, make

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
