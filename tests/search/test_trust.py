"""The step rule: an accurate prediction enlarges the step, an inaccurate one reduces it."""

import pytest

from grounded.search.step_size import (
    LARGEST_DAMPING,
    SMALLEST_DAMPING,
    Step,
    after_failure,
    after_success,
)


def test_a_kept_promise_lowers_the_damping_and_a_broken_one_raises_it():
    assert after_success(Step(0.9), 100.0, 95.0) == Step(pytest.approx(0.03))
    assert after_success(Step(0.1), 100.0, 60.0) == Step(0.1)
    assert after_success(Step(0.1), 100.0, 10.0) == Step(1.0)
    assert after_success(Step(1.0), 100.0, 10.0) == Step(10.0)
    assert after_success(Step(LARGEST_DAMPING), 100.0, 10.0) == Step(LARGEST_DAMPING)
    assert after_success(Step(SMALLEST_DAMPING), 100.0, 100.0) == Step(SMALLEST_DAMPING)


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
        (LARGEST_DAMPING, 1.0),
        (LARGEST_DAMPING, 0.5),
        (LARGEST_DAMPING, 0.25),
    ]
