"""Gains are compared in all models that explain the trials; doubtful candidates are reported."""

import importlib
from pathlib import Path

import pytest

from grounded.search.first_policy import first_policy
from grounded_trials.workspace.adopted import planner_of


@pytest.mark.slow
def test_a_plan_with_dry_friction_is_followed_from_a_wider_kink(monkeypatch):
    """A cart that sticks has no slope: its plan stops short of the best."""
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[3]))
    task = importlib.import_module("benchmarks.foreign.mechanisms").cart_task("gentle")
    friction = {"name": "joint_friction:force<-x_vel", "c": 0.8, "b": 0.0, "width": 0.005}
    planner = planner_of(task, [friction])
    assert planner.widths == ("joint_friction_force_from_x_vel_width",)
    _, plain = first_policy(planner.plan)
    _, followed = planner.first_policy()
    assert followed.cost < plain.cost - 0.05
