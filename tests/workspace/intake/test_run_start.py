"""Where a run begins in a recording, with feedback and noise, between rows, without speeds."""

from dataclasses import replace

import numpy as np
import pytest

from cli import grounded
from facts import holding, of_code
from grounded.errors import GroundedError, NextCommand
from grounded_trials import Workspace
from grounded_trials.workspace.intake.opening import foreign
from recorded import LOGGED, RATE, record, rows_of, stored_from, waiting, written
from workspaces import make


@pytest.fixture
def w(tmp_path):
    """It waits for c0002; c0001 was run."""
    return waiting(tmp_path)


@pytest.mark.parametrize(("before", "forced"), [(0.02, False), (1.0, True)])
def test_a_run_with_feedback_is_found_to_the_log_s_sample(w, tmp_path, before, forced):
    policy = w.candidate("c0002")[0].policy
    w.ingest(record(w, tmp_path / "a.csv", policy, 0.0), data=True)
    found = w.ingest(
        record(w, tmp_path / "b.csv", policy, before, after=1.0),
        candidate="c0002" if forced else None,
    )
    assert found.candidate == "c0002" and not found.warnings[:-1]
    stored, table, k = stored_from(w, tmp_path / "b.csv", before)
    np.testing.assert_allclose(stored.states[:-1], table[k, 1:3], atol=1e-3)


def test_a_run_on_late_states_is_found_though_the_log_is_corrected_for_them(tmp_path, before=1.0):
    late = LOGGED.replace('path = "/csv.x"\n', 'path = "/csv.x"\ndelay_s = 0.12\n')
    w = Workspace(make(tmp_path / "w", config=late).folder)
    w.propose()
    w.ingest(record(w, tmp_path / "a.csv", w.candidate("c0001")[0].policy, 0.0, late=12))
    policy = w.propose().candidate.policy
    assert policy.gain is not None
    log = record(w, tmp_path / "b.csv", policy, before, late=12)
    found = w.ingest(log)
    assert found.candidate == "c0002"
    stored, table, k = stored_from(w, log, before)
    np.testing.assert_allclose(stored.states[:-1, 0], table[k + 12, 1], atol=1e-3)
    np.testing.assert_allclose(stored.states[:-1, 1], table[k, 2], atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("fell", "named"), [(0.0, True), (1.0, False)])
def test_a_run_that_fell_in_a_log_that_goes_on_has_failed_there(tmp_path, fell, named):
    w = waiting(tmp_path, LOGGED + "[safety]\nx = [-5.0, 5.0]\n")
    policy = w.candidate("c0002")[0].policy
    log = record(w, tmp_path / "a.csv", policy, 1.0)
    table = rows_of(log)
    at = 100 + round(100 * (fell or 1.0))
    table[at:, 1] += 20.0 * bool(fell)
    table[at:, 3] = 0.0 if fell else -2.0
    written(log, table)
    wanted = "c0002" if named else None
    if not fell and not named:
        with pytest.raises(GroundedError, match="did not run"):
            w.ingest(log)
        return
    found = w.ingest(log, candidate=wanted)
    assert found.candidate == "c0002" and (found.verdict == "crashed") == bool(fell)
    about = of_code(found, "run.safety", "run.fell", "run.failed")
    assert len(about) == bool(fell) or not fell
    assert bool(of_code(about, "run.fell")) == bool(fell)
    steps = w.trials()[-1].trial.steps
    assert abs(steps - fell / policy.dt) <= 1 if fell else steps == policy.horizon
    again = w.ingest(log, candidate=wanted)
    assert again.known and again.trial == found.trial


def test_commands_that_are_logged_steps_late_are_told(w, tmp_path, before=1.0, late=2):
    policy = w.candidate("c0002")[0].policy
    table = rows_of(record(w, tmp_path / "a.csv", policy, before))
    rows = late * round(policy.dt * RATE)
    table[rows:, 3] = table[: len(table) - rows, 3]
    (told,) = of_code(w.ingest(written(tmp_path / "b.csv", table)), "log.late")
    assert told.facts["steps"] == late


