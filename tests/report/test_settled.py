"""What was found and adopted stays in sight: text, page, JSON, status."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from cli import grounded
from grounded_trials import Workspace
from grounded_trials.report.gathering import gather
from grounded_trials.report.tables import parameter_table
from grounded_trials.workspace.folder import Folder
from reported import DIAGNOSIS, cart, copied, diagnosed

__all__ = ["cart"]

FRICTION = "viscous_friction:v"
ROW = {
    "horizon_s": 1.0,
    "unit_by_channel": {"x": "m", "v": "m/s"},
    "crude": {"x": 0.25, "v": 0.31},
    "with_effects": {"x": 0.012, "v": 0.02},
    "noise_floor": {"x": 0.01, "v": 0.019},
}
MADE = {"trials": ["t0001", "t0002"], "adopted": [], "params": {}, "nominal": {"mass": 1.0}}


def written(folder: Path, **more) -> Workspace:
    diagnosed(folder, **{"prediction_error": [ROW], "diagnosed": MADE} | more)
    return Workspace(folder)


@pytest.fixture
def folder(cart, tmp_path):
    return copied(cart, tmp_path / "w")


def test_what_was_adopted_is_told_everywhere(folder, cart):
    assert Workspace(cart).report().to_json()["adopted"] is None
    w = written(folder)
    w.adopt(FRICTION)
    done = grounded("-C", folder, "report", "--html", "--json").json["adopted"]
    assert "0.300 +- 0.010 1/s" in done["clauses"][0]
    assert done["clauses"][1] == "mass: 1.400 +- 0.020 kg, was 1"
    page = (w.reports / "report.html").read_text().replace("\xa0", " ")
    for text in (grounded("-C", folder, "report").out, re.sub(r"<[^>]+>", "", page)):
        assert re.search(r"12\s+mm\s+instead\s+of\s+250\s+mm", text)
    (block,) = parameter_table(gather(Folder(folder)))
    row = dict(zip(block.header, next(r for r in block.rows if r[0] == "mass"), strict=True))
    assert (row["in model.py"], row["now"]) == ("1.000", "1.400")
    assert row["diagnosed "].startswith("1.400 +- 0.020")


DRAG = {"name": "quadratic_drag:v", "k": 0.2}
K = "quadratic_drag_v_k"
HALF = {"effect": FRICTION, "values": [FRICTION], "rests_on": {"mass": 0.1}}
ADOPTIONS = {  # a diagnosis, what is then known only jointly, and what stays behind
    "all": ({}, [], {}),
    "a parameter that the trials do not tell": (
        {"identifiable": [{"parameter": "mass", "verdict": "not identifiable"}]},
        [],
        {"mass": 1.4},
    ),
    "a parameter that its bound has cut": (
        {"parameters": {"mass": {"value": 1.4, "std": 0.5, "unit": "kg", "stopped": "bound"}}},
        [],
        {"mass": 1.4},
    ),
    "a loss that was 0, and is within its +-": (
        {
            "diagnosed": MADE | {"nominal": {"mass": 0.0}},
            "parameters": {"mass": {"value": 0.3, "std": 0.5, "unit": "kg"}},
        },
        [],
        {"mass": 0.3},
    ),
    "a parameter known with others": (
        {"identifiable": [{"parameter": "mass", "verdict": "not identifiable", "jointly": True}]},
        ["mass"],
        {},
    ),
    "an effect known with others": ({"combinations": [HALF]}, [FRICTION], {}),
    "a number of an adopted effect": (
        {
            "diagnosed": MADE | {"adopted": [DRAG], "nominal": {"mass": 1.0, K: 0.2}},
            "parameters": {K: {"value": 0.5, "std": 0.1, "unit": "1/m"}},
            "identifiable": [{"parameter": K, "verdict": "not identifiable"}],
        },
        [],
        {K: 0.5},
    ),
}


@pytest.mark.parametrize("case", ADOPTIONS)
def test_what_is_adopted_is_what_the_trials_tell(folder, case):
    changes, jointly, left = ADOPTIONS[case]
    w = written(folder, **changes)
    shown = grounded("-C", folder, "adopt", FRICTION)
    assert shown.code == 0 and all(name.split("_")[0] in shown.err for name in left)
    w.undo_adoption()
    done = w.adopt(FRICTION).to_json()
    assert (done["jointly"], done["left"]) == (jointly, left)
    assert done["params"] == ({} if left else {"mass": 1.4})


@pytest.mark.parametrize("value", [0.05, -0.05])
def test_a_sensor_s_bias_is_said_to_move_start_and_target(folder, value):
    text = json.dumps(DIAGNOSIS).replace(FRICTION, "sensor_bias:v")
    written(folder, **json.loads(text.replace('"k": {"value": 0.3', f'"b": {{"value": {value}')))
    done = grounded("-C", folder, "adopt", "sensor_bias:v")
    assert done.code == 0 and f"offset {-value:+}" in " ".join(done.err.split())
