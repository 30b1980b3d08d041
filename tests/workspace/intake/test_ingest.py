"""ingest: our own trials byte for byte, others through [log], each content once."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cli import grounded
from facts import holding, of_code
from grounded.errors import GroundedError
from grounded.trial import Trial
from grounded_trials.store.trial_file import TrialWriter, read_trial, write_trial
from grounded_trials.workspace.candidates.proposing import propose_in
from grounded_trials.workspace.candidates.running import run_candidate
from grounded_trials.workspace.candidates.search_state import standing_in
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.intake.ingest import ingest_log
from workspaces import make


@pytest.fixture
def w(tmp_path):
    return make(tmp_path / "w")


def run(w):
    return run_candidate(w, propose_in(w).candidate.id).trial_file


def plain(T=40, **changes):
    fields = {
        "states": np.column_stack([np.linspace(0, 1, T + 1), np.zeros(T + 1)]),
        "inputs": np.zeros((T, 1)),
        "dt": 0.05,
        "state_names": ("x", "v"),
        "input_names": ("force",),
    }
    return Trial(**fields | changes)


PASSED = """
import sys
passed = set()
def see(frame, event, arg):
    code = frame.f_code
    ours = frame.f_globals.get("__name__", "").startswith("grounded")
    if event == "call" and ours and code.co_name != "<module>":
        passed.add((code.co_filename, code.co_qualname, code.co_firstlineno))
