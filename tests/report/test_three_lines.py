"""The verdict in three lines: what was wrong, what predictions gain, what is open."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from grounded.diagnosis.report import Diagnosis
from grounded.result import measured, measured_alike
from grounded.utility import Reward
from grounded_trials.report.three_lines import gained, gained_most, three_lines
from reported import DIAGNOSIS
from small_tasks import cart_task

ROW = {
    "horizon_s": 1.0,
    "unit_by_channel": {"x": "m", "v": "m/s"},
    "crude": {"x": 0.25, "v": 0.31},
    "with_effects": {"x": 0.012, "v": 0.0004},
    "noise_floor": {"x": 0.01, "v": 0.0003},
}
CREDIT = [
    {"of": "calibration", "share": 0.7, "times": 8.0, "without_it": {"x": 0.2}},
    {"of": "viscous_friction:v", "share": 0.28, "times": 2.4, "without_it": {"x": 0.1}},
    {"of": "delay:force", "share": 0.02, "times": 1.06, "without_it": {"x": 0.013}},
]
CAUSES = (
    "the model's own parameters are off: mass should be 1.4 kg (+40%)",
    "the speed v is opposed by a friction of 0.3 1/s; dry (as measured)",
    "the force arrives 0.02 s later than modelled",
)


@pytest.fixture
def diagnosis():
    made = {"trials": ["t0001"], "adopted": [], "nominal": {"mass": 1.0}}
    verdict = {"kind": "several", "effects": ["viscous_friction:v"], "causes": CAUSES}
    more = {"prediction_error": [ROW], "credit": CREDIT, "diagnosed": made, "verdict": verdict}
    left = DIAGNOSIS["leftover"][0] | {
        "error": 0.02,
        "floor": 0.005,
        "error_unit": "m/s",
        "horizon_s": 1.0,
    }
    plain = DIAGNOSIS | {"indistinguishable": []} | more | {"leftover": [left]}
    return Diagnosis.from_json(plain)


def test_causes_gain_and_what_is_left(diagnosis):
    wrong, gained, left = three_lines(diagnosis, cart_task())
    assert CAUSES[0][1:] in wrong and CAUSES[1] in wrong
    assert CAUSES[2] in wrong  # in words, however small its share
    assert "x by 12 mm instead of 250 mm" in gained
    assert "v" in left and "0.020 m/s" in left and "0.0050 m/s" in left and "x > 0.2" in left


def test_what_is_equal_as_printed_is_left_out(diagnosis):
    (row,) = diagnosis.prediction_error
    row = replace(row, crude={"x": 0.25, "v": 0.02001}, with_effects={"x": 0.012, "v": 0.02})
    reward = Reward(np.array([10.0, 1.0]), np.zeros(2), np.zeros(1), np.ones(1))
    both = cart_task(reward=reward, target=np.zeros((41, 2)))
    text = three_lines(replace(diagnosis, prediction_error=(row,)), both)[1]
    assert "x by 12 mm instead of 250 mm" in text and "v by" not in text
    alone = replace(row, crude={"x": 0.01201, "v": 0.02}, with_effects={"x": 0.012, "v": 0.02})
    found = gained(replace(diagnosis, prediction_error=(alone,)), cart_task())
    assert "x by 12 mm instead of 12 mm" in found


def test_what_became_worse_is_not_kept_back(diagnosis):
    worse = "worse for x: 3.8 m instead of 2.1 m."
    (row,) = diagnosis.prediction_error
    whole = replace(row, whole_trial=True, crude={"x": 2.1}, with_effects={"x": 3.8})
    found = replace(diagnosis, prediction_error=(row, whole))
    assert three_lines(found, cart_task())[1].endswith(worse)


def test_what_is_weighed_is_spoken_of(diagnosis):
    names = [names for names, _ in gained_most(diagnosis, cart_task())]
    assert names == [["x"]]  # v has no weight


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (0.17, "m", "170 mm"),
        (2.0, "m", "2.0 m"),
        (4e-4, "m", "0.40 mm"),
        (3e-6, "rad", "3.0 µrad"),
        (0.3, "rad/s", "0.30 rad/s"),
        (3e-4, "V", "3.0e-04 V"),
        (0.0, "m", "0 m"),
    ],
)
def test_an_error_is_given_in_a_unit_that_fits(value, unit, text):
    assert measured(value, unit) == text


@pytest.mark.parametrize(
    ("values", "unit", "texts"),
    [
        ((1.6e-4, 1.6e-3), "m", ["0.16 mm", "1.6 mm"]),  # it was 0.16 mm -> 0.16 cm
        ((1.6e-3, 9.1e-4), "m", ["1.6 mm", "0.91 mm"]),
        ((8.2e-4, 0.045), "m", ["0.82 mm", "45 mm"]),
        ((1.75, 0.012), "m", ["1,750 mm", "12 mm"]),
        ((0.31, 1.6e-3), "m", ["310 mm", "1.6 mm"]),
        ((1.2e-3, 7.3e-4), "rad", ["1.2 mrad", "0.73 mrad"]),
        ((0.12, 5.8e-4), "rad", ["0.12 rad", "0.00058 rad"]),
        ((0.2, 0.0), "m", ["200 mm", "0 mm"]),
        ((0.17,), "m", ["170 mm"]),
    ],
)
def test_errors_that_are_compared_have_one_unit(values, unit, texts):
    assert measured_alike(values, unit) == texts