def test_a_run_on_samples_of_a_step_before_is_told(w, tmp_path, before=0.93, stale=1):
    policy = w.candidate("c0002")[0].policy
    found = w.ingest(record(w, tmp_path / "a.csv", policy, before, stale=stale))
    (told,) = of_code(found, "log.late")
    assert told.facts["steps"] == stale and found.candidate == "c0002"


@pytest.mark.parametrize(("code", "before"), [("run.clock", 0.5), ("run.clipped", 1.0)])
def test_a_clock_that_ran_before_and_commands_that_were_cut_are_told_without_a_name(
    w, tmp_path, code, before
):
    policy = w.candidate("c0002")[0].policy
    most = 0.6 * float(np.abs(policy.feedforward).max())  # no commands in another unit
    differs = {"ahead": 10} if code == "run.clock" else {"most": most}
    log = record(w, tmp_path / "a.csv", policy, before, **differs)
    with pytest.raises(GroundedError) as refused:
        w.ingest(log)
    told = refused.value.finding
    assert told.code == code and (code != "run.clock" or told.facts["step"] == 10)
    assert refused.value.then == NextCommand("next", ("LOG",))
    named = w.ingest(log, candidate="c0002")
    assert named.then.verb == "discard" and of_code(named, code)


@pytest.mark.parametrize("before", [0.0, 1.0])
def test_the_log_of_another_candidate_is_not_credited_wherever_it_begins(w, tmp_path, before):
    path = record(w, tmp_path / "a.csv", w.candidate("c0001")[0].policy, before)
    with pytest.raises(GroundedError, match="those of c0001") as refused:
        w.ingest(path)
    assert refused.value.then == NextCommand("ingest", (str(path), "--candidate", "c0001"))
    assert w.ingest(path, candidate="c0001").candidate == "c0001"


def test_a_log_that_was_stored_before_is_no_run_of_the_candidate_that_waits_now(
    w, tmp_path, monkeypatch, before=1.0
):
    path = record(w, tmp_path / "b.csv", w.candidate("c0002")[0].policy, before)
    first, waiting = w.ingest(path), w.propose().candidate.id
    assert first.candidate == "c0002" and not first.known and waiting != "c0002"
    again = w.ingest(path)
    assert again.known and (again.trial, again.candidate) == (first.trial, "c0002")
    copy = tmp_path / "copy.csv"
    copy.write_bytes(path.read_bytes())
    renamed = w.ingest(copy, candidate="c0002")
    assert renamed.known and renamed.trial == first.trial and len(w.trials()) == 2
    with monkeypatch.context() as nothing:  # the search has ended
        nothing.setattr(foreign, "outstanding", lambda *_: pytest.fail("asked for"))
        assert w.ingest(copy).trial == first.trial


def test_a_log_whose_trial_was_discarded_is_of_the_candidate_that_it_was_of(w, tmp_path):
    first, log = tmp_path / "first.csv", tmp_path / "b.csv"
    ran = w.ingest(record(w, log, w.candidate("c0002")[0].policy, 0.0))
    assert w.propose().candidate.id == "c0003"
    w.discard("t0001", ran.trial)
    for path, trial, candidate in ((first, "t0001", "c0001"), (log, ran.trial, "c0002")):
        again = w.ingest(path, candidate=candidate)
        assert (again.trial, again.candidate, again.verdict) == (trial, candidate, "set aside")
        assert of_code(again, "log.aside")[0].about == (trial,)
    w.restore("t0001")
    assert w.ingest(first).verdict == "first"
    other = w.ingest(log, candidate="c0003")
    assert other.candidate == "c0003" and of_code(other, "log.another")


