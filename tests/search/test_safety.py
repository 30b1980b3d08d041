"""Checks before a candidate is handed to a robot."""

from dataclasses import replace

import numpy as np
import pytest

from grounded.search.candidate import Tried
from grounded.search.improve import propose
from grounded.search.safety import MAX_GAIN, coasting, coasts_out, objections, spread
from grounded.search.step_size import SearchOptions
from grounded.trial import Trial
from small_tasks import cart_task


@pytest.fixture(scope="module")
def made():
    return propose(cart_task(), [], [], SearchOptions()).candidate


def test_nothing_speaks_against_a_sound_candidate(made):
    assert not objections(cart_task(), made)


@pytest.mark.parametrize("part", ["feedforward", "gain", "reference"])
def test_a_number_that_is_not_finite(made, part):
    values = np.array(getattr(made.policy, part))
    values[7] = np.nan
    bad = replace(made, policy=replace(made.policy, **{part: values}))
    assert len(objections(cart_task(), bad)) == 1


def test_a_predicted_state_that_is_not_finite(made):
    states = np.array(made.predicted_states)
    states[40, 1] = np.inf
    found = objections(cart_task(), replace(made, predicted_states=states))
    assert len(found) == 1


def test_a_gain_beyond_reason(made):
    gain = np.array(made.policy.gain)
    gain[3, 0, 1] = -2 * MAX_GAIN
    found = objections(cart_task(), replace(made, policy=replace(made.policy, gain=gain)))
    assert len(found) == 1


def test_a_predicted_run_outside_the_safe_region_names_state_time_and_bound():
    low, high = np.array([-np.inf, -np.inf]), np.array([0.9, np.inf])
    task = cart_task(safety_low=low, safety_high=high)
    proposal = propose(task, [], [], SearchOptions())
    assert proposal.candidate is None and proposal.standing.phase == "stopped"
    assert proposal.findings == proposal.standing.findings
    assert [one.code for one in proposal.findings] == ["plan.outside"]


@pytest.mark.parametrize(("base", "off"), [("c0001", (0.0,)), ("c0001", (1.4,)), ("", (0.0, 1.4))])
def test_runs_that_strayed_widen_a_predicted_run(made, base, off):
    task = cart_task(safety_low=np.full(2, -1.4), safety_high=np.full(2, 1.4))
    names = task.model.state_names, task.model.input_names
    runs = tuple(
        Trial(made.predicted_states + np.array([x, 0.0]), made.predicted_inputs, task.dt, *names)
        for x in off
    )
    tried = Tried(replace(made, base=base, way=""), runs, (-1.0,) * len(runs), True)
    against = objections(task, made, spread(task, [tried], made.model))
    assert [one.code for one in against] == ["plan.outside"] * any(off)


def test_who_coasts_out_of_safety_after_a_run_is_found(made):
    task, run = cart_task(latency=np.array([0.1])), made.predicted_run
    states = np.array(run.states)
    states[-1] = 1.0, 2.0
    run = replace(run, states=states)
    moved = coasting(task, run, np.zeros(1))
    assert (moved[0] == states[-1]).all()
    assert np.all(np.diff(moved[:, 0]) > 0)  # it keeps rolling
    pushed = coasting(cart_task(), run, np.zeros(1))
    assert run.inputs[-1] != 0 and moved[2, 1] != pushed[2, 1]  # commands under way still arrive
    bound = np.array([moved[10, 0], np.inf])
    tight = cart_task(safety_low=-np.full(2, np.inf), safety_high=bound)
    assert coasts_out(tight, task, run, np.zeros(1)) is not None
    wide = cart_task(safety_low=-np.full(2, np.inf), safety_high=np.array([99.0, np.inf]))
    assert coasts_out(wide, task, run, np.zeros(1)) is None
    assert coasts_out(cart_task(), task, run, np.zeros(1)) is None
