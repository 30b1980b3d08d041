"""Is this log that run? What its log hides behind zeros, limits or a second clock."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cli import grounded
from facts import holding, holds, of_code
from grounded.accounts.returned import suspicion
from grounded.errors import GroundedError, NextCommand
from grounded.plant import Plant
from grounded.trial import Trial
from grounded_trials import Workspace
from grounded_trials.store.trial_file import read_trial, write_trial
from grounded_trials.workspace.candidates.proposing import propose_in
from grounded_trials.workspace.candidates.running import run_candidate
from grounded_trials.workspace.candidates.search_state import standing_in
from grounded_trials.workspace.intake.ingest import ingest_log
from recorded import LOGGED, record, rows_of, waiting, written
from recorded import LOGGED as AS_TABLE
from workspaces import CONFIG, make

NOISY = CONFIG + "[system.noise.measurement]\nx = 0.002\nv = 0.01\n"


@pytest.fixture(scope="module")
def learnt(tmp_path_factory):
    """Three candidates of a cart with noisy sensors, each with its trial."""
    w = make(tmp_path_factory.mktemp("w") / "w", config=NOISY)
    for _ in range(3):
        ingest_log(w, run_candidate(w, propose_in(w).candidate.id).trial_file)
    return w


def runs(w):
    contents = w.read()
    by_id = {c.id: c for c in contents.candidates}
    return [(by_id[t.trial.candidate], t.trial, contents.candidates) for t in contents.trials]


def late(x):
    return np.vstack([x[:1], x[:-1]])


HONEST = {
    "as it was": lambda x, u: (x, u),
    "inputs a step late": lambda x, u: (x, late(u)),
    "states a step late": lambda x, u: (late(x), u),
    "noisy log": lambda x, u: (x + np.random.default_rng(1).normal(0, 0.01, x.shape), u),
    "coarse commands": lambda x, u: (x, np.round(u, 1)),
    "before clipping": lambda x, u: (x, np.where(np.abs(u) >= 5, 1.5 * u, u)),
}
OTHERS = {
    "somebody": lambda u: 3 * np.sin(np.arange(len(u)) / 3)[:, None],
    "the same half a second late": lambda u: np.vstack([u[:1]] * 10 + [u[:-10]]),
    "nobody": lambda u: 0 * u,
    "backwards": lambda u: u[::-1],
}


@pytest.mark.parametrize("kind", HONEST)
def test_a_run_is_recognised_though_the_log_is_not_perfect(learnt, kind):
    for own, trial, candidates in runs(learnt):
        states, inputs = HONEST[kind](np.array(trial.states), np.array(trial.inputs))
        logged = replace(trial, states=states, inputs=inputs)
        assert suspicion(learnt.task, logged, own, candidates).why is None


@pytest.mark.parametrize("kind", OTHERS)
def test_other_commands_are_not_the_candidate_s(learnt, kind):
    for own, trial, candidates in runs(learnt):
        logged = replace(trial, inputs=OTHERS[kind](np.array(trial.inputs)))
        why = suspicion(learnt.task, logged, own, candidates).why
        assert why.code in ("log.not_run", "log.silent") and why.about == ("force",)


@pytest.fixture
def by_hand(tmp_path):
    """A workspace that waits for c0002, and a log of manual driving."""
    w = Workspace(make(tmp_path / "w").folder)
    ran = w.run(w.propose().candidate.id).trial_file
    w.ingest(ran)
    w.propose()
    t = 0.05 * np.arange(41)
    driven = Trial(
        states=np.column_stack([1 - np.cos(t), np.sin(t)]),
        inputs=(1.4 * np.cos(t) + 0.5 * np.sin(t))[:40, None],
        dt=0.05,
        state_names=("x", "v"),
        input_names=("force",),
    )
    write_trial(tmp_path / "driven.mcap", driven, {"kind": "trial"})
    return w, ran, tmp_path / "driven.mcap"


def test_manual_driving_is_refused_and_taken_as_data(by_hand):
    w, _, driven = by_hand
    refused = grounded("-C", w.folder, "ingest", driven)
    assert refused.code == 1 and holds(refused.err, driven.name, "c0002", "--data")
    assert len(w.store.list()) == 1
    taken = grounded("-C", w.folder, "ingest", driven, "--data", "--json")
    assert taken.code == 0 and taken.json["trials"][0]["candidate"] is None
    w.forget()
    assert standing_in(w).outstanding.id == "c0002"


def test_a_named_candidate_overrides_with_a_warning(by_hand):
    w, _, driven = by_hand
    found = w.ingest(driven, candidate="c0002")
    assert found.candidate == "c0002" and found.findings[0].code == "log.not_run"


def test_a_log_of_other_driving_that_names_a_candidate_is_to_be_discarded(tmp_path):
    w = Workspace(make(tmp_path / "w", config=AS_TABLE).folder)
    policy = w.propose().candidate.policy
    sent = 2 * np.sin(1 + 0.7 * np.arange(policy.horizon))[:, None]
    other = replace(policy, feedforward=sent, gain=None, reference=None)
    log = record(w, tmp_path / "hand.csv", other, 0.0)
    done = grounded("-C", w.folder, "next", log, "--candidate", "c0001")
    said = " ".join(f"{done.out} {done.err}".split())
    assert holds(said, "not what c0001 sends", "discard t0001")
    assert "The run counts" not in said and done.out.split()[-1] == "t0001"
    status = w.forget().status()
    assert (
        status.then == NextCommand("discard", ("t0001",))
        and status.findings[0].code == "log.not_run"
    )
    assert w.propose().candidate.id == "c0002"  # the user has decided
    assert w.status().then.verb != "discard"


def said_to_have_run(candidate, run, to, steps=sys.maxsize, nudge=0.0):
    """The file `to`, with a run's trial, or its first steps, as one that names this candidate."""
    trial, _, _ = read_trial(run)
    trial = replace(trial, states=trial.states + nudge)  # no two runs are the same recording
    write_trial(to, replace(trial.until(steps), candidate=candidate), {"kind": "trial"})
    return to