def test_the_log_of_a_probe_is_not_credited_and_its_export_says_how_it_is_taken_in(w, tmp_path):
    made, _ = w.candidate("c0002")
    turned = replace(made.policy, feedforward=np.array(made.policy.feedforward[::-1]))
    sent = turned.commands(made.predicted_states[None, :-1], turned.past)[0]
    probe = w.save_candidate(
        replace(made, id="c0003", policy=turned, predicted_inputs=sent), kind="probe"
    )
    w.forget()
    with pytest.raises(GroundedError, match=f"those of {probe.id}") as refused:
        w.ingest(record(w, tmp_path / "a.csv", turned, 1.0))
    assert refused.value.then.arguments[1:] == ("--candidate", probe.id)
    out = str(tmp_path / "p.npz")
    done = grounded("-C", w.folder, "export", probe.id, "--runner", "-o", out)
    assert done.out.replace("\\", "").split()[-3:] == ["LOG", "--candidate", probe.id]
    waiting = grounded("-C", w.folder, "export", "c0002", "--runner", "-o", out)
    assert waiting.out.split()[-1] == "LOG"


@pytest.mark.slow
def test_a_strange_log_has_no_start_and_is_taken_with_a_warning_where_it_is_named(w, tmp_path):
    policy = w.candidate("c0002")[0].policy
    driven = 3 * np.sin(np.arange(policy.horizon) / 3)[:, None]
    strange = replace(policy, feedforward=driven, gain=0 * policy.gain)
    path = record(w, tmp_path / "a.csv", strange, 1.0)
    with pytest.raises(GroundedError, match=holding("c0002", "--candidate c0002 anyway")):
        w.ingest(path)
    assert len(w.trials()) == 1
    found = w.ingest(path, candidate="c0002")
    assert found.candidate == "c0002" and len(w.trials()) == 2
    (begins,) = of_code(found, "log.start_assumed")
    assert of_code(found, "log.not_run") and begins.facts["at"] < 1.1


def test_one_log_is_one_trial(w, tmp_path):
    path = record(w, tmp_path / "a.csv", w.candidate("c0002")[0].policy, 0.0)
    first = w.ingest(path)
    for other in ({"candidate": "c0001"}, {"data": True}):
        with pytest.raises(GroundedError, match=f"stored already, as {first.trial}") as refused:
            w.ingest(path, **other)
        assert refused.value.then == NextCommand("discard", (first.trial,))
    assert w.ingest(path, candidate="c0002").known and len(w.trials()) == 2
    w.discard(first.trial)
    kept = w.ingest(path, data=True)
    assert kept.candidate == ""
    with pytest.raises(GroundedError, match=holding(kept.trial, "data")) as refused:
        w.ingest(path)  # "ran c0001, which was made for an earlier task"
    # `next` with the log of a drive: it advised to discard it, and there was no `next:`
    assert "c0002" in str(refused.value)
    assert refused.value.then is not None and refused.value.then == w.status().then
    with pytest.raises(GroundedError, match=holding("c0002", f"discard {kept.trial}")):
        w.ingest(path, candidate="c0002")


def test_a_gap_within_the_run_is_the_reason_that_is_given(w, tmp_path):
    log = record(w, tmp_path / "a.csv", w.candidate("c0002")[0].policy, 4.0)
    table = rows_of(log)
    table[450:470, 1:3] = np.nan
    with pytest.raises(GroundedError, match="max_age_s"):
        w.ingest(written(log, table))


ONLY_POSITIONS = LOGGED.replace('[log.state.v]\npath = "/csv.v"\n', "") + (
    "[estimate]\nmeasured = { x = 0.002 }\n"
)


@pytest.fixture
def blind(tmp_path):
    """Nothing measures its speed; it waits for c0002, and its controller had its own estimate."""
    return waiting(tmp_path, ONLY_POSITIONS)


