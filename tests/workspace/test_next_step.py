"""The command to type next is one, wherever it is asked; and what `adopt` does with a diagnosis."""

import math
import re
import shlex
from dataclasses import replace
from pathlib import Path

import pytest

from cli import grounded, plain, process
from facts import holds
from grounded.findings import found
from grounded.search.standing import Ending, ended
from grounded_trials import Workspace
from grounded_trials.report.gathering import gather
from grounded_trials.wording import placed, rendered
from grounded_trials.workspace import fitting
from grounded_trials.workspace.adoption import diagnosed_again
from grounded_trials.workspace.diagnosing import diagnosable
from grounded_trials.workspace.fitting import apply_fit
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.last_diagnosis import model_print, read_diagnosis
from grounded_trials.workspace.next_step import DIAGNOSE, EXPORT, after_diagnosis
from grounded_trials.workspace.user_files.config import set_keys
from reported import DIAGNOSIS, copied, diagnosed
from workspaces import make

FIRST, SECOND = DIAGNOSIS["ranking"]
NONE = {"kind": "none", "effects": [], "sentence": "None."}
LATE = SECOND | {"params": {"d": {"value": 0.02, "std": 0.01, "unit": "s"}}}
BOTH = {"kind": "several", "effects": ["viscous_friction:v", "delay:force"], "sentence": "Two."}
TWO = {"verdict": BOTH, "ranking": [FIRST, LATE]}
UNKNOWN = {"kind": "unknown", "effects": [], "limit": "model.few"}
UNKNOWABLE = {"verdict": UNKNOWN}
LAGGING = {"signal": "v", "finding": "", "kind": "lag", "delay_s": 0.03, "corrected": True}
DELAYED = LAGGING | {"kind": "delay", "keys": {"delay_s": 0.05}}  # on top of 0.02 s in [log]
ROW = {"horizon_s": 1.0, "unit_by_channel": {"v": "m/s"}, "crude": {"v": 0.3}}
DIFFERS = {"effect": "viscous_friction:v", "quantity": "k", "agrees": False, "chance": 0.0}


@pytest.fixture
def w(cart, tmp_path):
    """A workspace whose search has ended, diagnosed."""
    return Workspace(copied(cart, tmp_path / "w"))


def following(folder: Path) -> str:
    """The words of the next command, without the program."""
    return rendered(Workspace(folder).status().then).removeprefix("grounded ")


def last(done) -> str:
    """The command of the `next:` line, a continued one in one piece."""
    assert done.code == 0, done.err
    text = plain(done.out).rstrip().splitlines()[-1]
    assert text.startswith("next: ")
    return text.removeprefix("next: ")


def one_effect(name: str, **value: float) -> dict:
    params = {key: {"value": number, "std": 0.01, "unit": "1"} for key, number in value.items()}
    verdict = {"kind": "effect", "effects": [name], "sentence": "One."}
    return {"verdict": verdict, "ranking": [FIRST | {"effect": name, "params": params}]}


def predicted(after: float, **more) -> dict:
    return {"prediction_error": [ROW | {"with_effects": {"v": after}} | more]}


def taken_in(*numbers: int) -> dict:
    """Of which trials a diagnosis is said to be made."""
    return {"trials": [f"t{k:04d}" for k in numbers], "adopted": [], "params": {}}


ASK = found("search.lost_in_row", then=DIAGNOSE, lost=2)


def asking(now):
    """The standing, which asks for a diagnosis."""
    return now.with_finding(ASK)


def standings_asking(monkeypatch) -> None:
    """Every standing of a search asks for a diagnosis."""
    from grounded.search import improve, standing

    plainly = standing.standing
    for module in (improve, standing):
        monkeypatch.setattr(
            module, "standing", lambda *given, **more: asking(plainly(*given, **more))
        )


@pytest.mark.parametrize("command", ["status", "report", "propose"])
def test_every_command_says_the_same_once_the_search_has_ended(cart, command):
    assert last(grounded("-C", cart, command)) == "grounded adopt viscous_friction:v"


