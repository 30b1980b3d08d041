"""Gains on measured states alone, of gains on all that a model with memory feeds back."""

import numpy as np
import pytest

from grounded.compile.run.interpreted import linearised
from grounded.model import Model, Param
from grounded.rollout import simulate
from grounded.search.first_policy import first_policy
from grounded.solve.measured import measured_gains
from grounded_trials.workspace.adopted import planner_of
from small_tasks import plain_task


def roll(s, a, p):
    return {"q": s.w, "w": a.moment / p.inertia}


@pytest.fixture(scope="module")
def lagging():
    """A body turned by a moment that lags by 80 ms, with inputs that cost next to nothing."""
    model = Model(
        states={"q": "rad", "w": "rad/s"},
        inputs={"moment": "N m"},
        params={"inertia": Param(0.01, "kg m^2")},
        derivative=roll,
    )
    target, ends = np.tile([1.0, 0.0], (81, 1)), [100.0, 1.0]
    task = plain_task(model, 0.02, target, [10.0, 0.0], 20.0, terminal=ends, effort=1e-4)
    return planner_of(task, [{"name": "first_order_lag:moment", "tau": 0.08}])


def disturbed(problem, run, K, measured=2):
    """How large disturbances of the measured states have grown by the end of the loop."""
    q, noise = linearised(problem.system, problem, run.z, run.inputs), np.zeros(problem.nz)
    noise[:measured] = 1e-4
    S = np.diag(noise)
    for t in range(len(K)):
        loop = q.A[t] + q.B[t] @ K[t]
        S = loop @ S @ loop.T + np.diag(noise)
    return float(np.sqrt(np.trace(S[:measured, :measured])))


def test_a_loop_without_the_lags_output_stays_stable(lagging):
    problem = lagging.plan.problem()
    policy, found = first_policy(lagging.plan)
    run = simulate(problem, policy)
    known = np.arange(problem.nz) != 2
    K = measured_gains(problem, found.z, found.u, found.K, 2)
    assert not K[:, :, 2].any() and found.K[:, :, 2].any()
    full, dropped = (disturbed(problem, run, k) for k in (found.K, np.where(known, found.K, 0.0)))
    made = disturbed(problem, run, K)
    assert dropped > 1e3 * full and made < 4 * full


def test_the_planner_hands_over_such_gains(lagging):
    policy, found = lagging.first_policy()
    narrow = lagging.narrowed(policy)
    assert not policy.gain[:, :, 2].any()
    np.testing.assert_array_equal(narrow.gain[:, :, :2], policy.gain[:, :, :2])
    np.testing.assert_array_equal(policy.feedforward, found.u)


def test_nothing_changes_where_everything_is_measured(lagging):
    problem = lagging.plan.problem()
    _, found = first_policy(lagging.plan)
    K = measured_gains(problem, found.z, found.u, found.K, problem.system.n)
    np.testing.assert_array_equal(K, found.K)


def test_a_clamped_input_keeps_no_gain(lagging):
    problem = lagging.plan.problem()
    _, found = first_policy(lagging.plan)
    clamped = found.K.copy()
    clamped[3:6] = 0.0
    K = measured_gains(problem, found.z, found.u, clamped, 2)
    assert not K[3:6].any() and K[10].any()
