"""With a delayed speed sensor, the robot is at rest at the end of a plan, not just its log."""

import numpy as np

from grounded.model import Model
from grounded.search.planner import Planner, planner_with, predicted
from small_tasks import plain_task

STEPS = 60


def cart(terminal: float, lag: float = 0.04, change: float = 1e-4, rests: int = 10) -> Planner:
    """A cart that moves 0.4 m in 1.2 s; its speed sensor has a filter."""
    model = Model(
        states={"x": "m", "v": "m/s"},
        inputs={"force": "N"},
        params={},
        derivative=lambda s, a, p: {"x": s.v, "v": 2.0 * a.force - 0.5 * s.v},
    )
    way = np.clip(np.arange(STEPS + 1) / (STEPS - rests), 0.0, 1.0)
    x = 0.4 * way**2 * (3 - 2 * way)
    target, ends = np.column_stack([x, np.gradient(x, 0.02)]), terminal * np.array([500.0, 50.0])
    task = plain_task(model, 0.02, target, [10.0, 0.5], 10.0, terminal=ends, change=change)
    return planner_with(task, [("sensor_lag:v", {"tau": lag})] if lag else [])


def test_the_end_is_asked_of_the_true_speed(terminal=1.0):
    planner = cart(terminal)
    policy, _ = planner.first_policy()
    run = predicted(planner.plan.problem(exact=True), policy)
    true = run.states[-1, planner.plan.model.state_names.index("v_true")]
    assert abs(true) < 0.02 and abs(run.states[-1, 0] - 0.4) < 0.005
    assert np.abs(run.inputs[-3:]).max() < 0.5 * np.abs(run.inputs).max()