# the gain that only turns a sign round is -2, within 10 %
FOLLOWS = {
    "an effect": ({}, "adopt viscous_friction:v"),
    "two effects": (TWO, "adopt viscous_friction:v delay:force"),
    "nothing": ({"verdict": NONE}, "export best --runner"),
    "too little": (UNKNOWABLE, "run best"),
    "a parameter": ({"verdict": one_effect("parameter:mass")["verdict"]}, "adopt parameter:mass"),
    "another model": ({"diagnosed": {"trials": [], "params": {"mass": 9.0}}}, "diagnose"),
    "a weaker gain": (one_effect("input_gain:force", g=-0.1), "adopt input_gain:force"),
    "a wrong sign": (one_effect("input_gain:force", g=-1.9), "diagnose"),
    "a sign and a gain": (one_effect("input_gain:force", g=-1.63), "adopt input_gain:force"),
    "a filter": ({"preflight": [LAGGING]}, "adopt viscous_friction:v sensor_lag:v"),
    "a filter alone": ({"preflight": [LAGGING], "verdict": NONE}, "adopt sensor_lag:v"),
    "a delay": ({"preflight": [DELAYED]}, "adopt viscous_friction:v sensor_delay:v"),
    "trials agree": (predicted(0.2), "adopt viscous_friction:v"),
    "trials differ, better": (
        predicted(0.2) | {"agreement": [DIFFERS]},
        "adopt viscous_friction:v",
    ),
    "trials differ, worse": (predicted(0.5) | {"agreement": [DIFFERS]}, "export best --runner"),
    "worse": (predicted(0.5), "export best --runner"),
    "worse in one state, better in all": (
        predicted(
            0.5,
            unit_by_channel={"v": "m/s", "x": "m"},
            crude={"v": 0.3, "x": 4.0},
            with_effects={"v": 0.5, "x": 0.1},
        ),
        "adopt viscous_friction:v",
    ),
}
# of a step of 50 ms too little to matter, not shown by the trials, or mended in [log]
FOLLOWS |= {
    f"a filter that is none, {k}": ({"preflight": [one]}, "adopt viscous_friction:v")
    for k, one in enumerate(
        (
            LAGGING | {"delay_s": 1e-4},
            LAGGING | {"corrected": False},
            LAGGING | {"keys": {"delay_s": 0.03}},
            DELAYED | {"delay_s": 1e-4},
            DELAYED | {"corrected": False},
        )
    )
}


@pytest.mark.parametrize("case", FOLLOWS)
def test_what_follows_a_diagnosis_of_an_ended_search(w, case):
    changes, then = FOLLOWS[case]
    diagnosed(w.folder, **changes)
    assert following(w.folder) == then


# before and during a search


def test_what_logs_have_shown_is_adopted_before_the_first_candidate(tmp_path):
    folder = make(tmp_path / "w").folder
    assert following(folder) == "propose"
    (folder / "reports").mkdir()
    diagnosed(folder)
    assert following(folder) == "adopt viscous_friction:v"
    assert Workspace(folder).adopt("viscous_friction:v").then.verb == "propose"
    assert following(folder) == "propose"


def test_a_manoeuvre_is_drawn_before_the_first_plan(tmp_path):
    w = Workspace(make(tmp_path / "w").folder)
    zeros = "t,x\n" + "".join(f"{0.05 * k:.10g},0\n" for k in range(41))
    (w.folder / "target.csv").write_text(zeros)
    assert following(w.folder) == "target SHAPE"
    (w.folder / "reports").mkdir()
    diagnosed(w.folder)
    assert rendered(w.adopt("viscous_friction:v").then) == "grounded target SHAPE"
    assert following(w.folder) == "target SHAPE"
    assert w.undo_adoption().then.verb == "target"
    diagnosed(w.folder, verdict=NONE, ranking=[])
    assert after_diagnosis(Folder(w.folder), read_diagnosis(w.reports)).verb == "target"
    diagnosed(w.folder, **UNKNOWABLE)  # a drive that tells more comes before a manoeuvre
    assert after_diagnosis(Folder(w.folder), read_diagnosis(w.reports)).verb == "excite"
    assert following(w.folder) == "excite"
    diagnosed(w.folder, verdict=NONE, ranking=[])
    config = w.config.file.read_text()
    w.config.file.write_text(config.replace("[task]", "[task]\nstart = { x = 0.3 }"))
    assert following(w.folder) == "propose"  # from there zeros ask for something
    w.config.file.write_text(config)
    assert grounded("-C", w.folder, "target", "line", "--to", "x=1").code == 0
    assert following(w.folder) == "propose"