def test_a_trial_that_names_its_candidate_is_not_given_to_another(by_hand, tmp_path):
    w, ran, _ = by_hand
    other = said_to_have_run("c0002", ran, tmp_path / "x.mcap")
    with pytest.raises(GroundedError, match="are those of c0001") as refused:
        w.ingest(other)
    assert refused.value.then == NextCommand("ingest", (str(other), "--data"))
    assert w.ingest(other, candidate="c0002").candidate == "c0002"


def test_a_run_that_ended_early_says_how_to_take_it_back(by_hand, tmp_path):
    w, ran, _ = by_hand
    for candidate in ("c0001", "c0002"):
        short = said_to_have_run("", ran, tmp_path / f"{candidate}.mcap", 20, nudge=1e-9)
        found = w.ingest(short, candidate=candidate)
        (told,) = of_code(found, "run.failed")
        assert (told.facts["steps"], told.facts["trial"]) == (20, found.trial)
        assert found.verdict == "crashed" or candidate == "c0001"


def test_a_discarded_trial_counts_nowhere_until_it_is_restored(by_hand):
    w, _, driven = by_hand
    w.ingest(w.run().trial_file)
    before = w.status()
    w.ingest(driven, data=True)
    done = grounded("-C", w.folder, "discard", "T0002", "--why", "a wheel was loose", "--json")
    assert done.code == 0 and done.json == {
        "trials": ["t0002"],
        "unchanged": [],
        "findings": [],
        "discarded": {"t0002": "a wheel was loose"},
    }
    now = w.status()
    assert now.standing.outstanding.id == "c0002" and now.standing.trials == 1
    assert [t.stored.id for t in w.trials()] == ["t0001", "t0003"]
    assert now.discarded["t0002"] in grounded("-C", w.folder, "status").out
    assert grounded("-C", w.folder, "status", "--json").json["discarded"] == now.discarded
    assert len(w.store.list()) == 3 and w.verify().damaged == ()  # nothing is deleted
    assert w.restore("t0002").discarded == {}
    assert w.status().standing.utilities == before.standing.utilities
    assert w.discard("t0002").discarded == {"t0002": ""}  # and again


def test_a_name_that_no_trial_has(by_hand):
    w, _, _ = by_hand
    with pytest.raises(GroundedError, match=r"T0009.*t0001"):
        w.discard("t0001", "T0009")
    assert w.discarded() == {}


def test_a_damaged_note_is_named_and_the_trial_does_not_come_back_silently(by_hand):
    w, _, _ = by_hand
    w.discard("t0001")
    (note,) = (w.folder / "trials").glob("n0001-*.json")
    note.chmod(0o644)
    note.write_text(json.dumps({"note": "restore", "trial": "0" * 16, "why": ""}))
    assert [one.file for one in w.verify().damaged] == [str(note)]
    with pytest.raises(GroundedError, match=re.escape(note.name)):
        w.status()


