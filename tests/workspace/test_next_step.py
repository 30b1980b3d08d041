"""The last line of an output is the command to type next, the same one wherever it is asked."""

import math
import re
import shlex
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace as NS

import click
import pytest

from cli import grounded, plain, process
from facts import holds
from grounded.diagnosis.error_report import RulerRow
from grounded.diagnosis.report import Diagnosis, Made
from grounded.diagnosis.verdict import MOST_EFFECTS
from grounded.effects import Library
from grounded.errors import GroundedError, NextCommand
from grounded.result import measured_alike
from grounded.search import standing as standing_of_a_search
from grounded.search.candidate import Candidate
from grounded_cli.main import COMMANDS, cli
from grounded_cli.propose import _came_true, _so_far
from grounded_trials import Workspace
from grounded_trials.report.gathering import gather
from grounded_trials.store.documents import write_document
from grounded_trials.wording import ELSEWHERE, folded, placed, rendered
from grounded_trials.workspace import fitting
from grounded_trials.workspace.adoptable import diagnosed_again
from grounded_trials.workspace.candidates.search_state import standing_in
from grounded_trials.workspace.diagnosing import _deeper, _in_vain
from grounded_trials.workspace.fitting import apply_fit
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.last_diagnosis import diagnosable, read_diagnosis, since_diagnosis
from grounded_trials.workspace.next_step import (
    DIAGNOSE,
    EXPORT,
    after_diagnosis,
    nothing_to_do,
    outlook,
    to_adopt,
    to_look_deeper,
)
from grounded_trials.workspace.user_files.config import set_in_model
from recorded import LOGGED, record
from reported import DIAGNOSIS, cart, copied
from workspaces import CONFIG, make

__all__ = ["cart"]


def last(done):
    """The command of the `next:` line, a continued one in one piece."""
    assert done.code == 0, done.err
    text = plain(done.out).rstrip().splitlines()[-1]
    assert text.startswith("next: ")
    return text.removeprefix("next: ")


def diagnosed(folder: Path, **changes):
    document = {**DIAGNOSIS, **changes}
    write_document(folder / "reports" / "diagnosis.json", document)


def two_claimed(folder: Path) -> list[str]:
    """A diagnosis that claims two effects; their names."""
    names = ["viscous_friction:v", "delay:force"]
    late = DIAGNOSIS["ranking"][1] | {"params": {"d": {"value": 0.02, "std": 0.01, "unit": "s"}}}
    verdict = {"kind": "several", "effects": names, "sentence": "Two."}
    diagnosed(folder, verdict=verdict, ranking=[DIAGNOSIS["ranking"][0], late])
    return names


@pytest.mark.parametrize("command", ["status", "report", "learn", "propose"])
def test_every_command_says_the_same_once_the_search_has_ended(cart, command):
    assert last(grounded("-C", cart, command)) == "grounded adopt viscous_friction:v"


def test_the_result_of_a_search_is_that_of_its_model_if_another_is_to_be_adopted():
    """ "c0007 is the result" stood above the command that adopts effects and goes on."""
    done = NS(phase="converged", sentence="no step gains: c0007 is the result")
    lost, waiting = (NS(phase=p, sentence="c0007") for p in ("stopped", "await-trial"))
    adopt = NextCommand("adopt", ("delay:u",))
    assert holds(outlook(done, adopt), done.sentence, "as it is", "adopt")
    assert holds(outlook(lost, adopt), "adopt") and "as it is" not in outlook(lost, adopt)
    assert outlook(done, NextCommand("export")) == done.sentence
    assert outlook(waiting, adopt) == waiting.sentence


