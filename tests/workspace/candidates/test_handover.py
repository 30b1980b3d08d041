"""A candidate is checked when it is handed over; exports drive the same commands elsewhere."""

import csv
import json
import math
import re
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from cli import grounded, plain
from facts import holding, holds
from grounded.errors import GroundedError, NextCommand
from grounded.policy import load
from grounded_trials import Workspace
from grounded_trials.store.candidate_file import encoded_candidate, read_candidate
from grounded_trials.workspace.candidates.exporting import RUNNER, export_in
from grounded_trials.workspace.candidates.handover import checked_candidate, outside_limits
from grounded_trials.workspace.candidates.proposing import propose_in
from grounded_trials.workspace.candidates.running import run_candidate
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.intake.ingest import ingest_log
from grounded_trials.workspace.next_step import exported_as, to_run
from rewriting import with_metadata
from workspaces import CONFIG, MODEL, make

LIMITS, NARROW = "force = [-5.0, 5.0]", "force = [-0.5, 0.5]"
SAFETY = "\n[safety]\nx = [-1.0, {high}]\n"
UNITS = {"state_units": {"x": "m", "v": "m/s"}, "input_units": {"force": "N"}}
RESERVED = ("format", "dt", "states", "inputs", "steps", "policy", "sha256")


@pytest.fixture(scope="module")
def proposed(tmp_path_factory):
    folder = make(tmp_path_factory.mktemp("handover") / "w").folder
    assert Workspace(folder).propose().candidate.id == "c0001"
    return folder


@pytest.fixture
def w(proposed, tmp_path):
    """A workspace whose first candidate waits to be run."""
    return Workspace(shutil.copytree(proposed, tmp_path / "w"))


@pytest.fixture
def ran(w):
    """The same, once that candidate was run."""
    w.ingest(w.run().trial_file)
    return w


def configure(w, text=CONFIG, **models):
    """The user edits grounded.toml, or the model."""
    (w.folder / "grounded.toml").write_text(text)
    for name, source in models.items():
        (w.folder / f"{name}.py").write_text(source)
    w.forget()


def rewrite(w, checksum, **arrays):
    """Somebody writes c0001 with other numbers, and an old checksum, a new one, or none."""
    path = w.candidate_path("c0001")
    policy, x, u, meta = read_candidate(path)
    own = {key: value for key, value in meta.items() if key not in RESERVED}
    data = encoded_candidate(replace(policy, **arrays), x, u, own, **UNITS)[0]
    if checksum != "new":
        data = with_metadata(data, "sha256", meta["sha256"] if checksum == "old" else None)
    path.write_bytes(data)


def hand_overs(w, tmp_path, **how):
    """Every way to hand c0001 over by its name."""
    file = tmp_path / "c.json"
    return [
        lambda: w.run("c0001", **how),
        lambda: w.export("c0001", file, **how),
        lambda: checked_candidate(w, "c0001", **how),
    ]


def refused(w, tmp_path, *parts, **how):
    for hand_over in hand_overs(w, tmp_path, **how):
        with pytest.raises(GroundedError) as caught:
            hand_over()
        for part in parts:
            assert part in str(caught.value)
    assert not list((w.folder / "runs").glob("*.mcap")) and not (tmp_path / "c.json").exists()


def test_what_was_just_proposed_is_handed_over_without_a_word(w, tmp_path):
    assert w.propose().notes == ()
    ran, exported = w.run("c0001"), w.export("c0001", tmp_path / "c.json")
    assert ran.notes == ran.overridden == exported.notes == ()


def test_limits_that_were_narrowed_make_it_void(w, tmp_path):
    configure(w, CONFIG.replace(LIMITS, NARROW))
    refused(w, tmp_path, "c0001", "force", "-5", "[limits] force = [-0.5, 0.5]", "--anyway")
    with pytest.raises(GroundedError) as caught:
        w.run()
    assert caught.value.then == NextCommand("propose")
    made = w.propose()
    assert made.candidate.id == "c0002" and made.proposal.is_new
    (note,) = made.notes
    assert holds(note, "c0001", "void", "c0002")
    assert w.run().candidate == "c0002"
    assert w.propose().notes == ()  # said once


def test_safety_holds_for_the_run_as_the_model_of_today_predicts_it(ran):
    best = ran.status().standing.incumbent
    real = float(best.trials[0].states[:, 0].max())
    stored = float(best.candidate.predicted_states[:, 0].max())
    assert real > stored + 0.01  # the crude model's own prediction was off
    heavier = MODEL.replace("Param(1.0", "Param(1.3")
    configure(ran, CONFIG + SAFETY.format(high=real + 1e-6), model=heavier)
    assert ran.run("best").notes
    configure(ran, CONFIG + SAFETY.format(high=(real + stored) / 2))
    with pytest.raises(GroundedError, match=holding("[safety] x", f"{real:.2f}")):
        ran.run("best")


