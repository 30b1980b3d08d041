"""Workspace: all state is derived from its files; verify proves them; very wide models."""

import shutil

import numpy as np
import pytest

from cli import grounded
from facts import holding, holds
from grounded.diagnosis.diagnose import diagnose
from grounded.errors import GroundedError
from grounded.fit import fit
from grounded.trial import Trial
from grounded_trials import Workspace
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


def searched(folder):
    make(folder)
    w = Workspace(folder)
    for _ in range(2):
        w.propose()
        w.ingest(w.run().trial_file)
    w.propose()
    return w


def test_a_trial_that_candidates_were_made_from_and_that_is_gone_is_damage(tmp_path):
    w = searched(tmp_path / "w")
    last = sorted(p for p in (tmp_path / "w" / "trials").glob("t*.mcap"))[-1]
    assert w.verify().damaged == ()
    last.unlink()
    for note in (tmp_path / "w" / "trials").glob("n*.json"):
        note.unlink()  # nothing else tells of it
    found = Workspace(tmp_path / "w").verify().damaged
    assert any("t0002" in one.reason for one in found)
    assert grounded("-C", tmp_path / "w", "verify").code != 0


@pytest.mark.parametrize("name", ["trials", "candidates", "runs", "reports"])
def test_a_folder_that_is_a_link_out_of_the_workspace_is_refused(tmp_path, name):
    make(tmp_path / "w")
    away, place = tmp_path / "elsewhere", tmp_path / "w" / name
    away.mkdir()
    if place.exists():
        place.rmdir()
    place.symlink_to(away)
    with pytest.raises(GroundedError, match=name):
        Workspace(tmp_path / "w").propose()
    assert not any(away.iterdir())


def test_a_config_with_a_byte_order_mark_is_read(tmp_path):
    make(tmp_path / "w")
    config = tmp_path / "w" / "grounded.toml"
    config.write_bytes(b"\xef\xbb\xbf" + config.read_bytes())
    assert Workspace(tmp_path / "w").status().to_json()["phase"] == "propose"


def test_temporary_files_of_a_killed_init_are_removed(tmp_path):
    left = tmp_path / "w" / f".model.py-{'0' * 16}.tmp"
    left.parent.mkdir()
    left.write_text("half")
    Workspace.create(tmp_path / "w", example="pendulum")
    assert not left.exists()


RING = """
import numpy as np
from grounded import Model, Param

N, M = {n}, {m}


def rate(s, a, p):
    x, u = [s[f"x{{i}}"] for i in range(N)], [a[f"u{{j}}"] for j in range(M)]
    return {{
        f"x{{i}}": p.k * (x[i - 1] - x[i]) - p.c * np.sin(x[i]) + sum(u[i % M :: N])
        for i in range(N)
    }}


def step(s, a, p, dt):
    x = np.array([float(s[f"x{{i}}"]) for i in range(N)])
    u = np.array([float(a[f"u{{j}}"]) for j in range(M)])
    push = np.array([u[i % M :: N].sum() for i in range(N)])
    x = x + dt * (p.k * (np.roll(x, 1) - x) - p.c * np.sin(x) + push)
    return {{f"x{{i}}": x[i] for i in range(N)}}


model = Model(
    states={{f"x{{i}}": "m" for i in range(N)}},
    inputs={{f"u{{j}}": "1" for j in range(M)}},
    params={{"k": Param(1.0, "1/s", 0.1, 3.0), "c": Param(0.5, "1/s", 0.1, 2.0)}},
    {how},
)
"""


def ring(n, m, how="derivative=rate"):
    names = {}
    exec(RING.format(n=n, m=m, how=how), names)
    return names["model"]


def logged(model, steps=60):
    rng = np.random.default_rng(1)
    u = np.cumsum(rng.standard_normal((steps, model.m)), axis=0) / 10
    x = rng.standard_normal((steps + 1, model.n))
    names = {"state_names": model.state_names, "input_names": model.input_names}
    return Trial(dt=0.05, states=x, inputs=u, **names)


@pytest.mark.parametrize("n, m", [(1000, 1), (5, 200), (101, 100)])
def test_more_than_200_names_are_refused_before_anything_is_computed(n, m, tmp_path):
    with pytest.raises(GroundedError, match=holding(f"{n} states", f"{m} inputs", "200")):
        ring(n, m)
    file = tmp_path / "ring.py"
    file.write_text(RING.format(n=n, m=m, how="derivative=rate"))
    with pytest.raises(GroundedError, match=holding("200")):
        Workspace.create(tmp_path / "w", model=file)
    assert not (tmp_path / "w").exists()


@pytest.mark.parametrize(
    ("asked", "n", "m", "facts"),
    [(fit, 51, 2, ("51 states", "50")), (diagnose, 20, 31, ("20 states", "31 inputs", "50"))],
)
def test_a_fit_and_a_diagnosis_say_how_many_names_they_take(asked, n, m, facts):
    model = ring(n, m)
    with pytest.raises(GroundedError, match=holding(*facts)):
        asked(model, [logged(model)])


@pytest.mark.slow
def test_a_wide_model_gets_a_candidate(tmp_path, n=10, m=60, how="step=step"):
    (tmp_path / "ring.py").write_text(RING.format(n=n, m=m, how=how))
    workspace = Workspace.create(tmp_path / "w", model=tmp_path / "ring.py")
    candidate = workspace.propose().candidate
    assert candidate.policy.gain.shape == (100, m, n + m)
    assert np.abs(candidate.predicted_states).max() < 1e-3  # the target is rest
