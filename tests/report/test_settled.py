"""What was found and adopted stays in sight, with what it gained: text, page, JSON, status."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from cli import grounded, plain
from facts import holds
from grounded.diagnosis.report import Diagnosis
from grounded_trials.report.gathering import gather
from grounded_trials.report.page.tables import parameter_table
from grounded_trials.report.settled import told
from grounded_trials.store.documents import write_document
from grounded_trials.workspace.adoptable import better_model
from grounded_trials.workspace.adopting import tied_when_adopted
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.user_files.config import set_in_model
from reported import DIAGNOSIS, cart, copied

__all__ = ["cart"]

ROW = {
    "horizon_s": 1.0,
    "unit_by_channel": {"x": "m", "v": "m/s"},
    "crude": {"x": 0.25, "v": 0.31},
    "with_effects": {"x": 0.012, "v": 0.02},
    "noise_floor": {"x": 0.01, "v": 0.019},
}
MADE = {"trials": ["t0001", "t0002"], "adopted": [], "params": {}, "nominal": {"mass": 1.0}}


def written(folder: Path, **more) -> Path:
    document = DIAGNOSIS | {"prediction_error": [ROW], "diagnosed": MADE} | more
    write_document(folder / "reports" / "diagnosis.json", document)
    return folder


@pytest.fixture
def adopted(cart, tmp_path):
    folder = written(copied(cart, tmp_path / "w"))
    assert grounded("-C", folder, "adopt", "viscous_friction:v").code == 0
    return folder


def words(*command) -> str:
    return " ".join(plain(grounded("-C", *command).out).split())


def test_what_was_adopted_is_told_everywhere_with_what_it_gained(adopted):
    found = grounded("-C", adopted, "report", "--html", "--json").json["adopted"]
    assert "0.3 1/s" in found["clauses"][0] and found["clauses"][1] == "mass 1.00 -> 1.40 kg"
    assert "x by 12 mm instead of 250 mm" in found["gained"] and "v" in found["left"]
    page = (adopted / "reports" / "report.html").read_text().replace("\xa0", " ")
    for text in (words(adopted, "report"), re.sub(r"<[^>]+>", "", page)):
        assert "Found and adopted: " in text and "12 mm instead of 250 mm" in text
    assert "2 trials, t0001 and t0002" in page


def test_a_tie_is_remembered_until_the_other_is_adopted_or_the_one_undone(adopted):
    assert tied_when_adopted(Folder(adopted)) == {"viscous_friction:v": ("quadratic_drag:v",)}
    made = MADE | {
        "adopted": [{"name": "viscous_friction:v", "k": 0.3}],
        "params": {"mass": 1.4},
        "nominal": {"mass": 1.4, "viscous_friction_v_k": 0.3},
    }
    said = {"kind": "none", "effects": [], "sentence": "The model explains the data."}
    more = {"ranking": [], "parameters": {}, "credit": [], "leftover": [], "indistinguishable": []}
    written(adopted, verdict=said, diagnosed=made, **more)  # a later one, which sees no tie
    for shown in (words(adopted, "status"), words(adopted, "report")):
        assert "quadratic_drag:v" in shown
    clause, _ = grounded("-C", adopted, "report", "--html", "--json").json["adopted"]["clauses"]
    assert clause.endswith("or, as the trials could not tell them apart, quadratic_drag:v instead")
    page = (adopted / "reports" / "report.html").read_text()
    assert "could not tell them apart, quadratic_drag:v instead" in page
    path = adopted / "reports" / "adoptions.json"
    known = json.loads(path.read_text())
    for step in known["adoptions"]:
        del step["ties"]  # a document of an older version
    path.write_text(json.dumps(known))
    assert tied_when_adopted(Folder(adopted)) == {} and "quadratic" not in words(adopted, "status")


def test_a_parameter_that_stays_behind_is_told_and_no_gain_is_claimed(cart, tmp_path):
    lost = {"parameter": "mass", "verdict": "not identifiable"}
    folder = written(copied(cart, tmp_path / "w"), identifiable=[lost])
    done = grounded("-C", folder, "adopt", "viscous_friction:v")
    assert done.code == 0 and holds(done.err, "mass stays at 1.000 kg", "1.400 kg", "diagnose")
    assert grounded("-C", folder, "adopt", "--undo").code == 0
    again = grounded("-C", folder, "adopt", "viscous_friction:v", "--json").json
    assert again["left"] == {"mass": 1.4} and "mass" not in again["params"]
    adopted = grounded("-C", folder, "report", "--json").json["adopted"]
    assert not adopted["gained"] and "instead of 250 mm" not in words(folder, "status")


def test_a_parameter_known_only_with_the_others_is_adopted_and_marked(cart, tmp_path):
    joint = {"parameter": "mass", "verdict": "not identifiable", "jointly": True}
    folder = written(copied(cart, tmp_path / "w"), identifiable=[joint])
    done = grounded("-C", folder, "adopt", "viscous_friction:v")
    assert done.code == 0 and "not determined alone" in done.out and "stays at" not in done.err
    assert grounded("-C", folder, "adopt", "--undo").code == 0
    again = grounded("-C", folder, "adopt", "viscous_friction:v", "--json").json
    assert again["params"]["mass"] == 1.4 and again["jointly"] == ["mass"] and not again["left"]
    adopted = grounded("-C", folder, "report", "--json").json["adopted"]
    assert any("not determined alone" in clause for clause in adopted["clauses"])


def test_an_effect_that_shows_only_in_combination_is_adopted_and_marked(cart, tmp_path):
    one = {"values": ["viscous_friction:v"], "rests_on": {"mass": 0.1}}
    folder = written(copied(cart, tmp_path / "w"), combinations=[one])
    done = grounded("-C", folder, "adopt", "viscous_friction:v")
    assert done.code == 0 and "not determined alone" in done.out
    assert grounded("-C", folder, "adopt", "--undo").code == 0
    again = grounded("-C", folder, "adopt", "viscous_friction:v", "--json").json
    assert again["jointly"] == ["viscous_friction:v"]


def test_a_value_that_rests_on_a_parameter_is_told_with_it_everywhere(cart, tmp_path):
    one = {"parameter": "mass", "verdict": "identifiable", "given": {"radius": 1.0}}
    both = {"values": ["viscous_friction:v"], "rests_on": {"radius": 0.1}}
    more = {"identifiable": [one], "combinations": [both]}
    folder = written(copied(cart, tmp_path / "w"), **more)
    assert grounded("-C", folder, "report", "--html").code == 0
    assert "given radius" in (folder / "reports" / "report.html").read_text()
    assert grounded("-C", folder, "adopt", "viscous_friction:v").code == 0
    written(folder, ranking=[], parameters={}, credit=[], indistinguishable=[])  # a later one
    assert words(folder, "status").count("given radius as in the model") == 2
    clauses = grounded("-C", folder, "report", "--json").json["adopted"]["clauses"]
    assert [text.count("given radius as in the model") for text in clauses] == [1, 1]
    set_in_model(folder / "grounded.toml", params={"mass": 1.5})  # as a fit does, which tells it
    assert words(folder, "status").count("given radius as in the model") == 1


def test_a_number_of_an_adopted_effect_that_stays_behind_is_told_by_its_effect(cart, tmp_path):
    adopted = {"name": "quadratic_drag:v", "k": 0.2}
    name = "quadratic_drag_v_k"
    folder = written(
        copied(cart, tmp_path / "w"),
        diagnosed=MADE | {"adopted": [adopted], "nominal": {"mass": 1.0, name: 0.2}},
        parameters={name: {"value": 0.5, "std": 0.1, "unit": "1/m"}},
        identifiable=[{"parameter": name, "verdict": "not identifiable"}],
    )
    done = grounded("-C", folder, "adopt", "viscous_friction:v")
    assert done.code == 0
    assert holds(
        " ".join(done.err.split()), "k of quadratic_drag:v stays at 0.2000 1/m", "0.5000 1/m"
    )
    assert grounded("-C", folder, "adopt", "--undo").code == 0
    again = grounded("-C", folder, "adopt", "viscous_friction:v", "--json")
    assert again.code == 0 and again.json["left"] == {name: 0.5}


@pytest.mark.parametrize("name", ["parameter:mass", "parameter:quadratic_drag_v_k"])
def test_a_parameter_that_was_blamed_is_in_the_model_as_diagnosed_once(cart, tmp_path, name):
    folder = copied(cart, tmp_path / "w")
    before = [{"name": "quadratic_drag:v", "k": 0.2}]
    set_in_model(folder / "grounded.toml", effects=before)
    blamed = {"effect": name, "claimed": True, "evidence": 9.0}
    blamed["params"] = {"d": {"value": 0.1, "std": 0.02, "unit": "1/m"}}
    names = ["viscous_friction:v", name]
    written(
        folder,
        verdict={"kind": "several", "effects": names, "sentence": "Two."},
        ranking=[DIAGNOSIS["ranking"][0], blamed],
        parameters={},
        diagnosed=MADE | {"adopted": before, "nominal": {"mass": 1.0, "quadratic_drag_v_k": 0.2}},
    )

    def as_diagnosed() -> str:
        found = gather(Folder(folder))
        assert not found.lost
        better = better_model(Folder(folder), found.diagnosis)
        assert better is not None
        return better.planner.fingerprint

    diagnosed = as_diagnosed()
    assert grounded("-C", folder, "adopt", *names).code == 0
    assert as_diagnosed() == Folder(folder).planner.fingerprint == diagnosed
    found = gather(Folder(folder))
    assert found.since.missing == () and set(found.since.adopted) == set(names)


def test_a_new_diagnosis_measures_model_py_beside_what_plans_now(adopted):
    model = Folder(adopted).config.model
    now = {"adopted": [dict(e) for e in model.effects], "params": dict(model.params)}
    row = ROW | {"outset": ROW["crude"], "crude": ROW["with_effects"]}
    verdict = {"kind": "none", "effects": [], "sentence": "Down to the noise."}
    again = {"verdict": verdict, "leftover": [], "indistinguishable": [], "ranking": []}
    written(adopted, **again, prediction_error=[row], diagnosed=MADE | now)
    findings = gather(Folder(adopted))
    diagnosis = findings.diagnosis
    assert isinstance(diagnosis, Diagnosis) and not findings.since.changed
    lines = told(diagnosis, findings.task, findings.since, findings.settled)
    assert lines[0].startswith("Found and adopted") and "12 mm instead of 250 mm" in lines[1]
    assert lines[-1] == "Down to the noise." and lines.count("Down to the noise.") == 1
    assert "model.py" in words(adopted, "report") and "now" in words(adopted, "report")


def test_nothing_adopted_nothing_said(cart):
    assert grounded("-C", cart, "report", "--json").json["adopted"] is None
    assert "adopted" not in words(cart, "status")


def test_parameters_stand_before_now_and_as_diagnosed(adopted):
    (block,) = parameter_table(gather(Folder(adopted)))
    row = dict(zip(block.header, next(r for r in block.rows if r[0] == "mass"), strict=True))
    assert (row["in model.py"], row["now"]) == ("1.000", "1.400")
    assert row["diagnosed, 95 %"].startswith("1.400 (1.36")


def test_a_gain_needs_the_values_that_were_diagnosed(adopted):
    text = (adopted / "grounded.toml").read_text()
    (adopted / "grounded.toml").write_text(re.sub(r"k = 0\.3\b", "k = 0.7", text))
    findings = gather(Folder(adopted))
    assert findings.settled is not None and not findings.settled.closed
    assert replace(findings.settled, left="").lines == [findings.settled.lines[0]]
