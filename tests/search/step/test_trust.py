"""The step rule: an accurate prediction enlarges the step, an inaccurate one reduces it."""

import pytest

from grounded.search.step.step_size import LEAST, MOST, Step, after_failure, after_success


def test_a_kept_promise_lowers_the_damping_and_a_broken_one_raises_it():
    assert after_success(Step(0.9), 100.0, 95.0) == Step(pytest.approx(0.03))
    assert after_success(Step(0.1), 100.0, 60.0) == Step(0.1)
    assert after_success(Step(0.1), 100.0, 10.0) == Step(1.0)
    assert after_success(Step(1.0), 100.0, 10.0) == Step(10.0)
    assert after_success(Step(MOST), 100.0, 10.0) == Step(MOST)
    assert after_success(Step(LEAST), 100.0, 100.0) == Step(LEAST)


def test_failures_damp_first_and_halve_then():
    step, seen = Step(0.1), []
    while step is not None:
        seen.append((step.damping, step.alpha))
        step = after_failure(step, max_halvings=2)
    assert seen == [
        (0.1, 1.0),
        (1.0, 1.0),
        (10.0, 1.0),
        (100.0, 1.0),
        (MOST, 1.0),
        (MOST, 0.5),
        (MOST, 0.25),
    ]
