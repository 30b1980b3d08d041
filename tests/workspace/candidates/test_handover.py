"""A candidate is checked when it is handed over: what changed since it was made is found."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from cli import grounded, plain
from facts import holding, holds
from grounded.errors import GroundedError, NextCommand
from grounded.search.planner import predicted
from grounded_trials import Workspace
from grounded_trials.store.candidate_file import encoded_candidate, read_candidate
from grounded_trials.store.trial_file import read_trial, write_trial
from grounded_trials.workspace.candidates.handover import checked_candidate, intact, outside_limits
from grounded_trials.workspace.identity import encoded
from rewriting import with_metadata
from workspaces import CONFIG, MODEL, make

LIMITS, NARROW = "force = [-5.0, 5.0]", "force = [-0.5, 0.5]"
SAFETY = "\n[safety]\nx = [-1.0, {high}]\n"
UNITS = {"state_units": {"x": "m", "v": "m/s"}, "input_units": {"force": "N"}}
RESERVED = ("format", "dt", "states", "inputs", "steps", "policy", "sha256")


@pytest.fixture
def w(tmp_path):
    """A workspace whose first candidate waits to be run."""
    make(tmp_path / "w")
    workspace = Workspace(tmp_path / "w")
    assert workspace.propose().candidate.id == "c0001"
    return workspace


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


def test_a_step_that_may_well_lose_is_handed_over_with_a_word(ran):
    """It was handed over as any other, though the search itself had put it last."""
    made = ran.propose().candidate
    assert checked_candidate(ran, made.id).notes == ()
    doubted = replace(made, id="c0003", predicted_gain=0.07, likely_off=0.3)
    ran.save_candidate(doubted)
    assert ran.candidate("c0003")[0].likely_off == 0.3
    (note,) = checked_candidate(ran, "c0003").notes
    assert all(part in note for part in ("c0003", "0.07", "0.3", made.base))
    wild = replace(made, id="c0004", predicted_gain=0.07, likely_off=1.44e8)
    ran.save_candidate(wild)  # two crashed runs had said so, of a base that cost 1,200
    (note,) = checked_candidate(ran, "c0004").notes
    assert "e+08" not in note and f"more than the whole cost of {made.base}" in note


def test_a_doubted_step_from_one_that_was_doubted_and_won_is_doubted_less(ran):
    """A crane's three steps would `well lose`, and won by three to five times."""
    best = ran.status().standing.incumbent
    made = replace(ran.propose().candidate, id="c0003", predicted_gain=0.07, likely_off=0.3)
    assert "c0003 may well lose: it" in made.doubt(best)
    won = replace(best, candidate=replace(best.candidate, predicted_gain=1.0, likely_off=2.0))
    assert "c0003 may lose, as was said of c0001, which won: it" in made.doubt(won)


def test_what_was_just_proposed_is_handed_over_without_a_word(w, tmp_path):
    assert w.propose().proposal.notes == ()
    ran, exported = w.run("c0001"), w.export("c0001", tmp_path / "c.json")
    assert ran.notes == ran.overridden == exported.notes == exported.overridden == ()


def test_limits_that_were_narrowed_make_it_void(w, tmp_path):
    configure(w, CONFIG.replace(LIMITS, NARROW))
    why = "its own limits of force are [-5, 5], wider than [limits] force = [-0.5, 0.5] N"
    refused(w, tmp_path, "c0001", why, "--anyway")
    with pytest.raises(GroundedError) as caught:
        w.run()
    assert caught.value.then == NextCommand("propose")
    made = w.propose()
    assert made.candidate.id == "c0002" and made.proposal.is_new
    note, held = made.proposal.notes
    assert note == f"c0001 was not run and is void: {why}; run c0002 instead"
    assert holds(held, "force", "[limits]")  # half a newton does not reach the target
    assert w.run().candidate == "c0002"
    assert w.propose().proposal.notes == ()  # said once


