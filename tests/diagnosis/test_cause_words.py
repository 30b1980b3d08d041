"""Many causes in words: those of one kind together, each with its values."""

from dataclasses import replace

import pytest

from facts import holds
from grounded.diagnosis.cause_words import (
    DISAGREE,
    all_called,
    at_middle,
    called,
    clauses,
    counted,
    disagreement,
    meaning,
    other_unit,
)
from grounded.diagnosis.error_report import Credit
from grounded.diagnosis.report import Agreement, Estimate, TrialValue
from grounded.diagnosis.verdict import _apart
from grounded.effects import Library
from grounded.model import Model
from grounded.models.car import model as car
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
    credit = [Credit(n, share, times=4.0**share) for n, share in zip(names, shares, strict=True)]
    return clauses(names, causes, credit, effects, VALUES)


def test_the_friction_of_all_joints_is_told_together():
    found = told([INERTIA, ONE, GAIN, TWO], [0.4, 0.3, 0.2, 0.1])
    assert len(found) == 3
    friction = next(text for text in found if "dry friction" in text)
    assert friction.startswith("the input t1 loses 0.3 N m to dry friction and 0.2 N m s/rad")
    assert friction.endswith(
        ", the input t2 0.1 N m and 0.05 N m s/rad (errors are 52 % larger without the first and "
        "15 % larger without the second)"
    )
    assert "12 % weaker" in found[2]  # a percentage with its direction stands alone


def test_three_causes_are_told_one_by_one_and_one_without_a_share():
    found = told([ONE, TWO, GAIN], [0.5, 0.3, 0.2])
    assert len(found) == 3 and found[1].endswith("(without this, errors are 52 % larger)")
    assert told([GAIN], [1.0]) == ("the input t1 acts 12 % weaker than modelled",)


def test_volts_are_said_to_be_counted_before_or_after_a_gain_of_their_input():
    known = {name: Library().effect(name, arm) for name in (ONE, TWO, GAIN, BIAS, INERTIA)}
    zone, late = (Library().effect(name, arm) for name in ("dead_zone:t1", "delay:t1"))
    gain, friction = known[GAIN], known[ONE]
    assert "after" in counted(friction, [friction, gain])  # a joint is behind all of its input
    assert "before" in counted(zone, [zone, friction, gain, late])
    assert "after" in counted(zone, [gain, zone])
    fade = Library().effect("input_fade:t1", arm)
    assert holds(counted(zone, [gain, zone, fade]), "between")
    for without in (friction, zone):
        assert not counted(without, [friction, zone, known[BIAS]])
    assert not any(counted(one, [gain, one]) for one in (known[TWO], late, known[BIAS], fade))


def test_a_gain_beside_a_curve_of_its_input_says_at_which_command():
    gain, other = (Library().effect(name, arm) for name in (GAIN, "input_gain:t2"))
    curve = Library().effect("input_curve:t1", arm)
    peak = next(q.start for q in curve.quantities if q.name == "U")
    values = {curve.name: {"a": Estimate(0.0, 0.0, unit="1"), "b": Estimate(-0.4, 0.02, unit="1")}}
    said = at_middle(gain, [gain, curve], values)
    assert holds(said, f"{peak / 2:g} N m", "half way between zero and its largest command")
    assert not at_middle(other, [other, curve], values)
    assert not at_middle(gain, [gain], values)
    both, of_both = (
        Library().effect(f"{kind}:t1+t2", arm) for kind in ("input_gain", "input_curve")
    )
    values[of_both.name] = values[curve.name]
    assert at_middle(both, [both, of_both], values) and at_middle(gain, [gain, of_both], values)
    only_sides = {curve.name: {"a": Estimate(0.1, 0.01, unit="1"), "b": Estimate(0.01, 0.02)}}
    assert not at_middle(gain, [gain, curve], only_sides)


def test_the_smallest_of_many_are_told_in_words_with_their_values():
    late = "delay:t1+t2"
    names = [INERTIA, ONE, "calibration", GAIN, BIAS, late, "dead_zone:t2"]
    VALUES["dead_zone:t2"] = {"c": Estimate(0.255, 0.02, unit="N m")}
    VALUES[late] = {"d": Estimate(0.06, 0.001, unit="s")}
    found = told(names, [0.4, 0.2, 0.15, 0.1, 0.08, 0.05, 0.02])
    assert len(found) == len(names) and not any(name in " ".join(found) for name in VALUES)
    assert holds(found[-1], "0.255 N m") and holds(found[-2], "0.06 s")
    assert all("(without this, " in clause for clause in found)