def test_a_step_that_safety_forbids_now_gives_way_to_another(ran):
    second = ran.propose().candidate
    assert second.id == "c0002"
    most = float(second.predicted_states[:, 0].max())
    configure(ran, CONFIG + SAFETY.format(high=most - 1e-3))
    made = ran.propose()
    assert any(holds(note, "c0002", "void") for note in made.notes)
    assert made.candidate.id == "c0003"
    assert made.candidate.predicted_states[:, 0].max() < most - 1e-3
    assert ran.run().candidate == "c0003"


def test_what_is_to_be_run_once_more_is_not_replaced_but_refused(tmp_path):
    twice = CONFIG.replace("[search]", "[search]\nrepeats = 2")
    real = "latency = {}\nfrom model import model\nmodel = model.with_values({'mass': 1.4})\n"
    noisy = twice + "[system.noise]\nmeasurement = { x = 0.01 }\n"
    make(tmp_path / "w", config=noisy, real=real)
    w = Workspace(tmp_path / "w")
    w.propose()
    w.ingest(w.run().trial_file)
    assert w.propose().candidate.id == "c0001"
    configure(w, noisy + SAFETY.format(high=0.5))
    with pytest.raises(GroundedError, match=holding("c0001", "[safety]", "--anyway")):
        w.propose()
    assert w.run(anyway=True).overridden and len(w.candidate_ids()) == 1


@pytest.mark.parametrize(("checksum", "anyway"), [("old", True), ("new", True), ("none", False)])
def test_a_rewritten_candidate_is_refused_whatever_its_checksum(w, tmp_path, checksum, anyway):
    wide = {"low": np.array([-1e9]), "high": np.array([1e9])}
    rewrite(w, checksum, feedforward=np.full((40, 1), 5.4e6), **wide)
    refused(w, tmp_path, "c0001.mcap", anyway=anyway)
    with pytest.raises(GroundedError, match=holding("c0001.mcap")):
        w.propose()
    (found,) = w.verify().damaged
    assert "c0001.mcap" in found.file and "rewritten" in found.reason


def forget_hand_outs(w):
    """As a workspace of 0.1, which kept none."""
    for note in (w.folder / "trials").glob("n*.json"):
        note.unlink()


def test_a_file_that_is_not_what_its_trial_ran_is_refused(ran, tmp_path):
    forget_hand_outs(ran)
    gain = read_candidate(ran.candidate_path("c0001"))[0].gain
    rewrite(ran, "new", gain=gain * (1 + 1e-12))  # the prediction can't show so little
    with pytest.raises(GroundedError, match=holding("c0001.mcap", "t0001")):
        ran.export("best", tmp_path / "c.json")


def test_a_renamed_or_copied_candidate_is_refused(w, tmp_path):
    shutil.copy(w.candidate_path("c0001"), w.candidate_path("c0007"))
    for hand_over in (lambda: w.run("c0007"), lambda: w.export("c0007"), w.propose, w.run):
        with pytest.raises(GroundedError, match=holding("c0007.mcap", "c0001")):
            hand_over()
    (found,) = w.verify().damaged
    assert "c0007.mcap" in found.file
    w.candidate_path("c0001").unlink()
    with pytest.raises(GroundedError, match=holding("c0007.mcap", "c0001")):
        w.propose()


@pytest.mark.parametrize("key", ["task", "predicted_utility"])
def test_metadata_that_was_rewritten_is_found(w, key):
    path = w.candidate_path("c0001")
    path.write_bytes(with_metadata(path.read_bytes(), key, "0"))
    with pytest.raises(GroundedError, match="rewritten"):
        w.run("c0001")
    assert len(w.verify().damaged) == 1


def test_another_robots_candidate_is_refused_even_anyway(w, tmp_path):
    other = MODEL.replace("s.v", "s.w").replace('"v"', '"w"')
    configure(w, model=other, real=other)
    refused(w, tmp_path, "x and v", "x and w", anyway=True)


def test_other_units_and_another_dt_are_refused(w, tmp_path):
    configure(w, model=MODEL.replace('"N"', '"kN"'))
    refused(w, tmp_path, "force", "kN")
    configure(w, CONFIG.replace("dt = 0.05", "dt = 0.1"), model=MODEL)
    rows = [f"{0.1 * i:.1f},0.5" for i in range(41)]
    (w.folder / "target.csv").write_text("t,x\n" + "\n".join(rows) + "\n")
    refused(w, tmp_path, "dt", "0.100 s")