@pytest.mark.parametrize("differs", [0, 16], ids=["known", "a program's speeds lag"])
def test_a_run_is_found_where_speeds_are_estimated(blind, tmp_path, differs):
    policy = blind.candidate("c0002")[0].policy
    path = record(blind, tmp_path / "a.csv", policy, 0.8, differs=differs)
    found = blind.ingest(path)
    assert found.candidate == "c0002"
    stored_from(blind, path, 0.8)
    assert {one.name for one in found.signals} == {"x", "force"}  # what was logged


def test_an_estimated_speed_knows_what_came_before_the_run_and_after_it(blind, tmp_path):
    policy, off = blind.candidate("c0002")[0].policy, []
    for seed in range(3):
        path = record(blind, tmp_path / f"{seed}.csv", policy, 0.8, seed=seed)
        blind.ingest(path, candidate="c0002")
        table = rows_of(path)
        truth = table[80 + 5 * np.arange(policy.horizon + 1), 2]  # measured, to 0.01 m/s
        found = blind.trials()[-1].trial.states[:, 1]
        assert found[0] == 0.0  # it stood still until its first command
        off.append(found - truth)
    assert np.abs(np.mean(off, axis=0)[[0, -1]]).max() < 0.03
    assert np.sqrt(np.mean(np.square(off))) < 0.03


ITS_OWN = LOGGED + "[estimate]\nmeasured = { x = 0.002 }\n"
ROUGH = (0.002, 0.5)  # m, m/s: a speed by differences


def test_a_run_is_known_by_the_speeds_that_its_program_made_itself(tmp_path, before=0.8):
    w = waiting(tmp_path, ITS_OWN)
    policy = w.candidate("c0002")[0].policy
    path = record(w, tmp_path / "a.csv", policy, before, noise=ROUGH)
    found = w.ingest(path)
    assert found.candidate == "c0002"
    stored, table, k = stored_from(w, path, before)
    assert np.std(stored.states[:-1, 1] - table[k, 2]) > 0.3  # estimated all the same


def run(w, path, policy, strange, before=1.0):
    """The log of a run, its first commands `strange`, not the policy's; each with its own stamp."""
    record(w, path, policy, before)
    table = rows_of(path)
    every, first = round(policy.dt * RATE), round(before * RATE)
    for k, force in enumerate(strange):
        table[first + k * every : first + (k + 1) * every, 3] = force
    table[(np.arange(len(table)) - first) % every != 0, 3] = np.nan
    return written(path, table)


def test_a_run_whose_first_commands_were_not_sent_is_its_candidate_s(w, tmp_path):
    log = run(w, tmp_path / "a.csv", w.candidate("c0002")[0].policy, (-5.0, -4.9))
    toml = w.folder / "grounded.toml"
    toml.write_text(toml.read_text() + "[log.span]\nstart = 1.0\n")
    w = Workspace(w.folder)
    found = w.ingest(log)
    assert found.candidate == "c0002" and not of_code(found, "log.not_run")
    begun = int(w.trials()[-1].meta["start_ns"]) * 1e-9
    assert begun == pytest.approx(1001.0, abs=0.2 / RATE)


def test_rows_out_of_step_with_the_commands_tell_together_when_a_run_begins(w, tmp_path, row=0.011):
    policy = w.candidate("c0002")[0].policy
    path = record(w, tmp_path / "a.csv", policy, 0.8)
    table = rows_of(path)
    t = np.arange(table[0, 0] + 0.003, table[-1, 0], row)
    at = np.floor((t - table[0, 0]) * RATE + 1e-6).astype(int)
    rows = [t, *(np.interp(t, table[:, 0], table[:, k]) for k in (1, 2)), table[at, 3]]
    found = w.ingest(written(tmp_path / "b.csv", np.transpose(rows)))
    assert found.candidate == "c0002"
    begun = w.trials()[-1].meta["start_ns"]
    assert int(begun) * 1e-9 - table[0, 0] == pytest.approx(0.8, abs=0.0025)