def test_a_search_that_doubts_its_model_is_diagnosed_after_two_runs(tmp_path, monkeypatch):
    w = Workspace(make(tmp_path / "w").folder)
    w.learn(1)
    standings_asking(monkeypatch)
    assert w.status().then.verb == "propose"  # one run confirms nothing
    w.ingest(w.run(w.propose().candidate.id).trial_file)
    assert w.status().then.verb == "diagnose"
    w.reports.mkdir()
    diagnosed(w.folder, diagnosed=taken_in(1, 2))
    assert w.status().then.verb == "adopt"


# after a search


def test_trials_that_came_after_a_diagnosis_make_it_old(w):
    count = len(w.trials())
    for seen, then in ((count, "adopt viscous_friction:v"), (2, "diagnose")):
        diagnosed(w.folder, diagnosed=taken_in(*range(1, seen + 1)))
        assert following(w.folder) == then
        found = gather(Folder(w.folder)).since
        assert (found.used, found.newer) == (seen, count - seen)


def test_another_model_or_other_limits_make_a_diagnosis_old(w):
    made = taken_in(*range(1, len(w.trials()) + 1)) | {"model": model_print(Folder(w.folder))}
    diagnosed(w.folder, diagnosed=made)
    config, model = w.config.file, w.folder / "model.py"
    for file, old, new, changed in (
        (config, "[-5.0, 5.0]", "[-4.0, 4.0]", True),
        (config, "[task]", "[task]\nstart = { x = 0.1 }", False),
        (model, "(a.force -", "(2 * a.force -", True),
    ):
        text = file.read_text()
        assert old in text
        file.write_text(text.replace(old, new))
        found = gather(Folder(w.folder)).since
        assert found.changed == bool(found.findings) == changed
        file.write_text(text)


def test_an_ended_search_asks_for_a_diagnosis_until_a_newer_one_is_made(w, monkeypatch):
    from grounded_trials.workspace.candidates import search_state as module

    plainly = module.standing
    monkeypatch.setattr(module, "standing", lambda *given, **more: asking(plainly(*given, **more)))
    (w.reports / "diagnosis.json").unlink()
    assert w.status().then == DIAGNOSE
    usable = [trial.id for trial in diagnosable(w)]
    for seen, then in ((usable[:-1], DIAGNOSE), (usable, EXPORT)):
        made = {"trials": seen, "params": dict(w.config.model.params)}
        diagnosed(w.folder, verdict=NONE, diagnosed=made)
        assert w.status().then == then


def test_what_was_diagnosed_and_adopted_is_not_diagnosed_again(w, monkeypatch):
    now = w.status().standing
    best = replace(now.incumbent, trials=now.incumbent.trials[:1] * 2)
    why = found("search.no_step", best="c0002", lost=2)
    doubtful = ended(replace(now, incumbent=best), Ending.NO_STEP, why, ASK)
    monkeypatch.setattr(
        "grounded_trials.workspace.candidates.search_state.standing", lambda *_, **__: doubtful
    )
    count = len(w.trials())
    diagnosed(w.folder, diagnosed=taken_in(*range(1, count)))
    w.adopt("viscous_friction:v")
    assert following(w.folder) == "diagnose"
    diagnosed(w.folder, diagnosed=taken_in(*range(1, count + 1)))
    assert following(w.folder) == "export best --runner"


def test_a_changed_model_that_promises_nothing_is_said_to(w):
    set_keys(w.config.file, "model", effects=[{"name": "viscous_friction:v", "k": 1e-9}])
    found = w.propose()
    assert found.candidate is None and "plan.no_better" in {one.code for one in found.findings}