def test_anyway_says_what_it_overrides_before_the_robot_moves(w, tmp_path):
    configure(w, CONFIG.replace(LIMITS, NARROW))
    told = []

    def warn(one):
        told.append(one)
        assert not list((w.folder / "runs").glob("*.mcap"))

    ran = w.run("c0001", anyway=True, warn=warn)
    assert ran.trial_file.is_file() and len(told) == len(ran.overridden) == 2
    assert {one.code for one in told} == {"plan.refused"}
    exported = w.export("c0001", tmp_path / "c.json", anyway=True)
    assert {one.code for one in ran.overridden} <= {one.code for one in exported.findings}
    assert exported.file.is_file()


def test_the_commands_refuse_and_warn_on_stderr(w, tmp_path):
    configure(w, CONFIG.replace(LIMITS, NARROW))
    for command in (("run", "c0001"), ("export", "c0001", "-o", tmp_path / "c.csv")):
        done = grounded("-C", w.folder, *command)
        assert done.code == 1 and plain(done.err).endswith("next: grounded propose\n")
        done = grounded("-C", w.folder, *command, "--anyway")
        assert done.code == 0 and "warning" in done.err and "warning" not in done.out


def test_an_open_loop_policy_must_send_and_hold_what_is_allowed(w):
    policy = replace(w.candidate("c0001")[0].policy, gain=None, reference=None)
    sent = np.zeros((40, 1))
    assert not list(outside_limits(w.task, replace(policy, feedforward=sent)))
    (found,) = outside_limits(w.task, replace(policy, feedforward=sent, past=np.array([-6.0])))
    assert found.about == ("force",) and found.facts["value"] == "-6"
    sent[7] = 5.1
    (found,) = outside_limits(w.task, replace(policy, feedforward=sent))
    assert found.about == ("force",) and found.facts["value"] == "5.1"


def exported(w, folder, form):
    propose_in(w)
    path = folder / f"c.{form}"
    assert export_in(w, "c0001", path, form=form).candidate == "c0001"
    return path


def drive_by_json(document, states):
    """The control law of docs/robot.md in plain Python: z, differences that wrap, clip."""
    names, sent, out = document["state_names"], {}, []
    held = dict(zip(document["input_names"], document["past"], strict=True))
    for t, s in enumerate(states):
        z = list(s)
        for name in document["z_names"][len(names) :]:
            which, back = name[:-1].split("[t-")
            z.append(sent.get((which, t - int(back)), held[which]))
        command = []
        for i, name in enumerate(document["input_names"]):
            u = document["feedforward"][t][i]
            for j, value in enumerate(z if "gain" in document else ()):
                d = value - document["reference"][t][j]
                if j < len(names) and names[j] in document["angles"]:
                    d = math.remainder(d, 2 * math.pi)
                u += document["gain"][t][i][j] * d
            low, high = document["low"][i], document["high"][i]
            u = u if low is None else max(u, low)
            u = u if high is None else min(u, high)
            sent[name, t] = u
            command.append(u)
        out.append(command)
    return np.array(out)


@pytest.mark.parametrize("example", ["cart", "car-turn"])
def test_a_reader_of_the_json_drives_as_the_runner_does(tmp_path, example):
    w = make(tmp_path / "w", example)
    document = json.loads(exported(w, tmp_path, "json").read_text())
    run = load(exported(w, tmp_path, "npz"))
    H, n = run.policy.horizon, len(run.policy.state_names)
    states = np.zeros((H, n)) if run.policy.reference is None else run.policy.reference[:, :n]
    states = states + 0.2 * np.random.default_rng(0).normal(size=(H, n))
    expected = [run.action(t * run.policy.dt, states[t]) for t in range(H)]
    np.testing.assert_allclose(drive_by_json(document, states), expected, atol=1e-9)
    assert ("gain" in document) == (example != "car-turn")


def test_inputs_without_limits_are_null_in_json_and_said_in_csv(tmp_path):
    w = make(tmp_path / "w", config=CONFIG.replace("force = [-5.0, 5.0]", ""))
    document = json.loads(exported(w, tmp_path, "json").read_text())
    assert document["low"] == [None] and document["high"] == [None]
    text = exported(w, tmp_path, "csv").read_text()
    assert re.search(r"limits \[(none, none|-inf, inf)\]", text)
    with pytest.raises(GroundedError, match="limits"):
        exported(w, tmp_path, "npz")


def test_a_csv_is_read_by_any_reader_that_skips_hashes(tmp_path):
    w = make(tmp_path / "w", "car-circle")
    lines = exported(w, tmp_path, "csv").read_text().splitlines()
    head = [line for line in lines if line.startswith("#")]
    assert head == lines[: len(head)]  # all before the header
    rows = list(csv.DictReader(lines[len(head) :]))
    policy = w.candidate("c0001")[0].policy
    gain = np.array(
        [
            [[float(r[f"gain.{u}.{z}"]) for z in policy.z_names] for u in policy.input_names]
            for r in rows
        ]
    )
    np.testing.assert_array_equal(gain, policy.gain)


