"""Lost samples: short gaps are interpolated, long ones end the trial, inputs never are."""

import numpy as np
import pytest

from grounded.trial import Trial, interpolate_gaps


def trial(gaps=(), T=60, dt=0.05):
    t = dt * np.arange(T + 1)
    states = np.column_stack([t, np.sin(t)])
    for first, last, column in gaps:
        states[first:last, column] = np.nan
    return Trial(states, np.zeros((T, 1)), dt, ("x", "v"), ("u",))


def test_short_gaps_are_straight_lines():
    found = interpolate_gaps(trial([(5, 9, 0), (30, 40, 1)]))
    np.testing.assert_allclose(found.trial.states[:, 0], trial().states[:, 0], atol=1e-12)
    assert np.abs(found.trial.states[:, 1] - trial().states[:, 1]).max() < 0.05
    assert (found.samples, found.state) == (14, "v")
    assert found.longest_s == pytest.approx(0.5) and found.at_s == pytest.approx(1.5)


@pytest.mark.parametrize(("length", "whole"), [(20, True), (21, False)])
def test_a_gap_of_a_second_is_the_longest(length, whole):
    found = interpolate_gaps(trial([(10, 10 + length, 0)]))
    assert np.isfinite(found.trial.states).all() == whole
    assert found.trial.finite_steps == (60 if whole else 9)


def test_a_gap_that_reaches_the_end_stays():
    found = interpolate_gaps(trial([(56, 61, 1)]))
    assert found.samples == 0 and found.trial.finite_steps == 55


def test_the_first_state_must_be_known():
    found = interpolate_gaps(trial([(0, 2, 0), (10, 12, 1)]))
    assert found.samples == 0 and found.trial.finite_steps == -1


def test_inputs_are_never_invented():
    whole = trial([(5, 6, 0)])
    inputs = np.array(whole.inputs)
    inputs[20] = np.nan
    found = interpolate_gaps(Trial(whole.states, inputs, 0.05, ("x", "v"), ("u",)))
    assert found.samples == 1 and found.trial.finite_steps == 20
