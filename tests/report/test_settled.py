"""What was found and adopted stays in sight, with what it gained: text, page, JSON, status."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from cli import grounded, plain
from facts import holds
from grounded import Model, Param
from grounded.diagnosis.report import Diagnosis, Estimate
from grounded_trials import Workspace
from grounded_trials.report import settled
from grounded_trials.report.gathering import gather
from grounded_trials.report.page.tables import candidate_table, parameter_table
from grounded_trials.report.settled import settled_in, told
from grounded_trials.store.documents import write_document
from grounded_trials.wording import changed, in_digits_apart, legend
from grounded_trials.workspace.adoptable import better_model
from grounded_trials.workspace.adopting import tied_when_adopted
from grounded_trials.workspace.diagnosing import _not_compared
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.last_diagnosis import Since
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


def test_rows_and_clauses_of_parameters_have_one_order():
    """The page pairs them: a boat's thrust stood beside the value of a drag."""
    model = Model(
        states={"v": "m/s"},
        inputs={"u": "N"},
        params={"m": Param(1.0, "kg", 0.5, 2.0), "c": Param(1.0, "N s/m", 0.1, 3.0)},
        derivative=lambda s, a, p: {"v": (a.u - p.c * s.v) / p.m},
    )
    table = SimpleNamespace(effects=(), params={"c": 2.5, "m": 1.4})  # as `fit --apply` wrote them
    known = SimpleNamespace(estimate=lambda name, value, unit: Estimate(value, unit=unit))
    rows = [*settled._rows(model, table, known, {}, {})]
    clauses = settled._moved(model, table.params, set(), {})
    assert [name for name, _ in rows] == [text.split()[0] for text in clauses] == ["m", "c"]
    assert "1.4" in rows[0][1] and "1.40 kg" in clauses[0]


def test_the_status_has_one_line_for_each_adopted_effect_and_parameter(adopted):
    """Of a car it was one paragraph of 30 lines."""
    lines = plain(grounded("-C", adopted, "status").out).splitlines()
    head = next(k for k, line in enumerate(lines) if line.startswith("adopted "))
    effect, mass, gain = lines[head + 1 : head + 4]
    assert re.fullmatch(
        r"viscous_friction:v +k = 0\.300 \+- 0\.010 1/s, or quadratic_drag:v", effect
    )
    assert re.fullmatch(r"mass +1\.4\d* \+- 0\.\d+ kg, was 1", mass)
    assert "12 mm instead of 250 mm" in gain


def test_a_value_stays_as_sure_as_it_was_adopted_after_a_diagnosis_that_claims_nothing(adopted):
    """`c = 0.255 +- 0.020 V` of a crane became `c = 0.255 V`."""
    before = plain(grounded("-C", adopted, "status").out)
    made = MADE | {
        "adopted": [{"name": "viscous_friction:v", "k": 0.3}],
        "params": {"mass": 1.4},
        "nominal": {"mass": 1.4, "viscous_friction_v_k": 0.3},
    }
    said = {"kind": "none", "sentence": "The model explains the data."}
    more = {"ranking": [], "parameters": {}, "credit": [], "leftover": []}
    written(adopted, verdict=said, diagnosed=made, **more)
    rows = re.findall(r"(?m)^(?:viscous_friction:v|mass) .*", before)
    assert len(rows) == 2 and all("+-" in row for row in rows)
    after = plain(grounded("-C", adopted, "status").out)
    assert all(row in after for row in rows)
    (adopted / "reports" / "adoptions.json").unlink()  # derived: the values stay, not how sure
    assert "k = 0.3" in plain(grounded("-C", adopted, "status").out)


def test_a_tie_is_remembered_until_the_other_is_adopted_or_the_one_undone(adopted):
    """`nothing is tied`, said later diagnoses, and the page `the speed drifts by 0.122 m/s2`."""
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


