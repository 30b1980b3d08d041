"""Trials: arrays of matching shapes; lost samples; a share of very many."""

import numpy as np
import pytest

from grounded.errors import GroundedError
from grounded.frozen import readonly
from grounded.share import share_of
from grounded.trial import Trial, interpolate_gaps


def trial(T=5, **changes):
    fields = {
        "states": np.arange(2.0 * (T + 1)).reshape(T + 1, 2),
        "inputs": np.zeros((T, 1)),
        "dt": 0.1,
        "state_names": ("x", "v"),
        "input_names": ("u",),
    }
    return Trial(**fields | changes)


WRONG = {  # a field, and what it may not be
    "states": [np.zeros((6, 3)), np.zeros(6), None, np.zeros((2, 6)), [[0.0, 0.0], [1.0]]],
    "inputs": [np.zeros((6, 1)), np.zeros((5, 2)), np.zeros(5), np.zeros((1, 5))],
    "start_inputs": [0.0, np.zeros(2)],
    "input_names": ["u"],
    "dt": [0.0, "0.1"],
}


@pytest.mark.parametrize("name", WRONG)
def test_arrays_must_fit(name):
    for value in WRONG[name]:
        with pytest.raises(GroundedError, match=name):
            trial(**{name: value})


def test_names_in_a_list_are_as_good():
    assert trial(state_names=["x", "v"]).state_names == ("x", "v")


def test_a_trial_is_a_copy_that_stays():
    states = np.zeros((6, 2))
    made = trial(states=states)
    states[:] = 7.0
    assert made.states.max() == 0.0
    with pytest.raises(ValueError, match="read-only"):
        made.states[0, 0] = 1.0
    assert readonly(made.states) is made.states


@pytest.mark.parametrize("T", [0, 1, 5])
def test_steps(T):
    made = trial(T)
    assert made.steps == T and made.finite_steps == T


def test_a_recording_that_stops_a_step_or_two_early_goes_on():
    states = np.column_stack([0.1 * np.arange(41.0), np.ones(41)])
    run = trial(40, states=states, inputs=np.linspace(0, 1, 40)[:, None])
    short = run.until(38).whole(40)
    np.testing.assert_allclose(short.states, run.states)
    assert short.inputs[-2:, 0] == pytest.approx([run.inputs[37, 0]] * 2)
    assert run.until(37).whole(40).steps == 37  # three steps short: it ended early
    assert run.whole(38).steps == 38 and trial(5).whole(6).steps == 5
    lost = np.where(np.arange(39)[:, None] == 38, np.nan, states[:39])
    assert trial(38, states=lost).whole(40).steps == 38


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1e200])
def test_finite_steps_end_before_the_first_bad_number(bad):
    for k in range(6):
        states = np.zeros((6, 2))
        states[k, 1] = bad
        assert trial(states=states).finite_steps == k - 1  # s_{k-1} is the last state known
    for k in range(5):
        inputs = np.zeros((5, 1))
        inputs[k] = bad
        assert trial(inputs=inputs).finite_steps == k  # s_k is known, and what led to it


def test_a_trial_is_shown_in_one_short_line():
    long = Trial(np.zeros((501, 2)), np.zeros((500, 1)), 0.02, ("q", "w"), ("u",), id="t0007")
    shown = repr(long)
    assert "\n" not in shown
    assert len(shown) < 100
    assert all(part in shown for part in ("t0007", "500", "0.02", "q, w"))


def gappy(gaps=(), T=60, dt=0.05):
    t = dt * np.arange(T + 1)
    states = np.column_stack([t, np.sin(t)])
    for first, last, column in gaps:
        states[first:last, column] = np.nan
    return Trial(states, np.zeros((T, 1)), dt, ("x", "v"), ("u",))


def test_short_gaps_are_straight_lines():
    found = interpolate_gaps(gappy([(5, 9, 0), (30, 40, 1)]))
    np.testing.assert_allclose(found.trial.states[:, 0], gappy().states[:, 0], atol=1e-12)
    assert np.abs(found.trial.states[:, 1] - gappy().states[:, 1]).max() < 0.05
    assert (found.samples, found.state) == (14, "v")
    assert found.longest_s == pytest.approx(0.5) and found.at_s == pytest.approx(1.5)


@pytest.mark.parametrize(("length", "whole"), [(20, True), (21, False)])
def test_a_gap_of_a_second_is_the_longest(length, whole):
    found = interpolate_gaps(gappy([(10, 10 + length, 0)]))
    assert np.isfinite(found.trial.states).all() == whole
    assert found.trial.finite_steps == (60 if whole else 9)


def test_a_gap_that_reaches_the_end_stays():
    found = interpolate_gaps(gappy([(56, 61, 1)]))
    assert found.samples == 0 and found.trial.finite_steps == 55


def test_the_first_state_must_be_known():
    found = interpolate_gaps(gappy([(0, 2, 0), (10, 12, 1)]))
    assert found.samples == 0 and found.trial.finite_steps == -1


def test_inputs_are_never_invented():
    whole = gappy([(5, 6, 0)])
    inputs = np.array(whole.inputs)
    inputs[20] = np.nan
    found = interpolate_gaps(Trial(whole.states, inputs, 0.05, ("x", "v"), ("u",)))
    assert found.samples == 1 and found.trial.finite_steps == 20


def many(*steps):
    return [
        Trial(np.zeros((T + 1, 1)), np.zeros((T, 1)), 0.1, ("x",), ("u",), id=f"t{i}")
        for i, T in enumerate(steps)
    ]


def test_all_trials_within_the_budget_are_used_as_they_are():
    given = many(10, 20)
    found = share_of(given, 30)
    assert found.trials == given and found.finding is None


@pytest.mark.parametrize("steps", [[10] * 1000, [1000], [5, 400, 5, 5], [90, 90, 90]])
def test_a_share_stays_within_the_budget_and_says_which_it_is(steps):
    found = share_of(many(*steps), 100)
    assert 0 < sum(trial.steps for trial in found.trials) <= 100
    assert found.finding is not None and found.finding.facts["total"] == sum(steps)


def test_whole_trials_are_taken_at_equal_distances():
    found = share_of(many(*[10] * 100), 110)
    numbers = [int(trial.id[1:]) for trial in found.trials]
    assert numbers[0] == 0 and numbers[-1] == 99 and np.ptp(np.diff(numbers)) <= 1
    assert all(trial.steps == 10 for trial in found.trials)


def test_a_share_has_no_more_trials_than_are_asked_for():
    assert len(share_of(many(*[2] * 50), 1000, 10).trials) == 10