def test_another_target_makes_it_void_too(w, tmp_path):
    configure(w, CONFIG.replace("x = 10.0", "x = 11.0"))
    with pytest.raises(GroundedError, match=holding("c0001", "task")) as caught:
        w.run("c0001")
    assert caught.value.then.verb == "propose"
    (note,) = w.propose().proposal.notes
    assert holds(note, "c0001", "void", "task", "c0002")
    with pytest.raises(GroundedError, match=holding("c0001", "another task", "not run")) as caught:
        w.export("c0001", tmp_path / "c.json")  # though the limits hold: its log was c0002's once
    assert caught.value.then.verb == "propose" and not (tmp_path / "c.json").exists()
    exported = w.export("c0001", tmp_path / "c.json", anyway=True)
    assert "another task" in exported.overridden[0]


def test_a_best_of_an_earlier_task_is_exported_only_inside_the_limits(ran, tmp_path):
    configure(ran, CONFIG.replace(LIMITS, "force = [-9.0, 9.0]"))
    ran.export("c0001", tmp_path / "c.json")
    configure(ran, CONFIG.replace(LIMITS, NARROW))
    with pytest.raises(GroundedError, match="wider than"):
        ran.export("c0001", tmp_path / "d.json")
    assert (tmp_path / "c.json").exists() and not (tmp_path / "d.json").exists()


def test_safety_that_was_narrowed_replaces_it_or_ends_the_search(w, tmp_path):
    configure(w, CONFIG + SAFETY.format(high=0.5))
    refused(w, tmp_path, "is predicted to take x to", "outside [safety] x = [-1, 0.5]")
    with pytest.raises(GroundedError, match="outside \\[safety\\]"):
        w.run()
    made = w.propose()
    assert made.candidate is None and made.standing.ending == "not allowed"
    assert any(holds(note, "c0001", "void") for note in made.proposal.notes)
    configure(w, CONFIG)
    assert w.propose().candidate.id == "c0001"


def test_the_first_run_is_told_how_near_safety_it_is_to_come_and_then_that_it_left(tmp_path):
    box = "[safety]\nx = [-1.0, 1.1]\nv = [-9.0, 9.0]\n"
    w = Workspace(make(tmp_path / "w", config=CONFIG + box).folder)
    first = w.propose().proposal
    predicted = first.candidate.predicted_states[:, 0]
    (note,) = [n for n in first.notes if "no run has tested" in n]
    assert f"{1.1 - predicted.max():.3g} m of the upper bound of x" in note
    assert "of v" not in note  # which is farther from its bounds than it goes
    ran, *_ = read_trial(w.run().trial_file)
    states = ran.states + np.linspace(0, 0.5, len(ran.states))[:, None] * [1.0, 0.0]
    file = tmp_path / "t.mcap"
    write_trial(file, replace(ran, states=states), {"kind": "trial"})
    (said,) = [one for one in w.ingest(file, candidate="c0001").warnings if "[safety]" in one]
    k = int(np.argmax(states[:, 0]))
    assert holds(said, "[safety] x = [-1, 1.1]", f"{states[k, 0]:.3g} m", f"{0.05 * k:.2f} s")
    assert f"{predicted[k]:.3g} m was predicted" in said
    assert not [n for n in w.propose().proposal.notes if "no run has tested" in n]


def test_a_bound_that_the_start_is_nearest_to_is_no_news(tmp_path):
    """`within 0.05 m of the bound of x (at 0 s)`: that is where somebody put the robot."""
    box = "[safety]\nx = [-0.05, 1.2]\n"
    w = Workspace(make(tmp_path / "w", config=CONFIG + box).folder)
    (note,) = [n for n in w.propose().proposal.notes if "no run has tested" in n]
    assert "the upper bound of x" in note and "at 0 s" not in note and "lower" not in note


