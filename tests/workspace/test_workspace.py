"""Workspace: its state is derived from its files; its front door has a method for every command."""

import shutil
import subprocess
import sys

import numpy as np
import pytest

from cli import grounded
from cli import plain as said
from facts import holding, holds
from grounded.diagnosis.diagnose import diagnose
from grounded.errors import GroundedError
from grounded.fit import fit
from grounded.result import Result, plain
from grounded.trial import Trial
from grounded_trials import Workspace
from grounded_trials.starting.examples import EXAMPLES, write_example
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.user_files.config import read_config
from grounded_trials.workspace.user_files.task_file import read_target, target_arrays, write_target
from reported import copied
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


def test_importing_the_package_costs_nothing():
    code = "import sys, grounded_trials; assert 'numpy' not in sys.modules; "
    code += "from grounded_trials import Workspace; print('scipy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


def test_a_name_that_is_not_there():
    import grounded_trials

    with pytest.raises(AttributeError, match="Workshop"):
        _ = grounded_trials.Workshop


def test_the_condition_of_a_run_is_named_and_named_anew(tmp_path):
    w = Workspace.create(tmp_path / "w", example="pendulum")
    w.propose()
    file = w.run().trial_file
    for group in ("wet", "dry", "", "wet"):  # "" leaves what was named
        assert w.ingest(file, group=group).trial == "t0001"
        (trial,) = w.task_trials()
        assert trial.group == (group or "dry")
    (measured,) = w.task_trials(measured=True)
    assert measured.group == "wet" and w.verify().damaged == ()


@pytest.mark.parametrize(
    ("verb", "options"),
    [
        ("propose", ()),
        ("status", ()),
        ("fit", ()),
        ("report", ("--html",)),
        ("verify", ()),
        ("inspect", ("trials/t.mcap",)),
        ("export", ("best", "-o", "best.csv")),
        ("adopt", ("viscous_friction:v",)),
    ],
)
def test_the_document_is_the_command_s(cart, tmp_path, monkeypatch, verb, options):
    for side in ("a", "b"):
        copied(cart, tmp_path / side)
        (first, *_) = (tmp_path / side / "trials").glob("t0001-*")
        shutil.copy(first, tmp_path / side / "trials" / "t.mcap")
    monkeypatch.chdir(tmp_path / "a")
    printed = grounded(verb, *options, "--json")
    assert printed.code == 0, printed.err
    monkeypatch.chdir(tmp_path / "b")
    w = Workspace()
    calls = {"report": lambda: w.report(html=True), "export": lambda: w.export("best", "best.csv")}
    found = calls.get(verb, lambda: getattr(w, verb)(*options))()
    assert isinstance(found, Result)
    assert plain(found.to_json()) == printed.json
    assert repr(found).startswith(f"<{type(found).__name__} ") and len(repr(found)) < 200
    assert "<table>" in found._repr_html_()


def test_one_reader_strict_or_telling_what_it_lost(cart, tmp_path):
    w = Workspace(copied(cart, tmp_path / "w"))
    whole = w.read()
    assert not whole.lost and len(whole.trials) > 2
    (second,) = w.store.folder.glob("t0002-*")
    second.chmod(0o644)
    second.write_bytes(second.read_bytes()[:-30])
    (third,) = w.store.folder.glob("t0003-*")
    third.unlink()
    (w.folder / "candidates" / "c0001.mcap").write_bytes(b"no")
    w.forget()
    with pytest.raises(GroundedError, match="t0002"):
        w.read()
    found = w.read(strict=False)
    assert [one.file for one in found.lost] == [second.name, "t0003"]
    assert len(found.trials) == len(whole.trials) - 2
    assert [c.id for c in found.candidates] == [c.id for c in whole.candidates]
    assert np.array_equal(
        found.candidates[0].predicted_states, whole.candidates[0].predicted_states
    )


