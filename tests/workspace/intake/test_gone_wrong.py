"""A run that should not count, a log that ends early, and how exactly a robot is placed."""

from dataclasses import replace

import numpy as np
import pytest

from cli import grounded
from facts import of_code
from grounded.errors import GroundedError, NextCommand
from grounded.onboard import Runner
from grounded.plant import Plant
from grounded.trial import Trial
from grounded_trials import Workspace
from grounded_trials.store.trial_file import read_trial, write_trial
from grounded_trials.workspace.candidates.proposing import propose_in
from grounded_trials.workspace.candidates.running import run_candidate
from grounded_trials.workspace.discarding import set_aside
from grounded_trials.workspace.intake import gone_wrong
from grounded_trials.workspace.intake.gone_wrong import placing
from grounded_trials.workspace.intake.ingest import ingest_log
from workspaces import MODEL, REAL, make

TURNED = f"""{REAL}
from dataclasses import replace
from types import SimpleNamespace

real = model
model = replace(
    real, derivative=lambda s, a, p: real.derivative(s, SimpleNamespace(force=FORCE), p)
)
"""


@pytest.fixture
def w(tmp_path):
    """A workspace with one good run, and a second candidate."""
    w = Workspace(make(tmp_path / "w").folder)
    w.ingest(w.run(w.propose().candidate.id).trial_file)
    assert w.propose().candidate.id == "c0002"
    return w


def run(w, force):
    (w.folder / "real.py").write_text(TURNED.replace("FORCE", force))
    return w.run().trial_file


def test_a_motor_wired_wrongly_is_told_before_the_next_plan(w, tmp_path):
    trial, *_ = read_trial(run(w, "-a.force"))
    assert w.task.utility(trial) < -100
    write_trial(tmp_path / "t.mcap", trial.until(25), {"kind": "trial", "task": w.task.hash})
    done = w.next(tmp_path / "t.mcap")
    assert (done.proposed, done.exported, done.to_json()["propose"]) == (None, None, None)
    assert (done.taken.then.verb, done.taken.then.arguments) == ("discard", ("t0002",))
    (told,) = of_code(done.taken, "run.reversed")
    assert told.about == ("force",) and told.facts["trial"] == "t0002"
    now = w.status()
    assert now.then == done.taken.then and now.notes[0] == told.sentence
    w.discard("t0002")
    assert w.status().then.verb != "discard"
    assert w.propose().candidate.id == "c0002"


@pytest.mark.parametrize(("off", "again"), [(0.6, True), (0.02, False)])
def test_a_run_that_started_elsewhere_is_discarded_or_counts(w, off, again):
    """One output asked to discard it, called it bad luck, and exported the next candidate."""
    robot, policy = Plant(w.base_model.with_values({"mass": 1.4})), w.candidate("c0002")[0].policy
    trial = robot.run(policy, {"x": off, "v": 0.0}, np.random.default_rng(0))
    file = w.folder / "t.mcap"
    write_trial(file, replace(trial, candidate="c0002"), {"kind": "trial", "task": w.task.hash})
    out = grounded("-C", w.folder, "next", file).out
    found = w.ingest(file)
    (told,) = of_code(found, "run.start*")
    assert told.code == ("run.start_spoils" if again else "run.start")
    assert (found.then.verb == "discard") is again
    assert ("bad luck" in out or "Run c0" in out) is not again


@pytest.mark.parametrize("every", [1, 3])
def test_a_loop_slower_than_dt_is_told(w, every):
    model, policy = w.base_model.with_values({"mass": 1.4}), w.candidate("c0002")[0].policy
    runner, states, inputs = Runner(policy), [np.zeros(2)], []
    for k in range(policy.horizon):
        if k % every == 0:
            sent = np.array(runner.action(k * policy.dt, states[-1]))
        inputs.append(sent)
        step = model.system.step(states[-1][None], sent[None], model.values, policy.dt)
        states.append(step[0])
    names = w.task.model.state_names, w.task.model.input_names
    file = w.folder / "t.mcap"
    held = Trial(np.array(states), np.array(inputs), policy.dt, *names, candidate="c0002")
    write_trial(file, held, {"kind": "trial", "task": w.task.hash})
    found = w.ingest(file)
    dt = 1e3 * policy.dt
    told = of_code(found, "run.skipped")
    assert len(told) == (every > 1) == (found.then.verb == "discard")
    assert all(one.facts["every"] == pytest.approx(every * dt) for one in told)


