"""A log that ends before the run does: cut off by the recorder, or by a crash."""

from dataclasses import replace

import numpy as np
import pytest

from cli import grounded
from facts import holds, of_code
from grounded.plant import Plant
from grounded_trials import Workspace
from grounded_trials.store.trial_file import write_trial
from grounded_trials.workspace.intake.remarks.gone_wrong import as_before
from recorded import LOGGED, record
from workspaces import make


def waiting(folder):
    w = Workspace(make(folder / "w", config=LOGGED).folder)
    return w, w.propose().candidate.policy


@pytest.mark.parametrize("until", [1.3])
def test_a_log_that_is_cut_off_is_told_from_a_crash(tmp_path, until):
    w, policy = waiting(tmp_path)
    log = record(w, tmp_path / "a.csv", policy, 0.7, until=until)
    out = grounded("-C", w.folder, "ingest", log)
    told = " ".join(f"{out.out} {out.err}".split())
    assert holds(told, "no utility: it ended early") and "crashed:" not in told
    assert f"`grounded -C {w.folder} discard t0001`" in told
    now = w.forget().status()
    assert now.then.arguments == ("t0001",) and holds(now.notes[0], "t0001", "recording")
    told = grounded("-C", w.folder, "status").out
    assert holds(told, "ended early", "waiting", "discard t0001") and "crashed" not in told
    report = grounded("-C", w.folder, "report").out
    assert holds(report, "ended early", "waiting") and report.split()[-2:] == told.split()[-2:]
    assert w.propose().candidate.id == "c0002"  # it counts as failed, if the user goes on
    assert w.status().then.verb != "discard"


def test_a_state_without_values_in_a_log_that_goes_on_is_named(tmp_path):
    w, policy = waiting(tmp_path)
    log = record(w, tmp_path / "a.csv", policy, 0.7)
    header, *rows = log.read_text().splitlines()
    x, cut = header.split(",").index("x"), round(len(rows) * 0.55)
    lost = [row.split(",") for row in rows[cut:]]
    for row in lost:
        row[x] = ""
    log.write_text("\n".join([header, *rows[:cut], *(",".join(row) for row in lost)]) + "\n")
    found = w.ingest(log)
    (told,) = of_code(found, "run.early", "run.failed")
    assert told.facts["silent"] == ("x",) and not of_code(found, "log.short")


def driven(w, policy, off=0.0):
    """A run of c0001, which is off by so much from 1.5 s on."""
    robot = Plant(w.base_model.with_values({"mass": 1.1}))
    trial = robot.run(policy, dict.fromkeys(("x", "v"), 0.0), np.random.default_rng(0))
    states = np.array(trial.states)
    states[:, 0] += off * np.clip((np.arange(41) - 20) / 10, 0, 1)
    sent = policy.commands(states[None, :-1], policy.past)[0]
    return replace(trial, states=states, inputs=sent, candidate="c0001")


def test_a_run_that_was_leaving_its_prediction_counts_as_failed(tmp_path):
    w, policy = waiting(tmp_path)
    run = driven(w, policy, 0.3).until(29)
    write_trial(tmp_path / "t.mcap", run, {"kind": "trial", "task": w.task.hash})
    out = grounded("-C", w.folder, "ingest", tmp_path / "t.mcap")
    told = " ".join(f"{out.out} {out.err}".replace("\\\n", "").split())
    assert holds(told, "failed candidate", f"{w.folder} propose")
    assert "no utility, crashed: it did not run to the end" in told  # was "utility failed, crashed"


def test_a_run_that_was_about_to_leave_safety_may_have_crashed(tmp_path):
    w, policy = waiting(tmp_path)
    run, (own, _) = driven(w, policy).until(25), w.candidate("c0001")
    assert as_before(w.task, own, run)
    for room, inside in ((0.01, False), (1.0, True)):
        high = run.states[-1] + [room, np.inf]
        assert as_before(replace(w.task, safety_high=high), own, run) is inside