def test_speeds_that_are_fed_back_but_not_logged_are_told_with_the_first_candidate(tmp_path):
    """A student's program had to guess that it computes two speeds that no column held."""
    x, estimate = '[log.state.x]\npath = "/csv.x"\n', "[estimate]\nmeasured = { x = 0.002 }\n"
    u, v = '[log.input.force]\npath = "/csv.u"\n', '[log.state.v]\npath = "/csv.v"\n'
    w = Workspace(make(tmp_path / "w", config=CONFIG + x + u + estimate).folder)
    made = w.propose()
    assert np.abs(made.proposal.candidate.policy.gain[:, :, 1]).max() > 0
    (note,) = [n for n in made.proposal.notes if "feeds back" in n]
    assert holds(note, "[log]", "[estimate] measured", "diagnose", "how late")
    assert (
        holds(note, "c0001", "v", "no column")
        and note in w.export("c0001", tmp_path / "c.json").notes
    )
    for name, table in (("logged", x + u + v + estimate), ("measured", x + u + v)):
        whole = Workspace(make(tmp_path / name, config=CONFIG + table).folder)
        assert not [n for n in whole.propose().proposal.notes if "feeds back" in n]


def test_a_first_plan_that_safety_forbids_says_what_to_do_and_not_to_diagnose(tmp_path):
    """There was no trial, and `next:` was to diagnose it; then it was to propose it again."""
    w = Workspace(make(tmp_path / "w", config=CONFIG + SAFETY.format(high=0.5)).folder)
    done = w.propose()
    assert done.candidate is None and done.then == NextCommand("target", ("SHAPE",))
    assert holds(" ".join(done.proposal.notes), "outside [safety] x = [-1, 0.5]", "`target`")
    assert w.status().then == NextCommand("propose")


def test_a_step_that_safety_forbids_now_gives_way_to_another(ran):
    second = ran.propose().candidate
    assert second.id == "c0002"
    most = float(second.predicted_states[:, 0].max())
    configure(ran, CONFIG + SAFETY.format(high=most - 1e-3))
    made = ran.propose()
    assert any(holds(note, "c0002", "void") for note in made.proposal.notes)
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


def test_safety_holds_for_the_run_as_the_model_of_today_predicts_it(ran, tmp_path):
    """The best may be run again after a fit; where it leads is predicted anew."""
    best = ran.status().standing.incumbent
    real = float(best.trials[0].states[:, 0].max())
    stored = float(best.candidate.predicted_states[:, 0].max())
    assert abs(real - stored) > 0.01  # the crude model's own prediction was off
    assert real > stored
    heavier = MODEL.replace("Param(1.0", "Param(1.3")
    configure(ran, CONFIG + SAFETY.format(high=real + 1e-6), model=heavier)
    assert "predicted again" in ran.run("best").notes[0]
    configure(ran, CONFIG + SAFETY.format(high=(real + stored) / 2))
    with pytest.raises(GroundedError, match=holding("[safety] x", f"{real:.3f}")):
        ran.run("best")


def test_a_model_that_was_changed_makes_an_unrun_candidate_void(w, tmp_path):
    configure(w, model=MODEL.replace("Param(1.0", "Param(1.2"))
    refused(w, tmp_path, "not run and is void: the model was changed")
    made = w.propose()
    (note,) = made.proposal.notes
    assert made.candidate.id == "c0002" and holds(note, "c0001", "void", "model")


@pytest.mark.parametrize("checksum", ["old", "new", "none"])
@pytest.mark.parametrize("anyway", [False, True])
def test_a_rewritten_candidate_is_refused_whatever_its_checksum(w, tmp_path, checksum, anyway):
    """FACTS 9: 5.4e6 N were sent, and `verify` found nothing."""
    wide = {"low": np.array([-1e9]), "high": np.array([1e9])}
    rewrite(w, checksum, feedforward=np.full((40, 1), 5.4e6), **wide)
    told = ("c0001.mcap",) if checksum == "old" else ("c0001.mcap", "5.4e+06")
    refused(w, tmp_path, *told, anyway=anyway)
    with pytest.raises(GroundedError, match=holding(*told)):
        w.propose()
    (found,) = w.verify().damaged
    assert "c0001.mcap" in found.file and "rewritten" in found.reason