def test_the_candidate_after_a_false_crash_is_not_handed_out_once_that_is_discarded(tmp_path):
    w = Workspace(make(tmp_path / "w").folder)
    ran, _, _ = read_trial(w.run(w.propose().candidate.id).trial_file)
    write_trial(tmp_path / "short.mcap", ran.until(20), {"kind": "trial", "task": w.task.hash})
    assert w.ingest(tmp_path / "short.mcap", candidate="c0001").verdict == "crashed"
    assert w.propose().candidate.caution == 1
    w.discard("t0001")
    again = w.propose()
    assert again.candidate.id == "c0001" and "crash" not in again.proposal.standing.sentence
    w.ingest(w.run("c0001").trial_file)
    new = w.propose()
    assert (new.candidate.id, new.candidate.base, new.candidate.caution) == ("c0003", "c0001", 0)
    assert any("c0002" in note and "set aside" in note for note in again.notes)


def test_a_run_without_its_feedback_is_named(tmp_path, before=0.7):
    w = Workspace(make(tmp_path / "w", config=AS_TABLE).folder)
    alone = replace(w.propose().candidate.policy, gain=None, reference=None)
    with pytest.raises(GroundedError) as refused:
        w.ingest(record(w, tmp_path / "a.csv", alone, before))
    assert refused.value.finding.code == "run.unfed"


@pytest.mark.parametrize(("mass", "told"), [(1.0, False), (1.02, True)])
def test_a_run_without_feedback_that_changes_little_counts_with_a_warning(tmp_path, mass, told):
    w = Workspace(make(tmp_path / "w").folder)
    alone = replace(w.propose().candidate.policy, gain=None, reference=None)
    robot = Plant(w.base_model.with_values({"mass": mass}))
    trial = robot.run(alone, dict.fromkeys(("x", "v"), 0.0), np.random.default_rng(0))
    file = tmp_path / "t.mcap"
    write_trial(file, replace(trial, candidate="c0001"), {"kind": "trial", "task": w.task.hash})
    found = w.ingest(file)
    assert found.verdict == "first"
    assert bool(of_code(found, "run.unfed")) is told


@pytest.fixture
def w(tmp_path):
    """It waits for c0002; c0001 was run."""
    return waiting(tmp_path)


def refused(w, log):
    with pytest.raises(GroundedError) as error:
        w.ingest(log)
    return error.value


def test_a_state_from_another_zero_is_named_with_the_offset(w, tmp_path, by=-0.4):
    run = record(w, tmp_path / "a.csv", w.candidate("c0002")[0].policy, 1.0, noise=(2e-4, 1e-3))
    one = refused(w, written(run, rows_of(run) + np.array([0, by, 0, 0]))).finding
    assert (one.code, one.about) == ("log.zero", ("x",))
    told = one.facts["add"]
    assert told == pytest.approx(-by, abs=0.02)
    toml = w.folder / "grounded.toml"
    toml.write_text(
        toml.read_text().replace('path = "/csv.x"\n', f'path = "/csv.x"\noffset = {told}\n')
    )
    assert Workspace(w.folder).ingest(run).candidate == "c0002"


def test_a_log_without_the_run_s_beginning_says_so(w, tmp_path):
    run = record(w, tmp_path / "a.csv", w.candidate("c0002")[0].policy, 0.0)
    lines, dt = run.read_text().splitlines(), w.task.dt
    times = np.array([float(line.split(",")[0]) for line in lines[1:]])
    rows = round(8 * dt / float(np.median(np.diff(times))))
    run.write_text("\n".join([lines[0], *lines[1 + rows :]]))
    error = refused(w, run)
    assert error.finding.code == "log.begun_late"
    assert error.then.arguments == ("LOG",)  # this one would be refused again
    assert error.finding.facts["late"].value == pytest.approx(8 * dt, abs=1.01 * dt)


def test_columns_that_no_command_depends_on_are_not_called_exchanged(tmp_path):
    w = waiting(tmp_path, LOGGED.replace("[task]\n", "[task]\nfeedback = false\n"))
    ran = w.candidate("c0002")[0].policy
    w.ingest(record(w, tmp_path / "a.csv", ran, 0.0))
    waits = w.propose().candidate
    assert waits.policy.gain is None
    off = np.std(waits.policy.feedforward - ran.feedforward)
    assert 1e-3 < off < 0.1 * np.abs(ran.feedforward).max()
    found = w.ingest(record(w, tmp_path / "b.csv", ran, 0.0, seed=1), candidate=waits.id)
    (told,) = of_code(found, "log.another", "log.exchange", "log.not_run")
    assert (told.code, told.facts["other"]) == ("log.another", "c0002")


def test_a_speed_that_stays_at_zero_is_the_reason_that_is_given(w, tmp_path):
    run = record(w, tmp_path / "a.csv", w.candidate("c0002")[0].policy, 0.0)
    one = refused(w, written(run, rows_of(run) * [1, 1, 0, 1])).finding
    assert (one.code, one.about) == ("log.dead", ("v",))


