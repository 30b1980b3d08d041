"""Steps 6 and 7: alpha = 1 first, then halves, then the end."""

import pytest

from grounded.search.step_size import next_alpha


def test_alpha_is_one_first_then_halved():
    tried = []
    while (alpha := next_alpha(tried, 6)) is not None:
        tried.append(alpha)
    assert tried == [1, 1 / 2, 1 / 4, 1 / 8, 1 / 16, 1 / 32, 1 / 64]


@pytest.mark.parametrize("halvings", [0, 1, 30])
def test_it_ends_after_max_halvings(halvings):
    tried = []
    while (alpha := next_alpha(tried, halvings)) is not None:
        tried.append(alpha)
    assert len(tried) == halvings + 1 and tried[-1] == 2.0**-halvings


def test_the_order_of_trials_does_not_matter():
    assert next_alpha([0.25, 1.0, 0.5], 6) == 0.125