def test_a_candidate_for_a_robot_with_old_samples_is_no_rewritten_one(w):
    """Its policy sends what it predicts for the samples that the robot will have."""
    made, planner = w.candidate("c0001")[0], w.planner
    late = replace(planner.plan.problem(exact=True), age=0.3 * w.task.dt)
    run = predicted(late, made.policy)
    states, inputs = run.states, run.inputs
    aged = replace(made, sample_age=late.age, predicted_states=states, predicted_inputs=inputs)
    assert intact(encoded(aged, w.task, "search"), "c0001")[0].sample_age == late.age
    with pytest.raises(GroundedError, match="rewritten"):
        intact(encoded(replace(aged, sample_age=0.0), w.task, "search"), "c0001")


def test_deleting_what_was_rewritten_brings_the_candidate_back(w):
    before = w.candidate_bytes("c0001")
    rewrite(w, "old", feedforward=np.ones((40, 1)))
    w.candidate_path("c0001").unlink()
    assert w.propose().candidate.id == "c0001" and w.candidate_bytes("c0001") == before


def forget_hand_outs(w):
    """As a workspace of 0.1, which kept none."""
    for note in (w.folder / "trials").glob("n*.json"):
        note.unlink()


def test_wider_limits_in_the_file_are_found_without_a_checksum(w, tmp_path):
    forget_hand_outs(w)
    rewrite(w, "none", low=np.array([-50.0]), high=np.array([50.0]))
    refused(w, tmp_path, "its own limits of force are [-50, 50]")


def test_a_file_that_is_not_what_its_trial_ran_is_refused(ran, tmp_path):
    forget_hand_outs(ran)
    gain = read_candidate(ran.candidate_path("c0001"))[0].gain
    rewrite(ran, "new", gain=gain * (1 + 1e-12))  # the prediction can't show so little
    with pytest.raises(GroundedError, match=holding("c0001.mcap", "t0001")):
        ran.export("best", tmp_path / "c.json")


def test_a_renamed_or_copied_candidate_is_refused(w, tmp_path):
    shutil.copy(w.candidate_path("c0001"), w.candidate_path("c0007"))
    for hand_over in (lambda: w.run("c0007"), lambda: w.export("c0007"), w.propose, w.run):
        with pytest.raises(GroundedError, match=holding("c0007.mcap", "'c0001'")):
            hand_over()
    (found,) = w.verify().damaged
    assert "c0007.mcap" in found.file
    w.candidate_path("c0001").unlink()
    with pytest.raises(GroundedError, match=holding("c0007.mcap", "'c0001'")):
        w.propose()


@pytest.mark.parametrize("key", ["task", "id", "model", "predicted_utility", "kind"])
def test_metadata_that_was_rewritten_is_found(w, key):
    path = w.candidate_path("c0001")
    path.write_bytes(with_metadata(path.read_bytes(), key, "0"))
    with pytest.raises(GroundedError, match="rewritten"):
        w.run("c0001")
    assert len(w.verify().damaged) == 1


def test_a_file_of_an_older_version_is_handed_over_with_a_note(w):
    forget_hand_outs(w)
    path = w.candidate_path("c0001")
    path.write_bytes(with_metadata(path.read_bytes(), "sha256", None))
    (note,) = w.propose().proposal.notes
    assert holds(note, "c0001", "checksum")
    assert w.run().notes == (note,) and w.verify().damaged == ()


def test_another_robots_candidate_is_refused_even_anyway(w, tmp_path):
    other = MODEL.replace("s.v", "s.w").replace('"v"', '"w"')
    configure(w, model=other, real=other)
    refused(w, tmp_path, "another robot", "x, v", "x, w", anyway=True)


def test_other_units_and_another_dt_are_refused(w, tmp_path):
    configure(w, model=MODEL.replace('"N"', '"kN"'))
    refused(w, tmp_path, "it has force in N, but the current model has it in kN")
    configure(w, CONFIG.replace("dt = 0.05", "dt = 0.1"), model=MODEL)
    rows = [f"{0.1 * i:.1f},0.5" for i in range(41)]
    (w.folder / "target.csv").write_text("t,x\n" + "\n".join(rows) + "\n")
    refused(w, tmp_path, "it runs every 0.05 s, but [task] dt is 0.1 s")