def test_an_adopted_effect_that_another_equals_in_the_model_is_told_so(cart, tmp_path):
    """`The trials could not tell it from input_gain:left` read as if others could."""
    both = ["viscous_friction:v", "quadratic_drag:v"]
    for name, same in (("tied", []), ("same", [both])):
        folder = written(copied(cart, tmp_path / name), equivalent=same)
        assert grounded("-C", folder, "adopt", both[0]).code == 0
        (caveat,) = _not_compared(Folder(folder))
        assert holds(caveat, *both)
        assert ("no trial can tell them apart" in caveat) == bool(same)
        assert ("does not compare" in caveat) != bool(same)
        (folder / "reports" / "diagnosis.json").unlink()  # which tells its ties itself
        (adopted, *_) = settled_in(Folder(folder), None, Since()).adopted
        assert ("no trial can tell them apart in this model" in adopted) == bool(same)


def test_a_part_of_what_was_adopted_that_may_be_zero_is_not_told(cart, tmp_path):
    """`b = 0.034 +- 0.19` was `3.43 % higher at 1, its largest command in the log`."""
    curve = {"a": {"value": 0.403, "std": 0.03, "unit": ""}, "b": {"value": 0.034, "std": 0.19}}
    named = {"kind": "effect", "effects": ["input_curve:force"], "sentence": "It is curved."}
    row = {"effect": "input_curve:force", "params": curve, "evidence": 90.0, "claimed": True}
    folder = written(copied(cart, tmp_path / "w"), verdict=named, ranking=[row], parameters={})
    assert grounded("-C", folder, "adopt", "input_curve:force").code == 0
    [clause] = grounded("-C", folder, "report", "--html", "--json").json["adopted"]["clauses"]
    assert "for positive commands than for negative" in clause and "near zero" not in clause
    page = (folder / "reports" / "report.html").read_text()
    assert "for positive commands" in page and "its largest command" not in page


def test_a_parameter_that_stays_behind_is_told_and_no_gain_is_claimed(cart, tmp_path):
    """The effect was fitted beside a mass of 1.4 kg, which the trials do not tell."""
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


def test_a_parameter_at_its_bound_is_told_so_also_once_adopted(cart, tmp_path):
    """`Yvd 3.000 +- 0.020 kg, was 15` was an added mass that a boat's data asked to be less."""
    folder = written(copied(cart, tmp_path / "w"))
    code = (folder / "model.py").read_text()
    bounded = re.sub(r'"mass": Param\(1.0, "kg"[^)]*\)', '"mass": Param(1.0, "kg", 0.5, 1.4)', code)
    (folder / "model.py").write_text(bounded)
    assert bounded != code
    assert grounded("-C", folder, "adopt", "viscous_friction:v").code == 0
    assert "kg, at its bound, the data ask for more, was 1" in words(folder, "status")
    clauses = grounded("-C", folder, "report", "--json").json["adopted"]["clauses"]
    assert clauses[1] == "mass 1.00 -> 1.40 kg, at its bound, the data ask for more"


def test_an_effect_that_shows_only_in_combination_is_adopted_and_marked(cart, tmp_path):
    one = {"values": ["viscous_friction:v"], "rests_on": {"mass": 0.1}}
    folder = written(copied(cart, tmp_path / "w"), combinations=[one])
    done = grounded("-C", folder, "adopt", "viscous_friction:v")
    assert done.code == 0 and "not determined alone" in done.out
    assert grounded("-C", folder, "adopt", "--undo").code == 0
    again = grounded("-C", folder, "adopt", "viscous_friction:v", "--json").json
    assert again["jointly"] == ["viscous_friction:v"]


def test_a_value_that_rests_on_a_parameter_is_told_with_it_everywhere(cart, tmp_path):
    """`thrust 18.080 +- 0.066 N`, of which the trials show only the ratio to a mass."""
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
    """A KeyError, with grounded.toml written: it was looked for among the model's parameters."""
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
    """The number of an adopted effect too; what was adopted since is not added a second time."""
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


