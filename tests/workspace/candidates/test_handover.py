"""A candidate is checked when it is handed over: what changed since it was made is found."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from cli import grounded, plain
from facts import holding, holds
from grounded.errors import GroundedError, NextCommand
from grounded_trials import Workspace
from grounded_trials.store.candidate_file import encoded_candidate, read_candidate
from grounded_trials.workspace.candidates.handover import checked_candidate, outside_limits
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
    note, held = made.notes
    assert holds(note, "c0001", "void", "c0002")
    assert holds(held, "force", "[limits]")  # half a newton does not reach the target
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
    with pytest.raises(GroundedError, match=holding("c0001", "1 trial", "[safety]", "--anyway")):
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