def test_a_candidate_of_an_earlier_task_is_found(w, tmp_path):
    run = record(w, tmp_path / "a.csv", w.candidate("c0002")[0].policy, 0.5)
    toml = w.folder / "grounded.toml"
    written = toml.read_text()
    toml.write_text(written.replace("[reward]\n", "[reward]\nterminal = { x = 0.5 }\n", 1))
    assert toml.read_text() != written and "terminal" not in written  # the task changes
    w = Workspace(w.folder)
    own = w.propose().candidate
    error = refused(w, run)
    assert holds(str(error), "ran c0002", "earlier task", "another target, reward", "--data")
    assert error.then == NextCommand("ingest", (str(run), "--data"))
    done = grounded("-C", w.folder, "ingest", run, "--data")
    assert done.code == 0, done.err
    fresh = record(w, tmp_path / "b.csv", own.policy, 0.5, seed=5)
    assert w.ingest(fresh, candidate=own.id).candidate == own.id


def test_limits_that_were_changed_since_the_export_are_named(w, tmp_path):
    run = record(w, tmp_path / "a.csv", w.candidate("c0002")[0].policy, 0.5)
    low, high = w.task.low[0], w.task.high[0]
    toml = w.folder / "grounded.toml"
    written = toml.read_text()
    toml.write_text(re.sub(r"(?m)^force = \[.*\]", f"force = [{0.8 * low}, {high}]", written))
    with pytest.raises(GroundedError) as error:
        Workspace(w.folder).ingest(run, candidate="c0002")
    assert holds(
        str(error.value), "ran c0002", f"limits of force: [{low:g}, {high:g}] then", "back"
    )
    toml.write_text(written)
    assert Workspace(w.folder).ingest(run).candidate == "c0002"


SPLIT = LOGGED.replace("/csv.force", "/cmd.force").replace("/csv.", "/mocap.")
APART = 8134.22  # [s] by which the cameras' clock is ahead


def two_tables(w, path, policy, apart):
    """A run as an NPZ of two tables: what the cameras saw, and what the program sent."""
    rows = np.loadtxt(record(w, path.with_suffix(".csv"), policy, 0.0), delimiter=",", skiprows=1)
    t, states, force = rows[:, 0] - rows[0, 0], rows[:, 1:3], rows[:, 3]
    sent = slice(None, None, round(policy.dt / (t[1] - t[0])))
    np.savez(
        path,
        mocap=states,
        mocap_t=t + apart,
        mocap_names=np.array(["x", "v"]),
        cmd=force[sent, None],
        cmd_t=t[sent],
        cmd_names=np.array(["force"]),
    )
    return path


def test_two_clocks_are_told_with_the_lines_that_bridge_them(tmp_path, apart=-APART):
    config = SPLIT
    w = Workspace(make(tmp_path / "w", config=config).folder)
    ran = w.propose().candidate
    log = two_tables(w, tmp_path / "run.npz", ran.policy, apart)
    for how in ({"data": True}, {}):
        with pytest.raises(GroundedError, match="differ by about") as refused:
            w.ingest(log, **how)
    lines = dict(re.findall(r"\[log\.state\.(\w)\] (delay_s = -?\d+\.\d+)", str(refused.value)))
    assert list(lines) == ["x", "v"]
    for name, line in lines.items():
        assert float(line.split()[-1]) == pytest.approx(apart, abs=0.02)
        config = config.replace(f'"/mocap.{name}"', f'"/mocap.{name}"\n{line}')
    (w.folder / "grounded.toml").write_text(config)
    found = Workspace(w.folder).ingest(log)  # the program was no 8134 s late
    assert found.candidate == ran.id


def test_the_lines_of_the_docs_make_one_log_of_two_tables(tmp_path, monkeypatch):
    w = Workspace(make(tmp_path / "w", config=SPLIT).folder)
    ran = w.propose().candidate
    rows = np.loadtxt(record(w, tmp_path / "a.csv", ran.policy, 0.0), delimiter=",", skiprows=1)
    (tmp_path / "run").mkdir()
    monkeypatch.chdir(tmp_path / "run")
    for name, columns, head in (("mocap", (0, 1, 2), "time,x,v"), ("cmd", (0, 3), "t,force")):
        np.savetxt(f"{name}.csv", rows[:, columns], "%.5f", ",", header=head, comments="")
    with pytest.raises(GroundedError, match=holding("cmd.csv and mocap.csv", ".npz")):
        w.ingest(tmp_path / "run")
    docs = Path(__file__).parents[3] / "docs/log-reference.md"
    (lines,) = re.findall(r"```python\n(.*?np\.savez.*?)```", docs.read_text(), re.DOTALL)
    exec(compile(lines, str(docs), "exec"), {})
    assert w.ingest(tmp_path / "run/run.npz").candidate == ran.id
