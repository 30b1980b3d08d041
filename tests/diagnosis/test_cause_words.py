"""Many causes in few words: those of one kind together, the smallest counted."""

from grounded.diagnosis.cause_words import clauses, meaning
from grounded.diagnosis.report import Estimate
from grounded.effects import Library
from tests.effects.test_effects_joint import PAIRS, arm

ONE, TWO = (f"joint_friction:{pair}" for pair in PAIRS)
INERTIA, GAIN, BIAS = f"added_inertia:{PAIRS[0]}", "input_gain:t1", "sensor_bias:q1"
VALUES = {
    ONE: {"c": Estimate(0.3, 0.01, unit="N m"), "b": Estimate(0.2, 0.01, unit="N m s/rad")},
    TWO: {"c": Estimate(0.1, 0.01, unit="N m"), "b": Estimate(0.05, 0.01, unit="N m s/rad")},
    INERTIA: {"J": Estimate(0.05, 0.01, unit="kg m^2")},
    GAIN: {"g": Estimate(-0.12, 0.01, unit="1")},
    BIAS: {"b": Estimate(0.02, 0.001, unit="rad")},
}


def told(names, shares):
    effects = {name: Library().effect(name, arm) for name in names if name != "calibration"}
    causes = [
        meaning(effects[name], VALUES[name]) if name in effects else "the parameters are off"
        for name in names
    ]
    return clauses(names, causes, shares, effects, VALUES)


def test_the_friction_of_all_joints_is_told_together():
    found = told([INERTIA, ONE, GAIN, TWO], [0.4, 0.3, 0.2, 0.1])
    assert len(found) == 3
    friction = next(text for text in found if "dry friction" in text)
    assert friction.startswith("the input t1 loses 0.3 N m to dry friction and 0.2 N m s/rad")
    assert friction.endswith(", the input t2 0.1 N m and 0.05 N m s/rad (40 % of the improvement)")
    assert "12 % weaker" in found[2]  # a percentage with its direction stands alone


def test_three_causes_are_told_one_by_one_and_one_without_a_share():
    found = told([ONE, TWO, GAIN], [0.5, 0.3, 0.2])
    assert len(found) == 3 and found[1].endswith("(30 % of the improvement)")
    assert told([GAIN], [1.0]) == ("the input t1 acts 12 % weaker than modelled",)


def test_the_smallest_of_many_are_counted():
    names = [INERTIA, ONE, "calibration", GAIN, BIAS, "input_bias:t2"]
    VALUES["input_bias:t2"] = {"b": Estimate(0.03, 0.001, unit="N m")}
    found = told(names, [0.5, 0.2, 0.15, 0.1, 0.03, 0.02])
    assert len(found) == 5
    assert found[-1] == "2 smaller causes (5.0 % of the improvement)"


def test_a_joint_with_dry_friction_is_not_told_beside_one_with_viscous_friction():
    some = VALUES[TWO]
    VALUES[TWO] = some | {"b": Estimate(0.0, 0.01, unit="N m s/rad")}
    found = told([INERTIA, ONE, GAIN, TWO], [0.4, 0.3, 0.2, 0.1])
    VALUES[TWO] = some
    assert len(found) == 4
    assert found[3].startswith("the input t2 loses 0.1 N m to dry friction (")