@pytest.mark.parametrize(
    ("call", "facts"),
    [
        (lambda w: w.ingest(5), ("path", "int")),
        (lambda w: w.ingest(w.trials()[0]), ("path",)),
        (lambda w: w.next(None), ("path", "NoneType")),
        (lambda w: w.inspect(5), ("path", "int")),
        (lambda w: w.learn(trials="3"), ("trials", "'3'")),
        (lambda w: w.learn(trials=-1), ("trials", "-1")),
        (lambda w: w.diagnose("t0001"), ("['t0001']",)),
        (lambda w: w.diagnose([1]), ("trials", "int")),
        (lambda w: w.preflight("t0001"), ("['t0001']",)),
        (lambda w: w.diagnose(max_effects=13), ("max_effects", "12")),
    ],
)
def test_arguments_of_another_type(cart, tmp_path, call, facts):
    w = Workspace(copied(cart, tmp_path / "w"))
    with pytest.raises(GroundedError, match=holding(*facts)):
        call(w)


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """A workspace with the trials t0001 and t0002 of c0001 and c0002."""
    made = make(tmp_path_factory.mktemp("ids") / "w").folder
    grounded("-C", made, "learn", "--trials", "2")
    return Workspace(made)


WRONG = [  # command, what its message names
    (["discard", "c0002"], ["t0002"]),
    (["restore", "c0001"], ["t0001"]),
    (["diagnose", "--trials", "c0001"], ["t0001"]),
    (["diagnose", "--compare", "t0001", "c0002"], ["t0002"]),
    (["run", "t0002"], ["c0002"]),
    (["ingest", "x.mcap", "--candidate", "t0001"], ["c0001"]),
    (["export", "c0099"], ["c0099", "c0001", "c0002"]),
    (["discard", "t0099"], ["t0099", "t0001", "t0002"]),
    (["discard", "t2"], ["'t0002'"]),
    (["run", "2"], ["'c0002'"]),
    (["ingest", "t0001"], ["t0001"]),
    (["inspect", "t0001"], ["t0001"]),
    (["target", "c0001"], ["c0001"]),
    (["next", "c0001"], ["c0001"]),
]


@pytest.mark.parametrize(("command", "named"), WRONG, ids=lambda one: " ".join(one))
def test_an_id_of_the_other_kind_or_out_of_range_is_explained(ran, command, named):
    before = sorted(p.name for p in (ran.folder / "trials").iterdir())
    done = grounded("-C", ran.folder, *command)
    assert done.code == 1 and "Traceback" not in done.err
    for part in named:
        assert part in said(done.err), done.err
    assert sorted(p.name for p in (ran.folder / "trials").iterdir()) == before


def test_an_id_may_be_written_in_capitals(ran, tmp_path):
    assert ran.export("C0002", tmp_path / "c.json").candidate == "c0002"
    assert ran.export("T0001", tmp_path / "t.csv").candidate == "t0001"


def test_an_empty_workspace_says_that_there_is_none_yet(tmp_path):
    bare = Workspace(make(tmp_path / "w").folder)
    for asked in (lambda: bare.export("c0001"), lambda: bare.discard("t0001")):
        with pytest.raises(GroundedError, match="none"):
            asked()


def test_discard_and_restore_report_what_they_did_not_change(ran):
    assert ran.restore("t0001").unchanged == ("t0001",)
    assert ran.discard("t0001", why="a dog").unchanged == ()
    assert ran.discard("t0001").unchanged == ("t0001",)
    again = ran.discard("t0001", why="a cat")
    assert again.then == ran.status().then and again.then.verb != "status"
    assert again.unchanged == () and again.discarded == {"t0001": "a cat"}
    with pytest.raises(GroundedError, match="t0001") as refused:
        ran.export("t0001")
    assert refused.value.then.arguments == ("t0001",) and refused.value.then.verb == "restore"
    ran.discard("t0002")
    with pytest.raises(GroundedError) as refused:  # nothing is left to fit
        ran.fit()
    assert refused.value.then.arguments == ("t0002",) and refused.value.then.verb == "restore"
    ran.restore("t0002")
    done = ran.restore("t0001")
    assert done.to_json() == {
        **{"trials": ["t0001"], "unchanged": []},
        **{"discarded": {}, "findings": []},
    }


def test_a_damaged_trial_that_was_set_aside_stays_so_when_its_log_comes_again(tmp_path):
    w = Workspace(make(tmp_path / "w").folder)
    w.propose()
    log = w.run().trial_file
    stored = w.folder / "trials" / f"t0001-{w.ingest(log).sha256[:16]}.mcap"
    w.discard("t0001", why="a dog")
    stored.chmod(0o644)
    stored.write_bytes(b"")
    found = w.ingest(log)
    assert found.trial == "t0001" and found.verdict == "set aside"
