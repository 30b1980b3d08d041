"""All joints of an arm at once: what one effect after the other never finds."""

import numpy as np
import pytest

from grounded.diagnosis.hypotheses import attribution
from grounded.diagnosis.hypotheses.joint_model import joint_model
from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.likelihood.data import prepare
from grounded.effects import Library
from grounded.models.pendulum import model as pendulum
from grounded.trial import Trial
from tests.effects.test_effects_medium import PAIRS, arm, real_trials


@pytest.fixture(autouse=True)
def two_are_many(monkeypatch):
    monkeypatch.setattr("grounded.diagnosis.hypotheses.joint_model.MANY_JOINTS", 2)


pytestmark = pytest.mark.slow

OF_JOINTS = ("joint_friction", "added_inertia", "input_gain", "delay", "first_order_lag")
C, J = (0.25, 0.1), (0.3, 0.03)  # [N m], [kg m^2]


def searched(model, trials):
    data = prepare(model, trials)
    candidates = Library().candidates(model, data.scales)
    few = [e for e in candidates if e.family.name in OF_JOINTS or e.name == "stiction:w2"]
    return HypothesisSearch(data, few, joints=Library().joints(model, data.scales))


def of_all_joints(model, trials):
    """By effect, its values in the likeliest model of all joints; None without one."""
    search = searched(model, trials)
    with np.errstate(all="ignore"):
        search.nulls()
        found = joint_model(search)
    return None if found is None else {e.name: values for e, values in found.hypothesis.pairs}


def test_joints_that_are_as_modelled_are_left_out():
    values = of_all_joints(arm, real_trials(count=2, c=C, J=(J[0], 0.0)))
    inertia, *frictions = f"added_inertia:{PAIRS[0]}", *(f"joint_friction:{p}" for p in PAIRS)
    assert set(values) == {inertia, *frictions}


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
