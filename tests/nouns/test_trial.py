"""Trial: arrays of matching shapes, read-only, and finite up to a known step."""

import numpy as np
import pytest

from grounded.errors import GroundedError
from grounded.frozen import readonly
from grounded.trial import Trial


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
