"""Of very many steps a share is looked at, and which one is said."""

import numpy as np
import pytest

from grounded.share import share_of
from grounded.trial import Trial


def trials(*steps):
    return [
        Trial(np.zeros((T + 1, 1)), np.zeros((T, 1)), 0.1, ("x",), ("u",), id=f"t{i}")
        for i, T in enumerate(steps)
    ]


def test_all_trials_within_the_budget_are_used_as_they_are():
    given = trials(10, 20)
    found = share_of(given, 30)
    assert found.trials == given and found.finding is None


@pytest.mark.parametrize("steps", [[10] * 1000, [1000], [5, 400, 5, 5], [90, 90, 90]])
def test_a_share_stays_within_the_budget_and_says_which_it_is(steps):
    found = share_of(trials(*steps), 100)
    assert 0 < sum(trial.steps for trial in found.trials) <= 100
    assert found.finding is not None and found.finding.facts["total"] == sum(steps)


def test_whole_trials_are_taken_at_equal_distances():
    found = share_of(trials(*[10] * 100), 110)
    numbers = [int(trial.id[1:]) for trial in found.trials]
    assert numbers[0] == 0 and numbers[-1] == 99 and np.ptp(np.diff(numbers)) <= 1
    assert all(trial.steps == 10 for trial in found.trials)


def test_a_share_has_no_more_trials_than_are_asked_for():
    assert len(share_of(trials(*[2] * 50), 1000, 10).trials) == 10