def test_what_an_adopted_curve_does_at_its_end_is_told_with_that_end(cart, tmp_path):
    """In words its b of 0.4 was 40 %, of the gain half way; the ends are 1.2 and 0.8 of that."""
    folder = copied(cart, tmp_path / "w")
    toml = folder / "grounded.toml"
    curve = 'effects = [{name = "input_curve:force", a = 0.0, b = 0.4, U = 3.5}]'
    toml.write_text(toml.read_text().replace("[model]\n", f"[model]\n{curve}\n"))
    (clause,) = grounded("-C", folder, "report", "--json").json["adopted"]["clauses"]
    assert "50 % higher at 3.5 N" in clause


def test_a_gain_that_nobody_measured_is_not_claimed(cart, tmp_path):
    folder = written(copied(cart, tmp_path / "w"))
    assert grounded("-C", folder, "adopt", "viscous_friction:v", "--effect-only").code == 0
    found = grounded("-C", folder, "report", "--json").json["adopted"]
    assert len(found["clauses"]) == 1 and found["gained"] == ""


def test_what_was_measured_holds_with_a_filter_that_was_adopted_too(cart, tmp_path):
    """The physics was judged with it: `propose` said that nothing had measured the model."""
    lagging = {"signal": "v", "finding": "", "kind": "lag", "delay_s": 0.03, "corrected": True}
    folder = written(copied(cart, tmp_path / "w"), preflight=[lagging])
    assert grounded("-C", folder, "adopt", "viscous_friction:v", "sensor_lag:v").code == 0
    found = grounded("-C", folder, "report", "--json").json["adopted"]
    assert len(found["clauses"]) == 3 and "12 mm instead of 250 mm" in found["gained"]


def test_a_parameter_that_was_adopted_by_name_is_not_missing(cart, tmp_path):
    names = ["viscous_friction:v", "parameter:mass"]
    blamed = {"effect": names[1], "claimed": True, "evidence": 9.0}
    blamed["params"] = {"d": {"value": 0.4, "std": 0.02, "unit": "kg"}}
    verdict = {"kind": "several", "effects": names, "sentence": "Two."}
    ranking = [DIAGNOSIS["ranking"][0], blamed]
    folder = copied(cart, tmp_path / "w")
    written(folder, verdict=verdict, ranking=ranking, parameters={})
    assert grounded("-C", folder, "adopt", *names).code == 0
    found = grounded("-C", folder, "report", "--json").json
    assert found["adopted"]["clauses"][1] == "mass 1.00 -> 1.40 kg" and found["adopted"]["gained"]
    assert "parameter:mass" in found["outdated"] and "but not" not in found["outdated"]
    lost = {"parameter": "mass", "verdict": "not identifiable"}
    folder = copied(cart, tmp_path / "again")
    written(folder, verdict=verdict, ranking=ranking, identifiable=[lost])
    done = grounded("-C", folder, "adopt", *names)  # it said "mass stays at 1.000 kg" beside that
    assert "1.000 -> 1.400 kg" in done.out and "stays at" not in done.err


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


def test_the_answer_says_if_only_some_of_the_trials_were_diagnosed(adopted):
    """A demo diagnoses 8 of its 16 trials."""
    found = gather(Folder(adopted))
    lines = {
        used: told(found.diagnosis, found.task, replace(Since(usable=4), used=used), None)
        for used in (2, 4)
    }
    assert lines[2] == [*lines[4], "Diagnosed with 2 of 4 trials."]


def test_nothing_adopted_nothing_said(cart):
    assert grounded("-C", cart, "report", "--json").json["adopted"] is None
    assert "adopted" not in words(cart, "status")


def test_parameters_stand_before_now_and_as_diagnosed(adopted):
    (block,) = parameter_table(gather(Folder(adopted)))
    row = dict(zip(block.header, next(r for r in block.rows if r[0] == "mass"), strict=True))
    assert (row["in model.py"], row["now"]) == ("1.000", "1.400")
    assert row["diagnosed, 95 %"].startswith("1.400 (1.36")