def test_the_runner_beside_an_export_drives_without_grounded(tmp_path):
    w = make(tmp_path / "w")
    (tmp_path / "robot").mkdir()
    propose_in(w)
    done = export_in(w, "c0001", tmp_path / "robot" / "c.npz", runner=True)
    assert done.format == "npz" and done.runner == tmp_path / "robot" / RUNNER
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); import grounded_runner as g\n"
        "r = g.load(sys.argv[2], states=('x', 'v'), inputs=('force',))\n"
        "print(*[float(r.action(0.05 * k, [0.01 * k, 0.0])[0]) for k in range(40)])\n"
        "assert not any(n == 'grounded' or n.startswith('grounded.') for n in sys.modules)"
    )
    words = [sys.executable, "-I", "-c", code, str(done.runner.parent), str(done.file)]
    found = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    here = load(done.file)
    expected = [float(here.action(0.05 * k, [0.01 * k, 0.0])[0]) for k in range(40)]
    assert [float(u) for u in found.split()] == expected
    with pytest.raises(GroundedError, match=holding("npz", "json")):
        export_in(w, "c0001", tmp_path / "c.json", form="json", runner=True)


def test_after_the_search_an_export_asks_for_no_further_run(tmp_path):
    w = make(tmp_path / "w").folder
    export = ("-C", w, "export", "best", "--runner", "-o", tmp_path / "c.npz")
    assert grounded("-C", w, "learn", "--trials", "1").code == 0
    assert not grounded(*export, "--json").json["search_ended"]
    assert grounded("-C", w, "learn").code == 0
    assert plain(grounded(*export).out).endswith("next: grounded report --html\n")
    assert grounded(*export, "--json").json["search_ended"]


def test_a_candidate_is_exported_beside_a_damaged_file_of_another(tmp_path):
    w = make(tmp_path / "w")
    ingest_log(w, run_candidate(w, propose_in(w).candidate.id).trial_file)
    second = propose_in(w).candidate.id
    ingest_log(w, run_candidate(w, second).trial_file)
    damaged = w.store.list()[-1].path
    damaged.chmod(0o644)
    damaged.write_bytes(damaged.read_bytes()[:-100])
    done = export_in(Folder(w.folder), "c0001", tmp_path / "c.json", form="json")
    assert done.file.is_file() and done.named == ("--candidate", "c0001")
    with pytest.raises(GroundedError, match="damaged"):  # which one is best, nobody knows
        export_in(Folder(w.folder), "best", tmp_path / "b.json", form="json")


def test_a_candidate_that_was_exported_is_to_be_run_and_its_log_taken_in(tmp_path, monkeypatch):
    w = make(tmp_path / "w", config=CONFIG.partition("[system]")[0])
    propose_in(w)
    monkeypatch.chdir(tmp_path)
    for form in ("npz", "json", "csv"):
        assert to_run(w, "c0001").verb == "export"
        path = tmp_path / f"c0001.{form}"
        export_in(w, "c0001", path, form=form)
        assert to_run(w, "c0001").verb == "next" and exported_as(w, "c0001") == form
        path.unlink()


def test_an_ending_that_names_no_format_is_refused_unless_the_format_is_named(tmp_path):
    w = make(tmp_path / "w")
    propose_in(w)
    ingest_log(w, run_candidate(w, None).trial_file)
    wrong = [("c0001", "a.xyz"), ("c0001", "a.mcap"), ("t0001", "a.foo"), ("t0001", "a.json")]
    for name, file in wrong:
        done = grounded("-C", w.folder, "export", name, "-o", tmp_path / file)
        assert done.code == 1 and "csv" in done.err and "npz" in done.err, done.err
        assert not (tmp_path / file).exists()
    done = grounded("-C", w.folder, "export", "t0001", "--runner", "-o", tmp_path / "b")
    assert done.code == 1 and not (tmp_path / "b").exists()
    named = grounded("-C", w.folder, "export", "c0001", "--format", "csv", "-o", tmp_path / "a.txt")
    assert named.code == 0 and (tmp_path / "a.txt").read_text().startswith("# format")
    plain_name = grounded("-C", w.folder, "export", "c0001", "-o", tmp_path / "plain")
    assert plain_name.code == 0 and json.loads((tmp_path / "plain").read_text())["dt"] == 0.05
    folder = grounded("-C", w.folder, "export", "c0001", "-o", ".")
    assert folder.code == 1 and "folder" in folder.err