def test_all_claimed_effects_are_adopted_at_once(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    names = two_claimed(folder)
    command = last(grounded("-C", folder, "status"))
    assert command == "grounded adopt viscous_friction:v delay:force"
    done = grounded("-C", folder, *shlex.split(command)[1:], "--json").json
    assert [effect["name"] for effect in done["effects"]] == names[::-1]  # commands first
    assert done["params"] == {"mass": 1.4}
    assert last(grounded("-C", folder, "status")) == "grounded diagnose"  # with the model as it is


def test_an_effect_that_was_fitted_in_place_of_what_is_adopted_now_is_named(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    late = {"effect": "delay:force", "params": {"d": {"value": 0.02, "std": 0.01, "unit": "s"}}}
    diagnosed(folder, ranking=[DIAGNOSIS["ranking"][0], DIAGNOSIS["ranking"][1] | late])
    first = grounded("-C", folder, "adopt", "delay:force", "--json").json
    assert first["beside"] == [] and not first["claimed"]
    done = grounded("-C", folder, "adopt", "viscous_friction:v")
    assert "delay:force" in done.err and "warning" in done.err


def test_what_is_adopted_is_not_called_unknown(cart, tmp_path):
    """It named another effect ("did you mean"), as a newer diagnosis no longer lists it."""
    folder = copied(cart, tmp_path / "w")
    grounded("-C", folder, "adopt", "viscous_friction:v")
    diagnosed(folder, ranking=DIAGNOSIS["ranking"][1:])
    done = grounded("-C", folder, "adopt", "viscous_friction:v")
    assert done.code == 1 and "adopted already" in done.err


def test_nothing_is_adopted_where_one_name_is_wrong(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    before = (folder / "grounded.toml").read_text()
    done = grounded("-C", folder, "adopt", "viscous_friction:v", "delay:forse")
    assert done.code == 1 and "'delay:force'" in done.err
    assert (folder / "grounded.toml").read_text() == before


def test_what_is_listed_as_alike_was_not_fitted_and_another_diagnosis_fits_it(cart, tmp_path):
    """It was "not among the effects of the last diagnosis", which names it."""
    folder = copied(cart, tmp_path / "w")
    like = {"effect": "viscous_friction:v", "like": "input_gain:force", "share": 0.954}
    diagnosed(folder, lookalikes=[like])
    with pytest.raises(GroundedError) as refused:
        Workspace(folder).adopt("input_gain:force")
    assert holds(str(refused.value), "95.4 %", "viscous_friction:v", "not fitted")
    assert refused.value.then == NextCommand("diagnose", ("--without", "viscous_friction"))
    diagnosed(folder, lookalikes=[like | {"like": "viscous_friction:x"}])
    with pytest.raises(GroundedError) as refused:
        Workspace(folder).adopt("viscous_friction:x")
    assert refused.value.then == NextCommand("adopt", ("viscous_friction:v",))


def test_numbers_that_are_wrong_are_fitted(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    verdict = {"kind": "effect", "effects": ["parameter:mass"], "sentence": "One."}
    diagnosed(folder, verdict=verdict)
    assert last(grounded("-C", folder, "status")) == "grounded fit"


def test_numbers_found_beside_adopted_effects_are_adopted(cart, tmp_path):
    """`fit` ran away to tau = 3.7 s where the diagnosis had the values, with effects of its own."""
    folder = copied(cart, tmp_path / "w")
    drag = {"name": "quadratic_drag:v", "k": 0.01}
    set_in_model(folder / "grounded.toml", params={}, effects=[drag])
    row = DIAGNOSIS["ranking"][0] | {
        "effect": "parameter:mass",
        "params": {"d": {"value": 0.4, "std": 0.01, "unit": "kg"}},
    }
    verdict = {"kind": "effect", "effects": ["parameter:mass"], "sentence": "One."}
    made = {"trials": [], "adopted": [drag], "params": {}, "nominal": {"mass": 1.0}}
    ruler = {"horizon_s": 1.0, "unit_by_channel": {"x": "m"}, "crude": {"x": 0.3}}
    rows = [ruler | {"with_effects": {"x": 0.1}}]
    diagnosed(folder, verdict=verdict, ranking=[row], diagnosed=made, prediction_error=rows)
    assert last(grounded("-C", folder, "status")) == "grounded adopt parameter:mass"


@pytest.mark.parametrize(("part", "then"), [(0.9, "adopt viscous_friction:v"), (1.0, "diagnose")])
def test_what_is_calibrated_to_its_bound_is_not_to_be_adopted(cart, tmp_path, part, then):
    folder = copied(cart, tmp_path / "w")
    high = Workspace(folder).base_model.params["mass"].high
    mass = {"value": part * high, "std": 0.02, "interval": [part * high] * 2, "unit": "kg"}
    verdict = {**DIAGNOSIS["verdict"], "parameters": ["mass"]}
    diagnosed(folder, verdict=verdict, parameters={"mass": mass})
    assert last(grounded("-C", folder, "status")) == f"grounded {then}"


@pytest.mark.parametrize(
    ("gain", "then"),
    [(-0.1, "adopt input_gain:force"), (-1.9, "diagnose"), (-1.63, "adopt input_gain:force")],
)
def test_a_command_of_the_wrong_sign_is_not_adopted_as_a_gain(cart, tmp_path, gain, then):
    """The verdict said to flip its sign in model.py, `next:` to adopt a gain of -1.89.

    Of another strength it says nothing of flipping: `next: diagnose` told the same again and again.
    """
    folder = copied(cart, tmp_path / "w")
    row = DIAGNOSIS["ranking"][0] | {
        "effect": "input_gain:force",
        "params": {"g": {"value": gain, "std": 0.01, "unit": "1"}},
    }
    verdict = {"kind": "effect", "effects": ["input_gain:force"], "sentence": "One."}
    diagnosed(folder, verdict=verdict, ranking=[row])
    assert last(grounded("-C", folder, "status")) == f"grounded {then}"


def test_adopting_says_of_what_its_std_stopped_what_to_widen(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    mass = {"value": 1.3, "std": 0.02, "interval": [1.26, 1.34], "unit": "kg", "stopped": "prior"}
    diagnosed(folder, parameters={"mass": mass})
    done = grounded("-C", folder, "adopt", "viscous_friction:v")
    assert holds(" ".join(done.err.split()), "mass moved as far as its std", "widen its std")
    assert grounded("-C", folder, "adopt", "--undo").code == 0
    diagnosed(folder, parameters={"mass": {**mass, "stopped": ""}})
    assert "std" not in grounded("-C", folder, "adopt", "viscous_friction:v").err


def test_a_diagnosis_of_another_model_is_made_again(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    diagnosed(folder, diagnosed={"trials": [], "adopted": [], "params": {"mass": 9.0}})
    assert last(grounded("-C", folder, "status")) == "grounded diagnose"


def test_a_stale_diagnosis_tells_to_do_what_next_does(tmp_path):
    """`status` said "run `grounded diagnose` again", and below it `next: grounded propose`."""
    folder = make(tmp_path / "w").folder
    grounded("-C", folder, "learn", "--trials", "2")
    (folder / "reports").mkdir(exist_ok=True)
    diagnosed(folder, diagnosed=taken_in(folder, 1))
    found = grounded("-C", folder, "status")
    assert last(found) == "grounded propose"
    assert "diagnosed with 1 of 2 trials" in found.out and "diagnose`" not in found.out


def test_nothing_claimed_nothing_to_adopt(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    diagnosed(folder, verdict={"kind": "none", "effects": [], "sentence": "None."})
    assert last(grounded("-C", folder, "status")) == "grounded export best --runner"


def test_gains_in_the_place_of_a_load_are_not_offered(cart, tmp_path, monkeypatch):
    """The verdict said to give the model a parameter first, `next:` to adopt: -526 to -22,904."""
    folder = copied(cart, tmp_path / "w")
    names = two_claimed(folder)
    asked = []
    monkeypatch.setattr(
        "grounded.effects.joint.like_a_load", lambda model, given: asked.append(given) or True
    )
    assert last(grounded("-C", folder, "status")) == "grounded export best --runner"
    assert asked and set(asked[0]) == set(names)


LAGGING = {"signal": "v", "finding": "", "kind": "lag", "delay_s": 0.03, "corrected": True}


def test_a_filter_of_a_sensor_is_adopted_with_the_physics(cart, tmp_path):
    """A cart-pole's swing-up crashed on the plan of a model that had fresh speeds: -2.7 with it."""
    folder = copied(cart, tmp_path / "w")
    diagnosed(folder, preflight=[LAGGING])
    command = last(grounded("-C", folder, "status"))
    assert command == "grounded adopt viscous_friction:v sensor_lag:v"
    done = grounded("-C", folder, *shlex.split(command)[1:], "--json").json
    assert done["effects"][-1] == {"name": "sensor_lag:v", "tau": 0.03}
    assert done["params"] == {"mass": 1.4}
    assert "v_true" in " ".join(Folder(folder).planner.plan.model.state_names)
    assert last(grounded("-C", folder, "status")) == "grounded diagnose"


def test_a_filter_of_a_sensor_comes_along_where_only_the_physics_is_named(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    diagnosed(folder, preflight=[LAGGING])
    done = grounded("-C", folder, "adopt", "viscous_friction:v", "--json").json
    assert done["effects"][-1] == {"name": "sensor_lag:v", "tau": 0.03}
    assert done["along"] == ["sensor_lag:v"]


@pytest.mark.parametrize("finding", ["LAGGING", "DELAYED"])
def test_what_comes_along_without_being_named_is_told(cart, tmp_path, finding):
    """A delay of a sensor was written silently; its diagnosis had offered `delay_s` as well."""
    folder = copied(cart, tmp_path / "w")
    diagnosed(folder, preflight=[globals()[finding]])
    done = grounded("-C", folder, "adopt", "viscous_friction:v")
    told = " ".join(done.err.split())
    assert "sensor_" in told and "v came along: the sensors show it" in told
    assert ("adopt --undo" in told) == ("set the delay_s" in told) == (finding == "DELAYED")
    folder = copied(cart, tmp_path / "named")
    diagnosed(folder, preflight=[globals()[finding]])
    late = "sensor_lag:v" if finding == "LAGGING" else "sensor_delay:v"
    named = grounded("-C", folder, "adopt", "viscous_friction:v", late)
    assert "came along" not in named.err and late in named.out


def test_a_filter_is_adopted_alone_where_nothing_else_was_found(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    nothing = {"kind": "none", "effects": [], "sentence": "None."}
    diagnosed(folder, verdict=nothing, preflight=[LAGGING])
    assert last(grounded("-C", folder, "status")) == "grounded adopt sensor_lag:v"
    done = grounded("-C", folder, "adopt", "sensor_lag:v", "--json").json
    assert done["claimed"] and done["params"] == {}  # what was calibrated is another question
    assert grounded("-C", folder, "adopt", "--undo").code == 0
    assert last(grounded("-C", folder, "status")) == "grounded export best --runner"


DELAYED = LAGGING | {"kind": "delay", "log": "delay_s = 0.05"}  # on top of 0.02 s in [log]
LOG = """
[log.state]
x = {{ path = "/csv.x" }}
v = {{ path = "/csv.v", delay_s = {0} }}

[log.input]
force = {{ path = "/csv.force" }}
"""


@pytest.mark.parametrize("finding", [DELAYED, DELAYED | {"log": ""}])
def test_a_delay_of_a_sensor_is_adopted_with_the_physics(cart, tmp_path, finding):
    """A balancer went from limit to limit: the plan had fresh speeds, its program had not."""
    folder = copied(cart, tmp_path / "w")
    diagnosed(folder, preflight=[finding])
    command = last(grounded("-C", folder, "status"))
    assert command == "grounded adopt viscous_friction:v sensor_delay:v"
    done = grounded("-C", folder, *shlex.split(command)[1:], "--json").json
    assert done["effects"][-1] == {"name": "sensor_delay:v", "d": 0.03} and not done["beside"]
    assert "v_true" in " ".join(Folder(folder).planner.plan.model.state_names)
    assert last(grounded("-C", folder, "status")) == "grounded diagnose"


@pytest.mark.parametrize(("now", "counted"), [(0.02, False), (0.05, True)])
def test_a_delay_that_log_takes_out_by_now_does_not_act_twice(cart, tmp_path, now, counted):
    folder = copied(cart, tmp_path / "w")
    diagnosed(folder, preflight=[DELAYED])
    toml = folder / "grounded.toml"
    toml.write_text(toml.read_text() + LOG.format(now))
    offered = last(grounded("-C", folder, "status"))
    assert offered.endswith("viscous_friction:v" if counted else "sensor_delay:v")
    before = toml.read_text()
    done = grounded("-C", folder, "adopt", "viscous_friction:v", "sensor_delay:v")
    assert done.code == (1 if counted else 0)
    if counted:
        assert toml.read_text() == before
        assert holds(" ".join(done.err.split()), "[log.state.v] delay_s = 0.05", "Either remove")


@pytest.mark.parametrize(
    "finding",
    [
        LAGGING | {"delay_s": 1e-4},  # of a step of 50 ms
        LAGGING | {"corrected": False},
        LAGGING | {"log": "delay_s = 0.03"},
        DELAYED | {"delay_s": 1e-4},
        DELAYED | {"corrected": False},
    ],
)
def test_a_filter_that_makes_no_difference_or_is_mended_elsewhere_is_not_adopted(
    cart, tmp_path, finding
):
    folder = copied(cart, tmp_path / "w")
    diagnosed(folder, preflight=[finding])
    assert last(grounded("-C", folder, "status")) == "grounded adopt viscous_friction:v"


def test_a_damaged_diagnosis_is_made_again(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    (folder / "reports" / "diagnosis.json").write_text("[")
    assert last(grounded("-C", folder, "status")) == "grounded diagnose"


def test_a_new_workspace_begins_with_propose(tmp_path):
    folder = make(tmp_path / "w").folder
    assert last(grounded("-C", folder, "status")) == "grounded propose"


def test_what_logs_have_shown_is_adopted_before_the_first_candidate(cart, tmp_path):
    folder = make(tmp_path / "w").folder
    (folder / "reports").mkdir()
    diagnosed(folder)
    assert last(grounded("-C", folder, "status")) == "grounded adopt viscous_friction:v"
    assert grounded("-C", folder, "adopt", "viscous_friction:v").code == 0
    assert last(grounded("-C", folder, "status")) == "grounded propose"


def test_a_manoeuvre_is_drawn_before_the_first_plan(tmp_path):
    """After `adopt` came a plan to stand still: target.csv was still zeros, as `init` wrote it."""
    folder = make(tmp_path / "w").folder
    zeros = "t,x\n" + "".join(f"{0.05 * k:.10g},0\n" for k in range(41))
    (folder / "target.csv").write_text(zeros)
    assert last(grounded("-C", folder, "status")) == "grounded target SHAPE"
    (folder / "reports").mkdir()
    diagnosed(folder)
    done = grounded("-C", folder, "adopt", "viscous_friction:v")
    assert last(done) == last(grounded("-C", folder, "status")) == "grounded target SHAPE"
    done = grounded("-C", folder, "adopt", "--undo")
    assert last(done) == "grounded target SHAPE"
    diagnosed(folder, verdict={"kind": "none", "effects": [], "sentence": "None."}, ranking=[])
    none = read_diagnosis(folder / "reports")
    assert after_diagnosis(Folder(folder), none).verb == "target"
    config = (folder / "grounded.toml").read_text()
    start = config.replace("[task]", "[task]\nstart = { x = 0.3 }")
    (folder / "grounded.toml").write_text(start)  # then zeros ask for something
    assert last(grounded("-C", folder, "status")) == "grounded propose"
    (folder / "grounded.toml").write_text(config)
    assert grounded("-C", folder, "target", "line", "--to", "x=1").code == 0
    assert last(grounded("-C", folder, "status")) == "grounded propose"


def test_what_a_fresh_diagnosis_claims_is_adopted_while_a_candidate_waits(tmp_path):
    """`diagnose` said adopt; status, page and report said run, and never spoke of adopting."""
    folder = make(tmp_path / "w").folder
    assert grounded("-C", folder, "learn", "--trials", 2).code == 0
    assert grounded("-C", folder, "propose").code == 0
    assert last(grounded("-C", folder, "status")) == "grounded run"
    (folder / "reports").mkdir(exist_ok=True)
    diagnosed(folder, diagnosed={"trials": ["t0001", "t0002"], "adopted": [], "params": {}})
    for command in ("status", "report"):
        assert last(grounded("-C", folder, command)) == "grounded adopt viscous_friction:v"
    found = gather(Folder(folder))
    assert found.standing.phase == "await-trial"
    assert rendered(found.then) == "grounded adopt viscous_friction:v"
    assert found.next_command == rendered(found.then, str(folder))
    assert grounded("-C", folder, "learn", "--trials", 1).code == 0  # a later trial outdates it
    assert "adopt" not in last(grounded("-C", folder, "status"))


def test_a_plan_without_what_was_diagnosed_says_so(tmp_path):
    """An arm's search promised 0.014 mrad with a model known to lack 60 ms of delay."""
    folder = make(tmp_path / "w").folder
    assert grounded("-C", folder, "learn", "--trials", 1).code == 0
    (folder / "reports").mkdir(exist_ok=True)
    found = {"trials": ["t0001"], "adopted": [], "params": {}}
    diagnosed(folder, diagnosed=found)
    assert grounded("-C", folder, "learn", "--trials", 1).code == 0  # newer trials change nothing
    done = grounded("-C", folder, "propose")
    words = " ".join(plain(done.err + done.out).split())
    assert "the last diagnosis found that" in words and "not adopted: `grounded" in words
    assert "adopt viscous_friction:v` first" in words
    assert "this model lacks what the last diagnosis found" in words
    assert grounded("-C", folder, "adopt", "viscous_friction:v").code == 0
    done = grounded("-C", folder, "propose")
    assert "last diagnosis" not in plain(done.err + done.out)


def test_after_a_crash_what_was_diagnosed_is_adopted_before_a_gentler_policy_runs(tmp_path):
    """A quadrotor's crude policy fell, and its feedback was made gentler: it fell again."""
    folder = make(tmp_path / "w", config=LOGGED).folder
    (folder / "reports").mkdir(exist_ok=True)
    diagnosed(folder, diagnosed={"trials": [], "adopted": [], "params": {}})
    w = Workspace(folder)
    log = record(w, tmp_path / "fell.csv", w.propose().candidate.policy, 0.0, until=1.0)
    done = grounded("-C", folder, "ingest", log)
    assert "crashed" in done.out and last(done) == "grounded adopt viscous_friction:v"
    assert last(grounded("-C", folder, "status")) == "grounded adopt viscous_friction:v"


def test_a_long_command_is_broken_where_a_shell_allows_it():
    names = [f"first_order_lag:input_number_{k}" for k in range(6)]
    command = " ".join(["grounded adopt", *names])
    text = folded(command)
    assert max(map(len, text.splitlines())) <= 80
    assert shlex.split(text.removeprefix("next: ").replace("\\\n", " ")) == command.split()
    assert folded("grounded run") == "next: grounded run"
    quoted = folded("grounded -C 'my own folder' " + command.removeprefix("grounded "))
    assert shlex.split(quoted.replace("\\\n", " "))[3] == "my own folder"


def told(done):
    """The words of the next step that a command printed."""
    return shlex.split(done.out.rstrip().replace("\\\n", " ").splitlines()[-1])


@pytest.mark.slow
def test_printed_commands_work_from_where_the_user_is(tmp_path):
    make(tmp_path / "my cart")
    for at in (("-C", "my cart", "propose"), ("propose", "-C", "my cart")):
        done = process(*at, cwd=tmp_path)
        assert done.out.endswith("\nnext: grounded -C 'my cart' run\n"), done.out
    for expected in ("ingest", "propose"):
        done = process(*told(done)[2:], cwd=tmp_path)
        assert done.code == 0, done.err
        assert told(done)[:5] == ["next:", "grounded", "-C", "my cart", expected]
    assert process("propose", cwd=tmp_path / "my cart").out.endswith("next: grounded run\n")


def test_commands_inside_sentences_work_from_where_the_user_is(cart, tmp_path, monkeypatch):
    """`next:` had the -C, `run grounded diagnose --probe` above it hadn't."""
    folder = copied(cart, tmp_path / "my cart")
    config = folder / "grounded.toml"
    config.write_text(re.sub("(?m)^target = .*$", "", config.read_text()))
    done = grounded("-C", folder, "propose")
    assert done.code == 1 and f"`grounded -C '{folder}' target`" in done.err
    monkeypatch.chdir(folder)
    assert "`grounded target`" in grounded("propose").err
    kept = "`grounded -C x run`", "`grounded init DIR`", "`grounded it's`", "grounded run"
    assert placed(" ".join(kept), "my cart") == " ".join(kept)
    there = placed("a `grounded ingest LOG --data`.", "my cart")
    assert there == "a `grounded -C 'my cart' ingest LOG --data`."
    assert placed("a `grounded run`", None) == "a `grounded run`"


def test_an_error_names_the_workspace_too_and_init_does_not(tmp_path):
    make(tmp_path / "cart")
    done = process("-C", "cart", "adopt", "delay:force", cwd=tmp_path)
    assert done.err.endswith("next: grounded -C cart diagnose\n")
    done = process("-C", "cart", "init", "new", "--example", "pendulum", cwd=tmp_path)
    assert done.out.endswith("cd new && grounded propose\n")


def test_the_commands_that_take_a_folder_are_those_that_are_printed_with_it():
    found = []
    with click.Context(cli) as ctx:
        for name in COMMANDS:
            command = cli.get_command(ctx, name)
            if any("-C" in option.opts for option in command.params):
                found.append(name)
    assert set(found) == set(COMMANDS) - ELSEWHERE


# after a diagnosis


def taken_in(folder, *numbers):
    """Ids of the trials that a diagnosis is said to be made from."""
    return {"trials": [f"t{k:04d}" for k in numbers], "adopted": [], "params": {}}


def test_trials_that_came_after_a_diagnosis_make_it_old(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    count = len(list(folder.glob("trials/*.mcap")))
    diagnosed(folder, diagnosed=taken_in(folder, *range(1, count + 1)))
    assert last(grounded("-C", folder, "status")) == "grounded adopt viscous_friction:v"
    assert "diagnosed with" not in grounded("-C", folder, "report").out
    diagnosed(folder, diagnosed=taken_in(folder, 1, 2))
    words = f"diagnosed with 2 of {count} trials"
    for command in ("status", "report"):
        done = grounded("-C", folder, command)
        assert words in " ".join(plain(done.out).split()).replace("Diagnosed", "diagnosed")
        assert last(done) == "grounded diagnose" and "diagnose`" not in done.out
    page = Path(grounded("-C", folder, "report", "--html", "--json").json["paths"]["html"])
    assert f"Diagnosed with 2 of {count} trials" in page.read_text()


def test_what_was_adopted_is_not_missing_any_more(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    names = ["viscous_friction:v", "delay:force"]
    verdict = {"kind": "several", "effects": names, "sentence": "Friction; late."}
    diagnosed(folder, verdict=verdict, diagnosed=taken_in(folder, 1, 2, 3, 4))
    assert grounded("-C", folder, "adopt", "viscous_friction:v").code == 0
    out = " ".join(plain(grounded("-C", folder, "report").out).split())
    assert re.search("viscous_friction:v, .*delay:force.*next: grounded .*diagnose", out)
    assert "made from 4 trials, t0001 to t0004, said: Friction; late." in out
    assert "crude model" not in out and "adopted effects" in out
    page = Path(grounded("-C", folder, "report", "--html", "--json").json["paths"]["html"])
    text = page.read_text()
    assert "said:" in text and "viscous_friction:v (adopted since)" in text
    assert "crude model" not in text
    assert "adopted since" in " ".join(grounded("-C", folder, "status").out.split())


def test_nothing_is_said_of_what_one_trial_can_not_know(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    why = "one trial alone confirms nothing; run a second one"
    verdict = {"kind": "unknown", "effects": [], "sentence": f"No cause is named: {why}."}
    diagnosed(folder, verdict=verdict, unknowable=[why])
    done = grounded("-C", folder, "report")
    assert why in done.out and last(done) == "grounded run best"
    for words in ("after", "is explained", "delay:force"):
        assert words not in done.out[done.out.index("gap to the model") :], words
    page = Path(grounded("-C", folder, "report", "--html", "--json").json["paths"]["html"])
    assert "squared error" not in page.read_text()
    assert last(grounded("-C", folder, "status")) == "grounded run best"


@pytest.mark.slow
def test_diagnose_of_one_trial_asks_for_another(tmp_path):
    folder = make(tmp_path / "w").folder
    assert grounded("-C", folder, "learn", "--trials", 1).code == 0
    done = grounded("-C", folder, "diagnose")
    assert last(done) == "grounded propose"
    assert "before, " not in done.out and "is explained" not in done.out


# adopt


def test_rivals_are_not_adopted_together(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    before = (folder / "grounded.toml").read_text()
    done = grounded("-C", folder, "adopt", "viscous_friction:v", "delay:force")
    assert done.code == 1 and holds(done.err, "delay:force", "(viscous_friction:v)")
    assert plain(done.err).endswith("\nnext: grounded adopt viscous_friction:v\n")
    assert (folder / "grounded.toml").read_text() == before


def test_one_unclaimed_effect_comes_without_the_parameters_of_others(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    entry = DIAGNOSIS["ranking"][1] | {"params": {"d": {"value": 0.02, "std": 0.01, "unit": "s"}}}
    diagnosed(folder, ranking=[DIAGNOSIS["ranking"][0], entry])
    done = grounded("-C", folder, "adopt", "delay:force")
    assert done.code == 0 and holds(done.err, "delay:force", "claimed")
    assert "mass" not in done.out and "params" not in (folder / "grounded.toml").read_text()


def test_adopt_prints_every_parameter_that_it_writes(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    same = {"value": 0.2, "std": 0.02, "unit": "N s/m"}
    diagnosed(folder, parameters=DIAGNOSIS["parameters"] | {"drag": same})
    out = grounded("-C", folder, "adopt", "viscous_friction:v").out
    assert "mass       1.000 -> 1.400 kg" in out and "drag       0.2000 N s/m, as before" in out
    assert "[model] params" in " ".join(grounded("adopt", "-h").out.split())


def test_nothing_is_adopted_where_too_little_is_known(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    why = "one trial alone confirms nothing; run a second one"
    verdict = {"kind": "unknown", "effects": [], "sentence": f"No cause is named: {why}."}
    diagnosed(folder, verdict=verdict, unknowable=[why])
    done = grounded("-C", folder, "adopt", "viscous_friction:v")
    assert done.code == 1 and why in " ".join(done.err.split())


def test_a_candidate_that_another_replaces_is_said_to_be_void(tmp_path):
    folder = make(tmp_path / "w").folder
    assert grounded("-C", folder, "learn", "--trials", 1).code == 0
    assert "void" not in grounded("-C", folder, "propose").err
    (folder / "reports").mkdir(exist_ok=True)
    diagnosed(folder)
    assert grounded("-C", folder, "adopt", "viscous_friction:v").code == 0
    done = grounded("-C", folder, "propose")
    assert holds(done.err, "c0002", "void") and "c0003" in done.out
    assert "void" not in grounded("-C", folder, "propose").err  # it is said once


def test_a_candidate_is_void_though_a_probe_was_made_since(tmp_path):
    w = Workspace(make(tmp_path / "w").folder)
    w.learn(1)
    second = w.propose().candidate
    assert w.save_candidate(replace(second, id=w.next_id()), kind="probe").id == "c0003"
    w.forget()
    (w.folder / "reports").mkdir(exist_ok=True)
    diagnosed(w.folder)
    assert grounded("-C", w.folder, "adopt", "viscous_friction:v").code == 0
    done = grounded("-C", w.folder, "propose")
    assert holds(done.err, "c0002", "void") and "c0004" in done.out
    # no run has tested the changed model: what the older one foretold is no reason for trust
    (trust,) = re.findall(r"^  trust +(.*(?:\n {10,}.*)*)", done.out, re.M)
    assert "prediction" not in trust and holds(trust, "unknown", "changed")
    assert "last prediction" in grounded("-C", again(w, tmp_path), "propose").out


def again(w, tmp_path):
    """The workspace after the next trial."""
    assert grounded("-C", w.folder, "learn", "--trials", 1).code == 0
    return w.folder


def test_a_rerun_after_the_end_goes_on_as_status_does(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    diagnosed(folder, verdict={"kind": "none", "effects": [], "sentence": "None."})
    trial = grounded("-C", folder, "run", "best", "--json").json["trial_file"]
    done = grounded("-C", folder, "ingest", trial)
    assert last(done) == last(grounded("-C", folder, "status")) != "grounded propose"


def test_a_single_run_asks_for_another_by_its_command(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    out = " ".join(grounded("-C", folder, "status").out.split())
    assert f"(`grounded -C {folder} run best`)" in out
    config = folder / "grounded.toml"
    config.write_text(config.read_text().partition("[system]")[0])
    out = " ".join(plain(grounded("-C", folder, "status").out).split())
    best = Workspace(folder).status().standing.incumbent.candidate.id
    assert f"`grounded export {best} --runner`" in out  # another may be the best by then


def test_no_line_for_utilities_that_nothing_has(tmp_path):
    folder = make(tmp_path / "w").folder
    grounded("-C", folder, "propose")
    out = grounded("-C", folder, "status").out
    assert "no trial" in out or "waiting" in out
    assert not re.search(r"^utility *$", out, re.M)


def test_who_adopts_a_scale_is_told_whose_speed_the_target_means(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    params = {"k": {"value": 0.04, "std": 0.001, "unit": "1"}}
    row = {**DIAGNOSIS["ranking"][0], "effect": "sensor_scale:v", "params": params}
    verdict = {"kind": "effect", "effects": ["sensor_scale:v"], "sentence": "Scaled."}
    diagnosed(folder, verdict=verdict, ranking=[row], indistinguishable=[])
    done = grounded("-C", folder, "adopt", "sensor_scale:v")
    assert done.code == 0 and holds(done.err, "4 % more", "target", "[log.state.v] scale")


def test_a_delay_more_than_the_adopted_one_is_open_until_it_is_adopted(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    then = {"name": "delay:force", "d": 0.01}
    made = {"trials": [], "adopted": [then], "params": {}}
    verdict = {"kind": "effect", "effects": ["delay:force"], "sentence": "Later still."}
    found = Diagnosis.from_json(DIAGNOSIS | {"verdict": verdict, "diagnosed": made})
    assert found.open([then]) == ("delay:force",)
    assert found.open([then | {"d": 0.03}]) == ()
    workspace = Folder(folder)
    assert since_diagnosis(workspace, found, []).changed  # the cart has no effect at all
    set_in_model(workspace.config.file, effects=[then | {"d": 0.03}])
    since = since_diagnosis(Folder(folder), found, [])
    assert since.changed and since.adopted == ("delay:force",)
    set_in_model(workspace.config.file, effects=[then])
    assert since_diagnosis(Folder(folder), found, []).sentence == ""


def test_after_a_verdict_of_none_the_search_goes_on(tmp_path):
    w = Workspace(make(tmp_path / "w").folder)
    w.learn(2)
    nothing = {"kind": "none", "effects": [], "sentence": "Nothing."}
    found = Diagnosis.from_json({**DIAGNOSIS, "verdict": nothing, "next_trial": ""})
    made = replace(Made(), params=dict(w.config.model.params))
    assert after_diagnosis(w, replace(found, made=made)).verb == "propose"


def test_after_a_verdict_of_none_a_search_that_has_ended_is_exported(cart, tmp_path):
    w = Workspace(copied(cart, tmp_path / "w"))
    nothing = {"kind": "none", "effects": [], "sentence": "Nothing."}
    found = Diagnosis.from_json({**DIAGNOSIS, "verdict": nothing, "next_trial": ""})
    made = replace(Made(), params=dict(w.config.model.params))
    ended = w.status().standing.phase in ("converged", "stopped")
    assert ended and after_diagnosis(w, replace(found, made=made)).verb == "export"


def test_an_ended_search_asks_for_a_diagnosis_until_a_newer_one_is_made(
    cart, tmp_path, monkeypatch
):
    """`But a step that lost had promised ... more` stayed after a diagnosis that said `none`."""
    lost = ". But a step lost, and a diagnosis may show why"

    def let_down(ended, model):
        told = ended.sentence + lost
        return replace(ended, sentence=told, then=NextCommand("diagnose"), missed=lost)

    monkeypatch.setattr("grounded.search.improve.let_down", let_down)
    monkeypatch.setattr(standing_of_a_search, "let_down", let_down)
    folder = copied(cart, tmp_path / "w")
    w = Workspace(folder)
    (folder / "reports" / "diagnosis.json").unlink()
    now = w.status()
    assert now.standing.sentence.endswith(lost) and now.then == DIAGNOSE
    usable = [trial.id for trial in diagnosable(w)]
    nothing = {"kind": "none", "effects": [], "sentence": "Nothing."}
    for made, asks in ((usable[:-1], True), (usable, False)):
        params = dict(w.config.model.params)
        diagnosed(folder, verdict=nothing, diagnosed={"trials": made, "params": params})
        now = Workspace(folder).status()
        assert (lost in now.standing.sentence) == asks and (now.then == EXPORT) == (not asks)
        assert (lost in Workspace(folder).propose().proposal.standing.sentence) == asks
        assert ("a step lost" in " ".join(grounded("-C", folder, "report").out.split())) == asks


@pytest.mark.parametrize(("runs", "then"), [(1, "run best"), (2, "export best --runner")])
def test_what_was_diagnosed_and_adopted_is_not_diagnosed_again(
    cart, tmp_path, monkeypatch, runs, then
):
    """Diagnose, adopt, propose, and `nothing to run ... or diagnose the model. next: diagnose`."""
    folder = copied(cart, tmp_path / "w")
    w = Workspace(folder)
    now = w.status().standing
    asked = " or diagnose the model"
    assert now.incumbent is not None
    best = replace(now.incumbent, trials=now.incumbent.trials[:1] * runs)
    doubtful = replace(
        now,
        phase="stopped",
        sentence=f"no trial is spent on it{asked}",
        ending="too doubtful",
        incumbent=best,
        then=DIAGNOSE,
        missed=asked,
    )
    monkeypatch.setattr("grounded.search.standing.standing", lambda *_, **__: doubtful)
    count = len(list(folder.glob("trials/*.mcap")))
    for seen, newer in ((count - 1, True), (count, False)):
        diagnosed(folder, diagnosed=taken_in(folder, *range(1, seen + 1)))
        if newer:
            assert grounded("-C", folder, "adopt", "viscous_friction:v").code == 0
        done = grounded("-C", folder, "status")
        assert last(done) == ("grounded diagnose" if newer else f"grounded {then}")
        assert ("diagnose the model" in plain(done.out)) is newer
        again = "; run " in plain(done.out)  # as `next:`, not beside `export best`
        assert again == (not newer and runs == 1)


@pytest.mark.parametrize(("runs", "claimed", "then"), [(1, True, "adopt"), (2, False, "export")])
def test_no_run_is_asked_for_beside_another_next_command(
    cart, tmp_path, monkeypatch, runs, claimed, then
):
    """`run c0005 again`, and below it `next: grounded export best`."""
    folder = copied(cart, tmp_path / "w")
    now = Workspace(folder).status().standing
    assert now.incumbent is not None
    best = replace(now.incumbent, trials=now.incumbent.trials[:1] * runs)
    kept = {"ending": "too doubtful", "incumbent": best, "then": DIAGNOSE}
    asked = "; run it again or diagnose the model"
    ended = replace(now, phase="stopped", sentence=f"no trial{asked}", missed=asked, **kept)
    for module in ("standing", "improve"):
        monkeypatch.setattr(f"grounded.search.{module}.standing", lambda *_, **__: ended)
    seen = taken_in(folder, *range(1, len(list(folder.glob("trials/*.mcap"))) + 1))
    nothing = {} if claimed else {"verdict": {"kind": "none", "effects": [], "sentence": "None."}}
    diagnosed(folder, diagnosed=seen, **nothing)
    for command in ("status", "propose"):
        done = grounded("-C", folder, command)
        assert last(done).startswith(f"grounded {then}")
        _, found, phase = plain(done.out).partition("no trial")
        assert found and "again" not in phase and "diagnose" not in phase


def test_after_an_unknown_verdict_a_search_that_has_ended_says_so(cart, tmp_path, monkeypatch):
    """A car's diagnosis ended in a report, whose next command was the same diagnosis."""
    w = Workspace(copied(cart, tmp_path / "w"))
    unknown = {"kind": "unknown", "effects": [], "sentence": "A gap remains."}
    left = {"channel": "v", "error": 0.02, "floor": 0.01, "horizon_s": 1.0, "error_unit": "m/s"}
    document = {**DIAGNOSIS, "verdict": unknown, "leftover": [left], "indistinguishable": []}
    found = Diagnosis.from_json({**document, "next_trial": "Run another."})
    monkeypatch.setattr("grounded.diagnosis.diagnose.diagnose", lambda *_, **__: found)
    monkeypatch.setattr("grounded_trials.workspace.diagnosing._probe", lambda *_, **__: ("", ""))
    done, best = w.diagnose(), w.status().standing.incumbent
    assert done.then == EXPORT == w.status().then and best is not None
    assert best.candidate.id in done.next_trial and "run another." in done.next_trial
    assert done.next_trial.endswith("run another.")
    kept = read_diagnosis(w.reports)
    assert kept is not None and kept.next_trial == "Run another."  # of the search nothing is kept


def test_a_result_says_what_follows_it_without_the_command_line(cart, tmp_path):
    w = Workspace(copied(cart, tmp_path / "w"))
    run = w.run("best").trial_file
    assert w.ingest(run).then == w.status().then  # the search has ended: not `propose`
    assert w.ingest(run, data=True).then == DIAGNOSE
    few = Library(tuple(map(Library().family, ("viscous_friction", "input_gain"))))
    found = w.diagnose(max_effects=1, library=few)
    assert found.then is not None and found.then == w.status().then
    assert "then" not in found.to_json()


def test_trust_sets_the_promised_gain_against_the_last_misses(tmp_path):
    folder, said = make(tmp_path / "w", "car-turn").folder, []
    for _ in range(3):
        out = grounded("-C", folder, "propose").out
        said += re.findall(r"^  trust +(.*(?:\n {10,}.*)*)", out, re.M)
        grounded("-C", folder, "learn", "--trials", "1")
    ran = standing_in(Workspace(folder)).history
    missed = [abs(one.candidate.predicted_utility - one.utility) for one in ran]
    gain = ran[2].candidate.predicted_utility - ran[1].utility
    assert holds(said[1], f"{ran[0].utility:.4g}", "promises")
    assert holds(said[2], *measured_alike(missed[:2], ""), f"{gain:.4g}")
    assert ("less than such an error" in " ".join(said[2].split())) == (gain < missed[1])
    little = gain < missed[1] and gain < 0.1 * abs(ran[1].utility)
    assert holds(" ".join(said[2].split()), "else stop with c0002") == little
    assert "stop with" not in said[1]  # which promises all of the cost
    made, best, task = ran[2].candidate, ran[1], Workspace(folder).task
    assert made.base == best.candidate.id and "model" not in _so_far(made, best, task)
    poor = replace(made, predicted_gain=made.predicted_gain - 2)  # a trial worse than its policy
    assert holds(_so_far(poor, best, task), f"{poor.predicted_utility - poor.predicted_gain:.4g}")
    now = ran_standing(folder, best)
    assert f"{poor.predicted_gain:.4g}" in _came_true(poor, ran[:2], now)
    near = replace(made, predicted_gain=0.95 * gain)  # not told to be replayed otherwise
    assert f"a gain of {gain:.4g}" in _came_true(near, ran[:2], now)
    beyond = replace(made, predicted_gain=1 - best.utility)  # no utility is above 0
    assert f"a gain of {gain:.4g}" in _came_true(beyond, ran[:2], now)
    few = {"predicted_gain": 0.01 * -best.utility, "predicted_utility": 0.99 * best.utility}
    few = replace(made, id="c9", likely_off=0.0, **few)
    for miss, may in ((0.4, True), (0.6, False)):  # a model that is far off tells no end
        off = replace(ran[1].candidate, predicted_utility=(1 + miss) * ran[1].utility)
        assert ("stop with" in _came_true(few, [replace(ran[1], candidate=off)], now)) == may


def ran_standing(folder, best):
    return replace(standing_in(Workspace(folder)), incumbent=best, history=(best,))


def test_who_is_told_that_a_candidate_may_lose_is_told_where_to_stop(tmp_path, monkeypatch):
    folder = make(tmp_path / "w").folder
    grounded("-C", folder, "learn", "--trials", "1")
    monkeypatch.setattr(Candidate, "doubtful", property(lambda made: bool(made.base)))
    done = grounded("-C", folder, "propose")
    assert "c0002 may well lose" in " ".join(done.err.split()) and "stop with" not in done.err
    monkeypatch.setattr("grounded.search.candidate.LITTLE", 10.0)
    done = grounded("-C", folder, "propose")
    assert holds(
        " ".join(done.err.split()), "c0002 may well lose", "% of what c0001 costs", "`export best`"
    )
    assert "stop with" not in done.out and last(done) == "grounded run"


def test_an_adoption_in_vain_is_told_how_to_be_undone(tmp_path, monkeypatch):
    """Seen on a crane: three runs lost after a wrong cause was adopted, and nothing said so."""
    effect = '\neffects = [{name = "viscous_friction:v", k = 0.3}]\n\n[task]'
    w = make(tmp_path / "w", config=CONFIG.replace("\n\n[task]", effect))

    def said(kind, *accepted, model=w.planner.fingerprint, outset=None):
        found = Diagnosis.from_json(DIAGNOSIS | {"verdict": {"kind": kind, "effects": []}})
        row = RulerRow(1.0, crude={"x": 0.2, "v": 0.1}, outset=outset or {})
        found = replace(found, prediction_error=(row,))
        made = [(None, "other", True), *(("a", model, one) for one in accepted)]
        history = [NS(candidate=NS(id=i, model=m), accepted=one) for i, m, one in made]
        module = "grounded_trials.workspace.candidates.search_state.standing_in"
        monkeypatch.setattr(module, lambda _: NS(history=tuple(history)))
        return _in_vain(w, found)

    told = said("unknown", False, None, False)
    assert "last 2" in told and "viscous_friction:v" in told and "adopt --undo" in told
    assert said("none", False, False) == said("unknown", False) == ""
    assert said("unknown", False, False, True) == ""
    assert said("unknown", False, False, model="of yesterday") == ""
    before = {"x": 0.9, "v": 0.1}  # a boat, all of whose five causes were right
    assert said("unknown", False, False, outset=before) == ""
    assert "adopt --undo" in said("unknown", False, False, outset={"x": 0.1, "v": 0.1})


def test_what_was_claimed_can_be_adopted_before_a_deeper_diagnosis(cart, tmp_path):
    """After 10 min `next:` was another 10 min, and nothing said that the six could be adopted."""
    folder = copied(cart, tmp_path / "w")
    names = two_claimed(folder)
    verdict = {"kind": "several", "effects": names, "sentence": "Two.", "look_for": 5}
    diagnosed(folder, verdict=verdict)
    assert last(grounded("-C", folder, "status")) == f"grounded adopt {' '.join(names)}"
    made = {"trials": ["t0001", "t0002"], "params": {}, "without": ["delay"]}
    asked = {
        " --trials t0001,t0002": {"named": ["t0001", "t0002"]},
        " --compare t0001 t0002": {"named": ["t0001"], "compared": ["t0002"]},
    }
    for words, one in asked.items():
        found = Diagnosis.from_json({**DIAGNOSIS, "verdict": verdict, "diagnosed": made | one})
        typed = f"grounded diagnose{words} --without delay --max-effects 5"
        assert rendered(to_look_deeper(found)) == typed
        assert holds(_deeper(found, 400.0), f"`{typed}`", "took 6.7 min", "17 min or more")
    assert to_look_deeper(Diagnosis.from_json(DIAGNOSIS)) is None
    allowed, beyond = MOST_EFFECTS, MOST_EFFECTS + 1
    most, over = (grounded("diagnose", "--max-effects", str(k)).err for k in (allowed, beyond))
    assert "max-effects" in over and "max-effects" not in most


@pytest.mark.parametrize("left", [{"look_for": 5}, {"again": True}, {}])
def test_what_left_more_to_be_found_is_diagnosed_again_once_it_is_adopted(
    cart, tmp_path, monkeypatch, left
):
    """It said `adopt these effects and diagnose again`, and `next: export best`."""
    folder = copied(cart, tmp_path / "w")
    w = Workspace(folder)
    ended = replace(w.status().standing, phase="converged", ending="nothing promised")
    monkeypatch.setattr("grounded.search.standing.standing", lambda *_, **__: ended)
    count = len(list(folder.glob("trials/*.mcap")))
    claimed = {"kind": "effect", "effects": ["viscous_friction:v"], "sentence": "One."}
    seen = taken_in(folder, *range(1, count + 1))
    diagnosed(folder, diagnosed=seen, verdict=claimed | left)
    assert grounded("-C", folder, "adopt", "viscous_friction:v").code == 0
    then = "diagnose" if left else "export best --runner"
    assert last(grounded("-C", folder, "status")) == f"grounded {then}"


def test_an_adoption_is_undone_and_not_proposed_again_until_a_new_diagnosis(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    names = two_claimed(folder)
    before = (folder / "grounded.toml").read_text()
    w = Workspace(folder)
    w.adopt(*names[:1], parameters=False)
    one = (folder / "grounded.toml").read_text()
    w.adopt(names[1])
    done = grounded("-C", folder, "adopt", "--undo", "--json").json
    assert done["undone"] == [names[1]]
    assert [effect["name"] for effect in done["effects"]] == [names[0]]
    assert (folder / "grounded.toml").read_text() == one
    back = grounded("-C", folder, "adopt", "--undo")
    assert last(back) == "grounded propose"
    assert (folder / "grounded.toml").read_text() == before
    assert "adopt" not in last(grounded("-C", folder, "status"))
    assert Workspace(folder).report().to_json()["next"] != "adopt"
    nothing = grounded("-C", folder, "adopt", "--undo")
    assert nothing.code == 1 and "no adoption" in nothing.err
    diagnosed_again(Folder(folder))
    assert last(grounded("-C", folder, "status")).startswith("grounded adopt ")


def test_an_adoption_under_later_changes_is_not_undone(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    set_in_model(folder / "grounded.toml", effects=[{"name": "offset:v", "c": 0.5}])
    assert grounded("-C", folder, "adopt", "viscous_friction:v").code == 0
    set_in_model(folder / "grounded.toml", params={"mass": 3.25})
    changed = (folder / "grounded.toml").read_text()
    done = grounded("-C", folder, "adopt", "--undo")
    assert done.code == 1 and holds(
        done.err, "changed", "viscous_friction:v", 'effects = [{name = "offset:v", c = 0.5}]'
    )
    assert (folder / "grounded.toml").read_text() == changed
    assert grounded("-C", folder, "adopt").code == 2
    assert grounded("-C", folder, "adopt", "--undo", "viscous_friction:v").code == 2


def test_a_damaged_list_of_adoptions_is_found_before_anything_is_written(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    (folder / "reports" / "adoptions.json").write_text("[")
    before = (folder / "grounded.toml").read_text()
    done = grounded("-C", folder, "adopt", "viscous_friction:v")
    assert done.code == 1 and "adoptions.json" in done.err
    assert (folder / "grounded.toml").read_text() == before
    assert [Path(one.file).name for one in Workspace(folder).verify().damaged] == ["adoptions.json"]


def test_what_trials_differ_in_and_predictions_lose_with_is_not_adopted(cart, tmp_path):
    """A log with two columns exchanged bent a claim; `next:` was to adopt it."""
    folder, rows = copied(cart, tmp_path / "w"), list[dict[str, object]]()
    differs = {"effect": "viscous_friction:v", "quantity": "k", "agrees": False, "chance": 0.0}
    for after in (0.2, 0.5):
        row = {"horizon_s": 1.0, "unit_by_channel": {"v": "m/s"}, "crude": {"v": 0.3}}
        rows = [row | {"with_effects": {"v": after}}]
        diagnosed(folder, prediction_error=rows, agreement=[differs])
        adopts = last(grounded("-C", folder, "status")).startswith("grounded adopt")
        assert adopts == (after < 0.3)
    diagnosed(folder, prediction_error=rows)  # nor where trials agree, and "that is worse"
    assert "adopt" not in last(grounded("-C", folder, "status"))
    gains = {"unit_by_channel": {"v": "m/s", "x": "m"}, "crude": {"v": 0.3, "x": 4.0}}
    diagnosed(folder, prediction_error=[rows[0] | gains | {"with_effects": {"v": 0.5, "x": 0.1}}])
    assert last(grounded("-C", folder, "status")).startswith("grounded adopt")


def test_who_goes_on_after_steps_that_lost_is_told_of_a_diagnosis(tmp_path, monkeypatch):
    """Five runs of a car brought nothing, and `next` named a sixth."""
    folder = make(tmp_path / "w", CONFIG).folder
    Workspace(folder).learn(1)
    monkeypatch.setattr(standing_of_a_search, "_suspicion", lambda *given: "2 steps were lost")
    status = Workspace(folder).status()
    assert status.standing.doubt and status.then.verb == "propose"  # one run confirms nothing
    run = Workspace(folder).run(Workspace(folder).propose().candidate.id)
    assert Workspace(folder).ingest(run.trial_file).then.verb == "diagnose"
    assert Workspace(folder).status().then.verb == "diagnose"
    notes = Workspace(folder).propose().proposal.notes
    assert any(holds(note, "2 steps were lost", "grounded", "diagnose") for note in notes)
    for file in (folder / "candidates").glob("c0003*"):
        file.unlink()
    (folder / "reports").mkdir()
    diagnosed(folder, diagnosed={"trials": ["t0001", "t0002"]})
    assert Workspace(folder).status().then.verb == "adopt"
    notes = Workspace(folder).propose().proposal.notes
    assert not any("2 steps were lost" in note for note in notes), notes


def test_data_beside_a_search_leave_the_waiting_candidate_next(tmp_path, monkeypatch):
    """The log of a run that went wrong was kept as data: `diagnose`, with the boat on the water."""
    monkeypatch.chdir(tmp_path)
    w = Workspace(make(tmp_path / "w", config=LOGGED).folder)
    first = w.propose().candidate
    by_hand = record(w, tmp_path / "hand.csv", first.policy, 0.5)
    assert last(grounded("-C", w.folder, "ingest", "--data", by_hand)).endswith("diagnose")
    w.ingest(record(w, tmp_path / "c0001.csv", first.policy, 0.0, seed=1), candidate="c0001")
    waits = w.propose().candidate.id
    other = record(w, tmp_path / "wrong.csv", first.policy, 0.3)
    told = last(grounded("-C", w.folder, "ingest", "--data", other))
    assert waits == "c0002" and told.endswith("grounded run")


def test_a_log_that_is_read_otherwise_now_is_ingested_again_before_anything_is_adopted(
    tmp_path, monkeypatch
):
    """In metres at last, `status` still told to adopt what was diagnosed in millimetres."""
    monkeypatch.chdir(tmp_path)
    w = Workspace(make(tmp_path / "w", config=LOGGED).folder)
    log = record(w, tmp_path / "hand.csv", w.propose().candidate.policy, 0.0)
    next((w.folder / "candidates").iterdir()).unlink()
    assert last(grounded("-C", w.folder, "ingest", "--data", log)).endswith("diagnose")
    (w.folder / "reports").mkdir()
    diagnosed(w.folder, diagnosed={"trials": ["t0001"], "adopted": [], "params": {}})
    assert "adopt viscous_friction:v" in last(grounded("-C", w.folder, "status"))
    written = (w.folder / "grounded.toml").read_text()
    late = {"signal": "v", "finding": "late", "kind": "delay", "log": "delay_s = 0.02"}
    found = DIAGNOSIS | {"preflight": [late | {"corrected": True, "delay_s": 0.02}]}
    for name, now in (
        ("v", 'path = "/csv.v"\nscale = 0.5'),
        ("x", 'path = "/csv.y"'),
        ("v", 'path = "/csv.v"\ndelay_s = 0.02'),
    ):
        changed = written.replace(f'path = "/csv.{name}"', now)
        (w.folder / "grounded.toml").write_text(changed)
        corrected = "delay_s" in now  # the diagnosis did that itself
        if corrected:
            diagnosed(w.folder, **found, diagnosed={"trials": ["t0001"]})
        told = grounded("-C", w.folder, "status")
        assert holds(told.out, "[log] was changed since", f"reads {name}") is not corrected
        assert (" ingest hand.csv --data" in last(told)) is not corrected
        assert ("adopt viscous_friction:v" in last(told)) is corrected
    changed = written.replace('path = "/csv.v"', 'path = "/csv.v"\nscale = 0.5')
    (w.folder / "grounded.toml").write_text(changed)
    diagnosed(w.folder, diagnosed={"trials": ["t0001"], "adopted": [], "params": {}})
    refused = grounded("-C", w.folder, "ingest", "--data", log)
    assert refused.code == 1 and "discard" in refused.err.split("next:")[1]
    assert last(grounded("-C", w.folder, "discard", "t0001")).endswith("ingest hand.csv --data")
    assert last(grounded("-C", w.folder, "status")).endswith("ingest hand.csv --data")
    assert last(grounded("-C", w.folder, "ingest", "--data", log)).endswith("diagnose")
    assert last(grounded("-C", w.folder, "status")).endswith("diagnose")


def test_without_the_effects_of_its_diagnosis_a_model_is_diagnosed_before_it_plans(tmp_path):
    """After `adopt --undo` and another model.py a plan with the crude model was to be run."""
    folder = make(tmp_path / "w").folder
    assert grounded("-C", folder, "learn", "--trials", 2).code == 0
    for name in ("reports", "candidates"):
        (folder / name).mkdir(exist_ok=True)
    effect = {"name": "viscous_friction:v", "k": 0.1}
    made = {"trials": ["t0001", "t0002"], "adopted": [effect], "params": {}}
    diagnosed(folder, diagnosed=made)
    assert last(grounded("-C", folder, "status")) == "grounded diagnose"
    none = {"kind": "none", "effects": [], "sentence": "None."}
    diagnosed(folder, diagnosed=made, verdict=none, ranking=[])
    assert last(grounded("-C", folder, "status")) == "grounded propose"
    diagnosed(folder, diagnosed=made)
    set_in_model(folder / "grounded.toml", effects=[effect | {"k": 0.2}])
    assert last(grounded("-C", folder, "status")) == "grounded propose"


def test_a_look_at_the_instruments_ends_with_what_is_next(cart, tmp_path):
    done = grounded("-C", copied(cart, tmp_path / "w"), "diagnose", "--instruments")
    assert last(done) == "grounded adopt viscous_friction:v"


def test_what_differs_between_two_robots_is_not_adopted(cart, tmp_path):
    w = Workspace(copied(cart, tmp_path / "w"))
    both = ["t0001", "t0002"]
    value = {"value": 0.1, "std": 0.01}
    one = {"effect": "parameter:m", "quantity": "m", "first": value, "second": value}
    made = {"trials": both, "named": ["t0002"], "compared": ["t0001"]}
    for changed, follows in (([one], True), ([], False)):
        found = Diagnosis.from_json({**DIAGNOSIS, "changed": changed, "diagnosed": made})
        then = to_adopt(w, found)
        assert then is not None
        assert (then == NextCommand("diagnose", ("--trials", "t0002"))) == follows


def test_a_gap_that_the_verdict_states_is_not_repeated_when_the_search_has_ended():
    left = {"channel": "v", "error": 0.02, "floor": 0.01, "horizon_s": 1.0, "error_unit": "m/s"}
    told = Diagnosis.from_json({**DIAGNOSIS, "leftover": [left], "next_trial": "Run another."})
    assert told.leftover[0].sentence() not in nothing_to_do(told, "c0001")
    assert nothing_to_do(told, "c0001").endswith("To learn more: run another.")
    errors = ({"v": 0.1}, {}, {"v": 0.3})  # of the crude model, calibrated, as diagnosed
    worse = RulerRow(1.0, False, {"v": "m/s"}, "trials", *errors)
    contested = replace(told, prediction_error=(worse,), next_trial="Adopt nothing yet.")
    assert contested.contested and "To learn more" not in nothing_to_do(contested, "c0001")


def test_an_adopted_delay_is_fitted_with_the_parameters_or_named_as_taken_for_exact(
    tmp_path, monkeypatch
):
    folder = make(tmp_path / "w").folder
    grounded("-C", folder, "learn", "--trials", "2")
    late, bent = {"name": "delay:force", "d": 0.02}, {"name": "dead_zone:force", "c": 0.01}
    for effects, names in (([], []), ([late, bent], ["delay:force"])):
        set_in_model(folder / "grounded.toml", effects=effects)
        assert grounded("-C", folder, "fit", "--json").json["not_fitted"] == names
    assert grounded("-C", folder, "fit", "--latency", "--json").json["not_fitted"] == []
    told = " ".join(grounded("-C", folder, "fit").out.split())
    assert "delay:force kept its d, which the intervals take as exact" in told
    set_in_model(folder / "grounded.toml", effects=[late])
    fitted = grounded("-C", folder, "fit", "--json").json
    found = fitted["params"]["delay_force_d"]
    assert fitted["not_fitted"] == [] and found["low"] < found["high"] and found["unit"] == "s"
    assert found["start"] == late["d"]
    alone = grounded("-C", folder, "fit", "--params", "mass", "--json").json["params"]
    assert set(alone) == {"mass"}
    apply_fit(Workspace(folder), Workspace(folder).fit().fit)
    (effect,) = Workspace(folder).config.model.effects
    assert effect["d"] == pytest.approx(found["value"], rel=1e-6)
    # "0.0584 .. 0.0592" of rows 0.05 s apart, beside +- 0.025 in the diagnosis
    exact = grounded("-C", folder, "fit", "--json").json["params"]
    exact, same = exact["delay_force_d"], exact["mass"]
    monkeypatch.setattr(fitting, "unsure_times", lambda *_: (0.05, 0.0))
    wide = grounded("-C", folder, "fit", "--json").json
    assert wide["rows_s"] == 0.05 and fitted["rows_s"] == 0.0
    known = wide["params"]["delay_force_d"]
    assert known["low"] == pytest.approx(exact["low"] - 0.05)
    assert known["high"] == pytest.approx(exact["high"] + 0.05)
    assert "the 0.05 s between rows" in " ".join(grounded("-C", folder, "fit").out.split())
    monkeypatch.setattr(fitting, "unsure_times", lambda *_: (0.0, 0.002))
    wide = grounded("-C", folder, "fit", "--json").json
    known = wide["params"]["delay_force_d"]
    assert wide["interpolated_s"] == 0.002
    half = math.hypot(exact["high"] - exact["value"], 1.96 * 0.002)
    assert known["high"] == pytest.approx(exact["value"] + half)
    assert wide["params"]["mass"] == same  # no time
    assert "2 ms, since states were inter" in " ".join(grounded("-C", folder, "fit").out.split())