sys.setprofile(see)
from grounded_trials import Workspace
Workspace(sys.argv[1]).ingest(sys.argv[2])
sys.setprofile(None)
slow = [name for name in sys.modules if name.startswith(("grounded.compile.run", "grounded.solve"))]
assert not slow, slow
assert len(passed) <= 500 and len({file for file, *_ in passed}) <= 60, len(passed)
"""


def test_a_faultless_trial_of_ours_passes_a_short_way_and_nothing_is_compiled(w):
    path = run(w)
    done = subprocess.run([sys.executable, "-c", PASSED, w.folder, path], capture_output=True)
    assert not done.returncode, done.stderr.decode()


def test_a_trial_of_ours_is_stored_byte_for_byte(w):
    path = run(w)
    found = ingest_log(w, path)
    assert w.store.list()[0].path.read_bytes() == path.read_bytes()
    assert (found.trial, found.candidate) == ("t0001", "c0001")
    assert found.accepted is True and found.known is False
    assert found.utility == w.task.utility(read_trial(path)[0])


def test_a_simulated_run_is_a_function_of_the_seed_and_its_number(w):
    first, again = run(w), run_candidate(w, "c0001").trial_file
    assert (first.name, again.name) == ("c0001-1.mcap", "c0001-2.mcap")
    assert first.read_bytes() == again.read_bytes()
    ingest_log(w, first)
    later = run_candidate(w, "c0001").trial_file  # its number is in it
    assert later.read_bytes() != again.read_bytes()


def test_a_trial_that_does_not_say_what_it_ran_is_the_outstanding_ones(w, tmp_path):
    ran, _, _ = read_trial(run(w))
    write_trial(tmp_path / "t.mcap", replace(ran, candidate=""), {"kind": "trial"})
    found = ingest_log(w, tmp_path / "t.mcap")
    assert found.candidate == "c0001" and not found.warnings
    (stored,) = w.trials()
    assert stored.meta["task"] == w.task.hash and stored.trial.candidate == "c0001"
    again = ingest_log(w, tmp_path / "t.mcap", "c0001")
    assert again.known and again.trial == found.trial


def test_a_start_is_no_warning_where_earlier_ones_scatter_as_far(w, tmp_path):
    ran, *_ = read_trial(run(w))
    a_step = np.sqrt(-w.task.utility(ran) / len(ran.states) / 10)
    told = []
    for off in (0.7, -0.6, 0.5, -0.7, 3.0):  # of what costs as much as a step
        moved = np.array(ran.states)
        moved[0, 0] += off * a_step
        write_trial(tmp_path / "t.mcap", replace(ran, states=moved), {"kind": "trial"})
        told.append(of_code(ingest_log(w, tmp_path / "t.mcap", "c0001"), "run.start*"))
    codes = [[one.code for one in some] for some in told]
    assert codes[0] == ["run.start"] and codes[-1] == ["run.start_spoils"]
    assert not any("run.start_spoils" in some for some in codes[:-1])


def test_units_that_a_trial_states_must_be_the_models(w, tmp_path, data=True):
    write_trial(tmp_path / "t.mcap", plain(), {}, state_units={"x": "cm", "v": "m / s"})
    with pytest.raises(GroundedError, match=holding("x", "cm", "m")) as refused:
        ingest_log(w, tmp_path / "t.mcap", data=data)
    assert "v [" not in str(refused.value) and not w.store.list()
    write_trial(tmp_path / "u.mcap", plain(), {}, state_units={"x": "m", "v": "m / s"})
    assert ingest_log(w, tmp_path / "u.mcap", data=True).trial


def test_stamps_in_another_unit_are_told_from_lost_samples(w, tmp_path, factor=1e3):
    with TrialWriter(tmp_path / "t.mcap", 0.05, {"x": "m", "v": "m/s"}, {"force": "N"}, {}) as log:
        for k in range(11):
            log.append(0.05 * k * factor, np.zeros(2), np.zeros(1) if k < 10 else None)
    with pytest.raises(GroundedError, match=holding(f"{1 / factor:g} times")):
        ingest_log(w, tmp_path / "t.mcap", data=True)


def test_without_an_outstanding_candidate_it_must_be_named(w, tmp_path):
    write_trial(tmp_path / "t.mcap", plain(), {"kind": "trial"})
    with pytest.raises(GroundedError, match=holding("--candidate", "--data")):
        ingest_log(w, tmp_path / "t.mcap")
    with pytest.raises(GroundedError, match="c0001"):
        ingest_log(w, tmp_path / "t.mcap", "c0001")
    found = ingest_log(w, tmp_path / "t.mcap", data=True)
    assert found.candidate == "" and found.utility is None and found.accepted is None
    assert not w.trials()[0].trial.candidate


def test_data_never_moves_the_search(w):
    ingest_log(w, run(w))
    before = propose_in(w).proposal.candidate
    (w.folder / "candidates" / "c0002.mcap").unlink()
    path = run_candidate(w, "c0001").trial_file
    ingest_log(w, path, data=True)
    after = propose_in(w).proposal.candidate
    assert before.id == after.id == "c0002"
    np.testing.assert_array_equal(before.policy.feedforward, after.policy.feedforward)
    assert standing_in(w).trials == 1


def test_a_run_of_another_task_is_kept_as_data_and_old_trials_are_ignored(w):
    path = run(w)
    ingest_log(w, path)
    config = w.config.file.read_text()
    w.config.file.write_text(config.replace("x = 10.0", "x = 11.0"))
    other = type(w)(w.folder)
    now = standing_in(other)
    assert (now.phase, now.trials, now.utilities) == ("propose", 0, [])
    made = propose_in(other).proposal.candidate
    assert (made.id, made.base) == ("c0002", "")
    w.config.file.write_text(config)
    assert standing_in(type(w)(w.folder)).trials == 1  # and back again


def test_gaps_are_stored_as_they_are_and_bridged_when_read(w, tmp_path):
    made = propose_in(w).proposal.candidate
    states = np.array(plain().states)
    states[10:13] = np.nan
    trial = plain(states=states, candidate=made.id)
    write_trial(tmp_path / "t.mcap", trial, {"kind": "trial"})
    found = ingest_log(w, tmp_path / "t.mcap", made.id)
    assert of_code(found, "log.gaps")[0].facts["samples"] == 6 and np.isfinite(found.utility)
    assert np.isnan(read_trial(w.store.list()[0].path)[0].states).sum() == 6
    assert np.isfinite(w.trials()[0].trial.states).all()


def test_a_trial_of_a_deleted_candidate_still_counts(w):
    path = run(w)
    ingest_log(w, path)
    Path(w.candidate_path("c0001")).unlink()
    fresh = type(w)(w.folder)
    assert standing_in(fresh).incumbent.candidate.id == "c0001"
    again = run_candidate(fresh, "c0001").trial_file
    assert ingest_log(fresh, again).candidate == "c0001"


LOG_OF_A_TABLE = """
[log.state]
x = { path = "/csv.x" }
v = { path = "/csv.v" }