def test_a_parameter_that_is_blamed_by_name_has_a_value(cart, tmp_path):
    blamed = {"effect": "parameter:mass", "claimed": True, "evidence": 9.0}
    blamed["params"] = {"d": {"value": 0.4, "std": 0.02, "interval": [0.36, 0.44], "unit": "kg"}}
    verdict = {"kind": "effect", "effects": ["parameter:mass"], "sentence": "One."}
    folder = written(copied(cart, tmp_path / "w"), verdict=verdict, ranking=[blamed], parameters={})
    (block,) = parameter_table(gather(Folder(folder)))
    row = dict(zip(block.header, next(r for r in block.rows if r[0] == "mass"), strict=True))
    assert row["diagnosed, 95 %"] == "1.400 (1.36 to 1.44)"


def test_the_order_of_candidates_is_explained(cart):
    findings = gather(Folder(cart))
    made, *rest = candidate_table(findings)
    bases = [row[made.header.index("from")] for row in made.rows]
    assert bases == [t.candidate.base or "-" for t in findings.history]
    iterations = [t.candidate.iteration for t in findings.history]
    assert (
        iterations == sorted(iterations) and not rest and "decreases" not in words(cart, "status")
    )
    assert "decreases" in legend("alpha", [0, 1, 2, 1]) and legend("alpha", [0, 1, 1]) == "alpha"


def test_numbers_that_differ_are_told_apart():
    assert changed("l", 0.5, 0.4997, "m") == "l 0.5000 -> 0.4997 m"
    assert in_digits_apart(0.99973, 1.0) == ("0.9997", "1.000")  # not 1.000 and 1.00
    assert changed("g", 2.0, 2.0, "1") == "g 2.000, as before"


def test_a_gain_needs_the_values_that_were_diagnosed(adopted):
    text = (adopted / "grounded.toml").read_text()
    (adopted / "grounded.toml").write_text(re.sub(r"k = 0\.3\b", "k = 0.7", text))
    findings = gather(Folder(adopted))
    assert findings.settled is not None and not findings.settled.closed
    assert replace(findings.settled, left="").lines == [findings.settled.lines[0]]


@pytest.mark.parametrize("value", [0.05, -0.05])
def test_a_sensor_s_bias_is_said_to_move_start_and_target(cart, tmp_path, value):
    text = json.dumps(DIAGNOSIS).replace("viscous_friction:v", "sensor_bias:v")
    document = json.loads(text.replace('"k": {"value": 0.3', f'"b": {{"value": {value}'))
    folder = written(copied(cart, tmp_path / "w"), **document)
    done = grounded("-C", folder, "adopt", "sensor_bias:v")
    reads = f"0.05 m/s too {'high' if value > 0 else 'low'}"
    keep, mend = f"write v = {value} in", f"offset {-value:+}"
    said = " ".join(done.err.split())
    assert done.code == 0 and holds(said, "start", "target", reads, keep, mend)
    assert holds(said, "remove sensor_bias:v")  # or it is corrected twice


def test_status_has_no_two_empty_lines_in_a_row(adopted):
    out = grounded("-C", adopted, "status").out
    assert "adopted" in out and "\n\n\n" not in out


def test_a_repeat_that_has_come_in_is_said_to_need_a_new_diagnosis(cart, tmp_path):
    """`Only a repeat of one run tells` stood in `status` after one, and `next:` was to export."""
    unsure = ROW | {"noise_floor": {"x": 0.0115, "v": 0.019}, "floor_at_most": True}
    alone = {"leftover": [], "indistinguishable": [], "unconfirmed": []}
    folder = written(copied(cart, tmp_path / "w"), prediction_error=[unsure], **alone)
    assert grounded("-C", folder, "adopt", "viscous_friction:v").code == 0
    asks = "Only a repeat of one run tells how much of what is left in v is noise"
    before = words(folder, "status")
    assert asks in before and "repeat one run" not in before
    run = Workspace(folder).run("best").trial_file
    added = Workspace(folder).ingest(run).trial
    for command in ("status", "report"):
        told = words(folder, command)
        assert asks not in told, command
        assert holds(told, f" and {added} repeat one run: diagnose again to know how much of")
    assert "A new diagnosis tells how much of what is left in v is noise" in told
    assert Workspace(folder).status().then.verb == "diagnose"
