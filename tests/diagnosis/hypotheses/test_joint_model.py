"""All joints of an arm at once: what one effect after the other never finds."""

from dataclasses import replace

import numpy as np
import pytest

from grounded.diagnosis.hypotheses import attribution
from grounded.diagnosis.hypotheses.joint_model import joint_model
from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.hypotheses.variations import varied
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.effects import Library
from grounded.models.pendulum import model as pendulum
from grounded.trial import Trial
from tests.effects.test_effects_joint import DT, PAIRS, arm, real_trials


@pytest.fixture(autouse=True)
def two_are_many(monkeypatch):
    monkeypatch.setattr("grounded.diagnosis.hypotheses.joint_model.MANY", 2)


pytestmark = pytest.mark.slow

OF_JOINTS = ("joint_friction", "added_inertia", "input_gain", "delay", "first_order_lag")
C, J = (0.25, 0.1), (0.3, 0.03)  # [N m], [kg m^2]


def searched(model, trials):
    data = prepare(model, trials)
    candidates = Library().candidates(model, data.scales)
    few = [e for e in candidates if e.family.name in OF_JOINTS or e.name == "stiction:w2"]
    return HypothesisSearch(data, few, joints=Library().joints(model, data.scales))


def of_all_joints(model, trials, alone=False):
    """By effect, its values in the likeliest model of all joints; None without one."""
    search = searched(model, trials)
    with np.errstate(all="ignore"):
        search.nulls()
        if alone:
            search.extended(search.best_null())
        found = joint_model(search)
    return None if found is None else {e.name: values for e, values in found.hypothesis.pairs}


def test_friction_and_inertia_of_every_joint_are_found_at_once():
    values = of_all_joints(arm, real_trials(count=2, c=C, J=J))
    for pair, dry, more in zip(PAIRS, C, J, strict=True):
        assert values[f"joint_friction:{pair}"]["c"] == pytest.approx(dry, rel=0.1)
        assert values[f"added_inertia:{pair}"]["J"] == pytest.approx(more, rel=0.1)
    assert len(values) == 4


def test_joints_that_are_as_modelled_are_left_out():
    values = of_all_joints(arm, real_trials(count=2, c=C, J=(J[0], 0.0)))
    inertia, *frictions = f"added_inertia:{PAIRS[0]}", *(f"joint_friction:{p}" for p in PAIRS)
    assert set(values) == {inertia, *frictions}


def test_what_few_effects_explain_is_left_to_a_search_that_adds_them():
    trials = real_trials(c=(0.0, 0.1))
    assert of_all_joints(arm, trials) is None
    assert of_all_joints(arm, trials, alone=True) is None


def test_one_delay_of_all_motors_takes_the_place_of_one_each():
    late = late_by_a_step()
    search = searched(arm, late)
    with np.errstate(all="ignore"):
        each = search.fresh(Hypothesis())
        for name, size in (("delay:t1", 0.01), ("first_order_lag:t2", 0.01)):
            effect = Library().effect(name, arm, search.data.scales)
            each = search.fresh(each[0].plus(effect, {effect.free[0].name: size}))
        (fit,) = search.refined([each], 12)
        search.refined([search.fresh(Hypothesis())], 1)
        found = varied(search, fit)
    assert found.hypothesis.names in (("delay:t1+t2",), ("first_order_lag:t1+t2",))


def late_by_a_step():
    return [
        replace(trial, inputs=np.vstack([trial.inputs[1:], trial.inputs[-1:]])).until(
            trial.known_steps - 1
        )
        for trial in real_trials(count=2, c=C, J=J)
    ]


def test_what_all_motors_share_is_found_beside_the_joints():
    values = of_all_joints(arm, late_by_a_step())
    late = {"delay:t1+t2", "first_order_lag:t1+t2"} & set(values)  # smooth commands can't tell
    assert len(late) == 1 and len(values) == 5
    assert list(values[late.pop()].values()) == pytest.approx([DT], rel=0.1)


def test_two_joints_of_a_quick_model_need_no_such_start(monkeypatch):
    monkeypatch.undo()
    assert of_all_joints(arm, real_trials(count=1, c=C, J=J)) is None


def test_a_single_joint_has_no_such_start():
    trial = Trial(
        np.zeros((41, 2)),
        np.random.default_rng(0).standard_normal((40, 1)),
        0.05,
        pendulum.state_names,
        pendulum.input_names,
    )
    assert of_all_joints(pendulum, [trial]) is None


def test_a_search_grows_from_all_joints_where_no_effect_alone_is_nearly_as_likely(monkeypatch):
    data = prepare(arm, real_trials(count=2, c=C, J=J))
    offered = Library().candidates(arm, data.scales)
    candidates = [e for e in offered if e.family.name in OF_JOINTS]
    joints = Library().joints(arm, data.scales)
    asked = []

    def spied(search):
        asked.append(search)
        return joint_model(search)

    monkeypatch.setattr(attribution, "joint_model", spied)
    _, best = attribution.attribute(data, candidates, joints=joints)
    assert asked and len(best.hypothesis.effects) == 4
    asked.clear()
    _, best = attribution.attribute(data, candidates, joints=joints, max_effects=1)
    assert not asked and len(best.hypothesis.effects) == 1