[log.input]
force = { path = "/csv.force" }
"""


def table_in(w, tmp_path, length=4.0):
    """A log of the cart as a table, in a workspace that maps it."""
    t = np.arange(0, length, 0.05)
    rows = np.column_stack([t, np.sin(t), np.cos(t), np.sin(3 * t)])
    np.savetxt(tmp_path / "log.csv", rows, "%.6f", ",", header="t,x,v,force", comments="")
    file = w.folder / "grounded.toml"
    file.write_text(file.read_text() + LOG_OF_A_TABLE)
    return tmp_path / "log.csv", file


def test_a_log_is_not_stored_again_through_another_table(w, tmp_path, mended="scale = 0.001"):
    """Two readings of one run passed for repeats, and their difference for a cause."""
    log, file = table_in(w, tmp_path)
    first = ingest_log(w, log, data=True).trial
    whole = file.read_text()
    file.write_text(whole.replace('/csv.v"', f'/csv.v", {mended}'))
    other, copy = Folder(w.folder), tmp_path / "copy.csv"
    copy.write_bytes(log.read_bytes())
    for again in (log, copy):
        with pytest.raises(GroundedError, match=holding(first, "discard", "again")) as refused:
            ingest_log(other, again, data=True)
    assert refused.value.then.arguments == (first,) and len(other.trials()) == 1
    assert grounded("-C", w.folder, "discard", first).code == 0
    second = ingest_log(Folder(w.folder), log, data=True)
    assert second.trial != first and not second.known
    assert ingest_log(Folder(w.folder), copy, data=True).known
    file.write_text(whole)  # as the one that was set aside was read
    with pytest.raises(GroundedError, match=second.trial):
        ingest_log(Folder(w.folder), log, data=True)


def test_another_part_of_a_recording_is_another_trial(w, tmp_path):
    log, file = table_in(w, tmp_path, 12.0)
    whole = file.read_text()
    for start, end in ((0, 4), (5, 9)):
        file.write_text(whole + f"[log.span]\nstart = {start}.0\nend = {end}.0\n")
        ingest_log(Folder(w.folder), log, data=True)
    assert len(Folder(w.folder).trials()) == 2
    file.write_text(whole + "[log.span]\nstart = 6.0\nend = 12.0\n")
    with pytest.raises(GroundedError, match=holding("t0002")):
        ingest_log(Folder(w.folder), log, data=True)


def test_a_state_without_a_sensor_gets_the_lines_that_estimate_it(w, tmp_path):
    log, file = table_in(w, tmp_path)
    bare = file.read_text().replace('v = { path = "/csv.v" }\n', "")
    file.write_text(bare)
    with pytest.raises(GroundedError, match=holding("'v'", "[estimate]")) as refused:
        ingest_log(Folder(w.folder), log, data=True)
    lines = f"[estimate]\n{refused.value.finding.facts['measured']}".replace("\n", "\nmeasured = ")
    file.write_text(f"{bare}\n{lines}\n")
    found = Folder(w.folder)
    ingest_log(found, log, data=True)
    (kept,) = found.trials()
    assert kept.meta["estimated"] == "v"
    file.write_text(f"{bare}\n{lines.replace('x = ', 'v = 0.1, x = ')}\n")
    with pytest.raises(GroundedError, match=holding("'v'", "measured", "remove it")):
        ingest_log(Folder(w.folder), log, data=True)
    unheard = f"{bare}\n{lines}\n".replace('force = { path = "/csv.force" }', "")
    file.write_text(unheard)
    with pytest.raises(GroundedError, match="'force'") as refused:
        ingest_log(Folder(w.folder), log, data=True)
    assert "[estimate]" not in str(refused.value)


def test_what_can_t_be_judged_is_not_stored(w, tmp_path, monkeypatch, judge="standing_in"):
    """A model that failed on a log left it stored, and every later command failed with it."""
    first, second = run(w), tmp_path / "second.mcap"
    trial = read_trial(first)[0]
    write_trial(second, replace(trial, states=trial.states + 1e-9), meta={})  # it carries no policy
    ingest_log(w, first)
    before = sorted((w.folder / "trials").iterdir())

    def fails(*_, **__):
        raise GroundedError("the control step is not a multiple")

    for path in (first, second):  # what was there stays
        with monkeypatch.context() as patched:
            patched.setattr(f"grounded_trials.workspace.intake.gone_wrong.{judge}", fails)
            with pytest.raises(GroundedError, match="not a multiple"):
                ingest_log(w, path)
        assert sorted((w.folder / "trials").iterdir()) == before
    w.forget()
    assert [one.stored.id for one in w.trials()] == ["t0001"]