# how commands are printed


@pytest.mark.slow
def test_printed_commands_work_from_where_the_user_is(tmp_path):
    def told(done):
        return shlex.split(done.out.rstrip().replace("\\\n", " ").splitlines()[-1])

    make(tmp_path / "my cart")
    for at in (("-C", "my cart", "propose"), ("propose", "-C", "my cart")):
        done = process(*at, cwd=tmp_path)
        assert done.out.endswith("\nnext: grounded -C 'my cart' run\n"), done.out
    for expected in ("ingest", "propose"):
        done = process(*told(done)[2:], cwd=tmp_path)
        assert done.code == 0, done.err
        assert told(done)[:5] == ["next:", "grounded", "-C", "my cart", expected]
    assert process("propose", cwd=tmp_path / "my cart").out.endswith("next: grounded run\n")
    done = process("-C", "my cart", "adopt", "delay:force", cwd=tmp_path)
    assert done.err.endswith("next: grounded -C 'my cart' diagnose\n")
    done = process("-C", "my cart", "init", "new", "--example", "pendulum", cwd=tmp_path)
    assert done.out.endswith("cd new && grounded propose\n")


def test_commands_inside_sentences_work_from_where_the_user_is(w, monkeypatch):
    w.config.file.write_text(re.sub("(?m)^target = .*$", "", w.config.file.read_text()))
    done = grounded("-C", w.folder, "propose")
    assert done.code == 1 and f"`grounded -C {w.folder} target`" in done.err
    monkeypatch.chdir(w.folder)
    assert "`grounded target`" in grounded("propose").err
    kept = "`grounded -C x run` `grounded init DIR` `grounded it's` grounded run"
    assert placed(kept, "my cart") == kept
    there = placed("a `grounded ingest LOG --data`.", "my cart")
    assert there == "a `grounded -C 'my cart' ingest LOG --data`."
    assert placed("a `grounded run`", None) == "a `grounded run`"


# adopt


def test_all_claimed_effects_are_adopted_at_once(w):
    diagnosed(w.folder, **TWO)
    done = grounded("-C", w.folder, "adopt", *BOTH["effects"], "--json").json
    assert [effect["name"] for effect in done["effects"]] == BOTH["effects"][::-1]  # commands first
    assert done["params"] == {"mass": 1.4} and done["claimed"]
    assert following(w.folder) == "diagnose"  # with the model as it is


@pytest.mark.parametrize(
    ("changes", "names", "facts"),
    [
        ({}, ["viscous_friction:v", "delay:forse"], ["'delay:force'"]),
        ({}, ["viscous_friction:v", "delay:force"], ["delay:force", "viscous_friction:v"]),
        (UNKNOWABLE, ["viscous_friction:v"], []),
    ],
)
def test_what_can_not_be_adopted_changes_nothing(w, changes, names, facts):
    diagnosed(w.folder, **changes)
    before = w.config.file.read_text()
    done = grounded("-C", w.folder, "adopt", *names)
    assert done.code == 1 and holds(" ".join(done.err.split()), *facts)
    assert w.config.file.read_text() == before


@pytest.mark.parametrize("named", [True, False])
def test_a_late_sensor_is_adopted_with_the_physics(w, named):
    diagnosed(w.folder, preflight=[DELAYED])
    effect = {"name": "sensor_delay:v", "d": 0.03}
    done = w.adopt("viscous_friction:v", *[effect["name"]] * named)
    assert done.effects[-1] == effect and done.params == {"mass": 1.4}
    assert done.along == (() if named else (effect["name"],))
    assert any(name.startswith("v_true") for name in w.planner.plan.model.state_names)
    assert following(w.folder) == "diagnose"