def test_anyway_says_what_it_overrides_before_the_robot_moves(w, tmp_path):
    configure(w, CONFIG.replace(LIMITS, NARROW))
    told = []

    def warn(text):
        told.append(text)
        assert not list((w.folder / "runs").glob("*.mcap"))

    ran = w.run("c0001", anyway=True, warn=warn)
    assert ran.trial_file.is_file() and len(told) == len(ran.overridden) == 2
    assert "[limits] force" in told[0] and "task" in told[1]
    exported = w.export("c0001", tmp_path / "c.json", anyway=True)
    assert len(exported.overridden) == 2 and exported.file.is_file()


def test_the_commands_refuse_and_warn_on_stderr(w, tmp_path):
    configure(w, CONFIG.replace(LIMITS, NARROW))
    out = tmp_path / "c.csv"
    for command in (("run", "c0001"), ("export", "c0001", "-o", out)):
        done = grounded("-C", w.folder, *command)
        assert done.code == 1 and "[limits] force" in words(done.err)
        assert words(done.err).endswith("next: grounded propose")
        done = grounded("-C", w.folder, *command, "--anyway")
        assert done.code == 0 and "warning: c0001 is" in words(done.err)
        assert "[limits] force" in words(done.err)
        assert "warning" not in done.out
    done = grounded("-C", w.folder, "propose")
    assert holds(words(done.err), "note", "c0001", "void")


def words(text):
    return " ".join(plain(text).split())


def test_an_open_loop_policy_must_send_and_hold_what_is_allowed(w):
    policy = replace(w.candidate("c0001")[0].policy, gain=None, reference=None)
    sent = np.zeros((40, 1))
    sent[7] = 5.1
    (found,) = outside_limits(w.task, replace(policy, feedforward=sent))
    assert found == "it sends force = 5.1, outside [limits] force = [-5, 5] N"
    (found,) = outside_limits(w.task, replace(policy, feedforward=0 * sent, past=np.array([-6.0])))
    assert found == "it holds force at -6, outside [limits] force = [-5, 5] N"
    assert not list(outside_limits(w.task, replace(policy, feedforward=0 * sent)))


def test_runs_of_another_task_are_told_once_as_data(ran):
    """`status` and the page counted 6 trials beside a diagnosis of 9, and said nothing of three."""
    assert not [note for note in ran.status().notes if "only as data" in note]
    names = [trial.id for trial in ran.task_trials()]
    configure(ran, CONFIG.replace(LIMITS, NARROW))
    (note,) = [note for note in ran.status().notes if "only as data" in note]
    assert names[0] in note and names[-1] in note


def test_feedback_that_oscillated_is_told_when_it_is_handed_over_again(ran):
    """An arm's candidate was run again without a word that it had oscillated."""
    assert not any("oscillate" in one for one in ran.export("c0001", ran.folder / "a.json").notes)
    trial, *_ = read_trial(ran.run("c0001").trial_file)
    made = ran.candidate("c0001")[0]
    swing = 1.1 * np.ptp(made.predicted_inputs) * np.sign(np.sin(0.9 * np.arange(trial.steps)))
    inputs = np.clip(made.predicted_inputs + swing[:, None], -5.0, 5.0)
    write_trial(ran.folder / "swung.mcap", replace(trial, inputs=inputs), {"kind": "trial"})
    taken = ran.ingest(ran.folder / "swung.mcap", candidate="c0001")
    (warned,) = [one for one in taken.warnings if "oscillate" in one]
    assert holds(warned, "force", "swings of more than", " N", "but not in t0001")
    (told,) = [n for n in ran.export("c0001", ran.folder / "b.json").notes if "oscillate" in n]
    assert holds(told, "c0001", "be ready to stop")


def test_what_a_discarded_run_made_void_is_told_once(ran):
    """Each of three notes came with every `next`."""
    ran.ingest(ran.run(ran.propose().candidate.id).trial_file)
    third = ran.propose().candidate.id
    ran.discard("t0002")
    first = ran.propose().proposal.notes
    assert any(third in one and "void" in one for one in first)
    assert not any("void" in one for one in ran.propose().proposal.notes)
