"""Workspace: all state is derived from its files: configuration, model, target and trials."""

import shutil

import numpy as np
import pytest

from cli import grounded
from facts import holds
from grounded.errors import GroundedError
from grounded_trials.starting.examples import EXAMPLES, write_example
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.user_files.config import read_config
from grounded_trials.workspace.user_files.task_file import read_target, target_arrays, write_target
from workspaces import CONFIG, MODEL, make


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_examples_files_say_what_its_task_is(name, tmp_path):
    write_example(tmp_path, name)
    found, own = Folder(tmp_path).task, EXAMPLES[name].task()
    assert (found.dt, found.horizon, found.feedback) == (own.dt, own.horizon, own.feedback)
    np.testing.assert_allclose(found.target, own.target, rtol=1e-7, atol=1e-7)
    for part in ("start", "past", "low", "high", "latency", "safety_low"):
        np.testing.assert_allclose(getattr(found, part), getattr(own, part), rtol=1e-9, atol=1e-9)
    for part in ("state", "terminal", "input", "input_change"):
        np.testing.assert_allclose(getattr(found.reward, part), getattr(own.reward, part))
    assert found.model.state_names == own.model.state_names
    np.testing.assert_array_equal(found.model.values, own.model.values)
    text = (tmp_path / "grounded.toml").read_text()
    assert "[system]" in text and "{candidate} {trial}" in text


def test_states_start_at_the_targets_first_row_else_at_0(tmp_path):
    config = CONFIG.replace("horizon = 40", "horizon = 2")
    w = make(tmp_path / "a", config=config, target="t,x\n0,0.5\n0.05,1\n0.1,1\n")
    assert w.task.start.tolist() == [0.5, 0.0]
    named = config.replace("[reward]", "start = { x = 0.1, v = 2, force = 1.5 }\n[reward]")
    w = make(tmp_path / "b", config=named, target="t,x\n0,0.5\n0.05,1\n0.1,1\n")
    assert w.task.start.tolist() == [0.1, 2.0] and w.task.past.tolist() == [1.5]
    held = named.replace("force = 1.5", "force = 50")
    w = make(tmp_path / "c", config=held, target="t,x\n0,0.5\n0.05,1\n0.1,1\n")
    with pytest.raises(GroundedError) as told:  # it was planned from 5 N, and the robot held 50
        _ = w.task
    assert holds(str(told.value), "force", "50 N", "[task] start", "-5 to 5")


def test_input_columns_of_the_target_are_what_inputs_are_compared_with(tmp_path):
    config = CONFIG.replace("horizon = 40", "horizon = 2")
    w = make(tmp_path / "a", config=config, target="t,force,x\n0,1,0\n0.05,2,0\n0.1,9,0\n")
    assert w.task.input_target.tolist() == [[1.0], [2.0]] and w.task.past.tolist() == [1.0]


def test_two_workspaces_in_one_process_have_their_own_models(tmp_path):
    from grounded_trials.workspace.candidates.running import simulated_plant

    a = make(tmp_path / "a")
    b = make(tmp_path / "b", model=MODEL.replace("Param(0.2", "Param(0.9"))
    b.folder.joinpath("real.py").write_text("from model import model\n")
    assert simulated_plant(a).model.params["drag"].value == 0.5
    assert simulated_plant(b).model.params["drag"].value == 0.9


def test_a_target_round_trips(tmp_path):
    x = np.random.default_rng(0).normal(size=11)
    write_target(tmp_path / "t.csv", 0.05, {"x": x, "psi": 10 * x})
    names, values = read_target(tmp_path / "t.csv")
    assert names == ["t", "x", "psi"]
    np.testing.assert_allclose(values[:, 1], x, rtol=1e-8)
    target, inputs = target_arrays(tmp_path / "t.csv", ["psi", "v", "x"], ["u"], 0.05, 10)
    assert inputs is None and np.isnan(target[:, 1]).all()
    np.testing.assert_allclose(target[:, 2], x, rtol=1e-8)


def test_times_may_be_rounded_to_a_hundredth_of_a_step(tmp_path):
    (tmp_path / "t.csv").write_text("t,x\n0,0\n0.0333,0\n0.0667,0\n0.1,0\n")
    target_arrays(tmp_path / "t.csv", ["x"], ["u"], 1 / 30, 3)
    with pytest.raises(GroundedError, match=r"dt = 0\.0333333"):
        target_arrays(tmp_path / "t.csv", ["x"], ["u"], 0.035, 3)
    (tmp_path / "u.csv").write_text("t,x\n0,0\n0.05,0\n0.08,0\n0.1,0\n")  # uneven
    with pytest.raises(GroundedError, match="line 3"):
        target_arrays(tmp_path / "u.csv", ["x"], ["u"], 1 / 30, 3)


def test_a_copied_workspace_is_the_same_workspace(tmp_path):
    w = make(tmp_path / "w")
    grounded("-C", w.folder, "learn", "--trials", "2")
    shutil.copytree(w.folder, tmp_path / "copy")
    a, b = (grounded("-C", f, "status", "--json").json for f in (w.folder, tmp_path / "copy"))
    assert a == b
    a, b = (grounded("-C", f, "propose", "--json").json for f in (w.folder, tmp_path / "copy"))
    assert {k: v for k, v in a.items() if k != "file"} == {
        k: v for k, v in b.items() if k != "file"
    }


def test_comments_and_layout_of_grounded_toml_survive_fit_apply(tmp_path):
    from grounded_trials.workspace.user_files.config import set_keys

    w = make(tmp_path / "w", config="# mine\n" + CONFIG.replace("dt = 0.05", "dt = 0.05  # 20 Hz"))
    set_keys(w.config.file, "model", params={"mass": 2.0})
    set_keys(w.config.file, "task", latency={"force": 0.07})
    text = w.config.file.read_text()
    assert text.startswith("# mine\n") and "dt = 0.05  # 20 Hz" in text
    assert read_config(w.folder).model.params == {"mass": 2.0}
    assert read_config(w.folder).task.latency == {"force": 0.07}