@pytest.mark.parametrize(("now", "counted"), [(0.01, False), (0.05, True)])
def test_a_delay_that_log_takes_out_by_now_does_not_act_twice(w, now, counted):
    diagnosed(w.folder, preflight=[DELAYED])
    state = f'x = {{ path = "/csv.x" }}\nv = {{ path = "/csv.v", delay_s = {now} }}'
    table = f'\n[log.state]\n{state}\n[log.input]\nforce = {{ path = "/csv.force" }}\n'
    w.config.file.write_text(w.config.file.read_text() + table)
    assert following(w.folder).endswith("viscous_friction:v" if counted else "sensor_delay:v")
    before = w.config.file.read_text()
    done = grounded("-C", w.folder, "adopt", "viscous_friction:v", "sensor_delay:v")
    assert done.code == counted and (not counted or "delay_s" in done.err)
    assert (w.config.file.read_text() == before) == counted
    assert grounded("-C", w.folder, "propose").code == 0


def test_an_adoption_is_undone_and_not_proposed_again_until_a_new_diagnosis(w):
    diagnosed(w.folder, **TWO)
    file, (first, second) = w.config.file, BOTH["effects"]
    before = file.read_text()
    w.adopt(first, parameters=False)
    one = file.read_text()
    w.adopt(second)
    done = grounded("-C", w.folder, "adopt", "--undo", "--json").json
    assert done["undone"] == [second]
    assert [effect["name"] for effect in done["effects"]] == [first]
    assert file.read_text() == one
    assert w.undo_adoption().then.verb == "propose" and file.read_text() == before
    assert "adopt" not in following(w.folder)
    assert w.report().to_json()["next"] != "adopt"
    assert grounded("-C", w.folder, "adopt", "--undo").code == 1
    diagnosed_again(Folder(w.folder))
    assert following(w.folder).startswith("adopt ")


def test_an_adoption_under_later_changes_is_not_undone(w):
    set_keys(w.config.file, "model", effects=[{"name": "offset:v", "c": 0.5}])
    w.adopt("viscous_friction:v")
    set_keys(w.config.file, "model", params={"mass": 3.25})
    changed = w.config.file.read_text()
    done = grounded("-C", w.folder, "adopt", "--undo")
    assert done.code == 1 and holds(done.err, "viscous_friction:v", 'name = "offset:v", c = 0.5')
    assert w.config.file.read_text() == changed
    assert grounded("-C", w.folder, "adopt").code == 2
    assert grounded("-C", w.folder, "adopt", "--undo", "viscous_friction:v").code == 2


def test_an_adopted_delay_is_fitted_with_the_parameters_or_named_as_taken_for_exact(
    tmp_path, monkeypatch
):
    w = Workspace(make(tmp_path / "w").folder)
    w.learn(2)
    late, bent = {"name": "delay:force", "d": 0.02}, {"name": "dead_zone:force", "c": 0.01}
    set_keys(w.config.file, "model", effects=[late, bent])
    assert w.fit().to_json()["not_fitted"] == ["delay:force"]
    assert w.fit(latency=True).to_json()["not_fitted"] == []
    set_keys(w.config.file, "model", effects=[late])
    fitted = w.fit().to_json()
    found = fitted["params"]["delay_force_d"]
    assert fitted["not_fitted"] == [] and found["low"] < found["high"] and found["unit"] == "s"
    assert found["start"] == late["d"]
    assert set(w.fit(["mass"]).to_json()["params"]) == {"mass"}
    apply_fit(w, w.fit().fit)
    (effect,) = Workspace(w.folder).config.model.effects.values()
    assert effect["d"] == pytest.approx(found["value"], rel=1e-6)
    # times are known to the rows of the logs, and to what was interpolated between them
    exact = w.fit().to_json()["params"]["delay_force_d"]
    half = exact["high"] - exact["value"]
    for unsure, key, wider in (
        ((0.05, 0.0), "rows_s", half + 0.05),
        ((0.0, 0.002), "interpolated_s", math.hypot(half, 1.96 * 0.002)),
    ):
        monkeypatch.setattr(fitting, "unsure_times", lambda *_, unsure=unsure: unsure)
        wide = w.fit().to_json()
        known = wide["params"]["delay_force_d"]
        assert wide[key] == max(unsure)
        assert known["high"] == pytest.approx(exact["value"] + wider)