def test_a_limited_rate_of_a_commanded_speed_is_no_motion():
    """A robot's verdict: `The speed can't move faster than 0.7 m/s/s`."""
    limit = Library().effect("rate_limit:throttle", car)
    assert meaning(limit, {"r": Estimate(0.7, 0.01, unit="1/s")}) == (
        "the throttle can't change faster than 0.7 1/s"
    )


def test_a_joint_with_dry_friction_is_not_told_beside_one_with_viscous_friction():
    some = VALUES[TWO]
    VALUES[TWO] = some | {"b": Estimate(0.0, 0.01, unit="N m s/rad")}
    found = told([INERTIA, ONE, GAIN, TWO], [0.4, 0.3, 0.2, 0.1])
    VALUES[TWO] = some
    assert len(found) == 4
    assert found[3].startswith("the input t2 loses 0.1 N m to dry friction (")


def test_a_lever_arm_has_directions_and_no_component_that_may_be_zero():
    arm_of = Library().effect("lever_arm:x+y", car)

    def said(a, b):
        known = {"a": Estimate(a, 0.002, unit="m"), "b": Estimate(b, 0.002, unit="m")}
        return meaning(arm_of, known)

    assert holds(said(-0.0128, 0.0001), "0.0128 m further back than")
    assert "left" not in said(-0.0128, 0.003) and "-" not in said(-0.0128, 0.003)
    assert holds(said(0.0128, -0.02), "0.0128 m further ahead", "0.02 m further to the right")
    assert "ahead" not in said(0.0001, 0.02) and "0.02 m further to the left" in said(0.0001, 0.02)


def test_an_input_whose_name_is_no_noun_gets_one():
    wheels = Model(
        states={"v": "m/s"},
        inputs={"left": "1", "right": "1"},
        derivative=lambda s, a, p: {"v": a.left + a.right - s.v},
    )
    assert called(wheels, "left") == "the input left"
    assert all_called(wheels, ("left", "right")) == "the inputs left and right"
    assert all_called(car, ("steering", "throttle")) == "the steering and the throttle"


def test_a_clause_says_on_which_value_the_trials_disagree():
    values = [
        TrialValue("t1", BIAS, "b", -0.0149, 0.001),
        TrialValue("t2", BIAS, "b", -0.0038, 0.0008),
        TrialValue("t3", BIAS, "b", 0.9, 50.0),  # a trial that hardly determines it
    ]
    tests = [Agreement(BIAS, "b", False, 0.0, Estimate(-0.01, unit="rad"))]
    told = _apart(values, tests)
    assert list(told) == [BIAS] and told[BIAS] == disagreement(values, "rad")
    assert holds(told[BIAS], DISAGREE, "b = -0.0149 rad to -0.0038 rad")
    assert not _apart(values, [replace(tests[0], agrees=True)])
    times = [
        TrialValue("t1", "delay:u", "d", 9.6e-5, 1e-5),
        TrialValue("t2", "delay:u", "d", 3e-4, 1e-5),
    ]
    assert disagreement(times, "s") == f"{DISAGREE}: d = 0.096 ms to 0.30 ms"


def test_a_cause_on_which_trials_disagree_stands_alone():
    effects = {n: Library().effect(n, arm) for n in (INERTIA, ONE, GAIN, TWO)}
    causes = [meaning(effects[n], VALUES[n]) for n in effects]
    causes[1] += f", {DISAGREE}: c = 0.1 to 0.4"
    assert (
        len(clauses([*effects], causes, [Credit(n, 0.25) for n in effects], effects, VALUES)) == 4
    )


@pytest.mark.parametrize(
    ("g", "said"),
    [
        (-0.908, "about 1/10"),
        (8.6, "about 10"),
        (-0.99, "1/100"),
        (-0.8, ""),
        (0.3, ""),
        (-1.9, ""),
    ],
)
def test_a_gain_of_a_power_of_ten_asks_for_the_unit_of_the_log(g, said):
    told = other_unit("input_gain:thrust", {"g": Estimate(g, 0.01)})
    assert (said in told and "unit" in told) if said else told == ""
    assert other_unit("delay:thrust", {"d": Estimate(g, 0.01)}) == ""
