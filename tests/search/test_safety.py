"""What must hold before a candidate is handed to a robot."""

from dataclasses import replace

import numpy as np
import pytest

from grounded.search.improve import propose
from grounded.search.safety import MAX_GAIN, objections
from grounded.search.standing import SearchOptions
from small_tasks import cart_task


@pytest.fixture(scope="module")
def made():
    return propose(cart_task(), [], [], SearchOptions()).candidate


def test_nothing_speaks_against_a_sound_candidate(made):
    assert objections(cart_task(), made) == []


@pytest.mark.parametrize("part", ["feedforward", "gain", "reference"])
def test_a_number_that_is_not_finite(made, part):
    values = np.array(getattr(made.policy, part))
    values[7] = np.nan
    bad = replace(made, policy=replace(made.policy, **{part: values}))
    name = "feed-forward" if part == "feedforward" else part
    assert objections(cart_task(), bad) == [
        f"the {name} of c0001 is not a finite number at t = 0.35 s (step 7): the model diverges "
        "there; check it with a shorter horizon"
    ]


def test_a_predicted_state_that_is_not_finite(made):
    states = np.array(made.predicted_states)
    states[40, 1] = np.inf
    found = objections(cart_task(), replace(made, predicted_states=states))
    assert len(found) == 1 and found[0].startswith("the predicted state of c0001 is not a finite")


def test_a_gain_beyond_reason(made):
    gain = np.array(made.policy.gain)
    gain[3, 0, 1] = -2 * MAX_GAIN
    found = objections(cart_task(), replace(made, policy=replace(made.policy, gain=gain)))
    assert found == [
        "a gain of c0001 reaches 2e+06 at t = 0.15 s, more than 1e+06: raise the input weights"
    ]


def test_a_predicted_run_outside_the_safe_region_names_state_time_and_bound():
    low, high = np.array([-np.inf, -np.inf]), np.array([0.9, np.inf])
    task = cart_task(safety_low=low, safety_high=high)
    proposal = propose(task, [], [], SearchOptions())
    assert proposal.candidate is None and proposal.standing.phase == "stopped"
    (note,) = proposal.notes
    assert note == proposal.standing.sentence
    assert note.startswith("c0001 (alpha = 1) is predicted to take x to ")
    assert note.endswith("outside [safety] x = [-inf, 0.9]") and " m at t = " in note


def test_a_bound_that_is_just_kept_is_no_objection(made):
    top = float(made.predicted_states[:, 0].max())
    low = np.full(2, -np.inf)
    kept = cart_task(safety_low=low, safety_high=np.array([top, np.inf]))
    assert objections(kept, made) == []
    crossed = cart_task(safety_low=low, safety_high=np.array([np.nextafter(top, 0), np.inf]))
    assert len(objections(crossed, made)) == 1