def by_hand(w, wired, seed=5):
    """Drive the cart by hand, with a motor wired right or wrong and a drag the model lacks."""
    rng, (x, v) = np.random.default_rng(seed), (0.0, 0.0)
    states, inputs, goals = [(x, v)], [], rng.uniform(-1.0, 1.0, 10)
    for k in range(120):
        force = np.clip(4.0 * (goals[k // 15] - x) + 0.5 * rng.normal(), -5.0, 5.0)
        for _ in range(20):
            v += 0.0025 * (wired * force - 3.0 * v) / 1.4
            x += 0.0025 * v
        states.append((x, v))
        inputs.append((force,))
    noisy = np.array(states) + 1e-4 * rng.normal(size=(121, 2))
    trial = Trial(noisy, np.array(inputs), 0.05, w.task.model.state_names, ("force",))
    file = w.folder / f"hand{wired:g}{seed}.mcap"
    write_trial(file, trial, {"kind": "trial", "task": w.task.hash})
    return w.ingest(file, data=True)


def test_a_log_that_contradicts_the_model_is_told_and_the_next_contradicts_it(tmp_path):
    w = Workspace(make(tmp_path / "w").folder)
    first = by_hand(w, -1.0)
    assert [(one.code, one.about) for one in first.findings] == [("run.reversed", ("force",))]
    assert first.then.verb == "diagnose"
    by_hand(w, 1.0)
    with pytest.raises(GroundedError, match="t0001"):
        w.diagnose()


@pytest.mark.parametrize("before", [(), (-1.0, -1.0), (1.0,)])
def test_no_run_is_at_fault_if_an_input_acts_alike_in_all_of_them(tmp_path, before):
    """A sign flipped in model.py let the next run be blamed, and set aside."""
    w = Workspace(make(tmp_path / "w").folder)
    w.propose()
    for k, wired in enumerate(before):
        by_hand(w, wired, seed=k)
    done = w.ingest(run(w, "-a.force"))
    (told,) = of_code(done, "run.reversed")
    alone = before != (-1.0, -1.0)
    assert ("trial" in told.facts) is alone
    assert (done.then.verb == "discard") is alone
    assert (w.status().then.verb == "discard") is alone


@pytest.mark.parametrize("text", ["Param(5.0", "(-a.force"])
def test_a_model_that_was_edited_is_told_by_every_command_and_no_run_is_blamed(w, text):
    """It was told that no candidate waits."""
    file = run(w, "a.force")
    trial, *_ = read_trial(file)
    bare = w.folder / "bare.mcap"
    write_trial(bare, replace(trial, candidate=""), {"kind": "trial", "task": w.task.hash})
    old = "Param(1.0" if text.startswith("Param") else "(a.force"
    (w.folder / "model.py").write_text(MODEL.replace(old, text))
    w = Workspace(w.folder)
    for verb in ("ingest", "next"):
        with pytest.raises(GroundedError) as caught:
            getattr(w, verb)(bare)
        assert (caught.value.finding.code, caught.value.finding.about) == ("plan.void", ("c0002",))
        assert caught.value.then == NextCommand(verb, (str(bare), "--candidate", "c0002"))
    with pytest.raises(GroundedError) as caught:
        w.run()
    assert (caught.value.finding.code, caught.value.then.verb) == ("plan.void", "propose")
    assert w.status().findings[0].code == w.diagnose().findings[0].code == "plan.void"
    done = w.ingest(bare, candidate="c0002")
    assert done.findings[0].code == "plan.outdated" and done.then.verb != "discard"
    assert not of_code(w.status(), "plan.*")  # nothing waits that rests on the old model
    made = w.propose()
    assert made.candidate.id == "c0003" and of_code(made, "plan.outdated")
    assert not of_code(w.status(), "plan.*") and not of_code(w.propose(), "plan.outdated")


@pytest.fixture
def rig(tmp_path):
    return make(tmp_path / "w")


def ran_on(rig):
    return run_candidate(rig, propose_in(rig).candidate.id).trial_file


def placed(rig, tmp_path, ran, off):
    """Ingest a run that began `off` away."""
    moved = np.array(ran.states)
    moved[0, 0] += off
    write_trial(tmp_path / "t.mcap", replace(ran, states=moved), {"kind": "trial"})
    return ingest_log(rig, tmp_path / "t.mcap", ran.candidate or "c0001")


def test_the_scatter_of_starts_is_learnt_from_discarded_runs_too(rig, tmp_path, monkeypatch):
    ran, *_ = read_trial(ran_on(rig))
    monkeypatch.setattr(gone_wrong, "worth_of_start", lambda *_: 0.9 * rig.task.utility(ran))
    assert of_code(placed(rig, tmp_path, ran, 0.15), "run.start_spoils")
    for off in (-0.13, 0.11):
        set_aside(rig, "discard", [placed(rig, tmp_path, ran, off).trial], "")
        rig.forget()
    rms, runs = placing(rig, rig.read())
    assert runs == 3 and rms[0] == pytest.approx(1.4826 * 0.13)
    found = placed(rig, tmp_path, ran, -0.14)
    (told,) = of_code(found, "run.start*")
    assert (told.code, told.facts["runs"]) == ("run.start", 3)
    assert told.facts["rms"].value == pytest.approx(1.4826 * 0.13)
    assert found.then.verb == "propose"


@pytest.mark.parametrize(("share", "code"), [(-0.9, "run.start_spoils"), (0.9, "run.start")])
def test_a_run_that_is_better_from_either_start_counts(rig, monkeypatch, share, code):
    """`share` of its cost is what its start has lost, or won if below 0."""
    worse = ran_on(rig)
    ingest_log(rig, worse)
    worse, better = (read_trial(file)[0] for file in (worse, ran_on(rig)))
    utility = rig.task.utility(better)
    assert utility > rig.task.utility(worse)
    monkeypatch.setattr(gone_wrong, "worth_of_start", lambda *_: share * utility)
    moved = np.array(better.states)
    moved[0, 0] += 0.01
    assert gone_wrong.Run(rig, replace(better, states=moved)).begun_elsewhere().code == code


def test_a_discarded_run_that_began_elsewhere_says_nothing_about_the_placing(rig, tmp_path):
    ran, *_ = read_trial(ran_on(rig))
    for off in (0.01, -0.01, 0.9):
        last = placed(rig, tmp_path, ran, off).trial
    set_aside(rig, "discard", [last], "")
    rig.forget()
    assert placing(rig, rig.read())[0][0] == pytest.approx(1.4826 * 0.01)
