"""How sure an improvement is, in a sentence."""

import numpy as np
import pytest
from scipy.stats import ttest_ind

from grounded.search.standing import Tried, last_improvement, utility_noise


def tried(*utilities, accepted=True):
    return Tried(candidate=None, trials=(), utilities=utilities, accepted=accepted)


def test_nothing_to_say_before_the_first_improvement():
    assert last_improvement([]) == ""
    assert last_improvement([tried(-5.0)]) == ""
    assert last_improvement([tried(-5.0), tried(-6.0, accepted=False)]) == ""


def test_single_trials_say_nothing_about_noise():
    found = last_improvement([tried(-5.0), tried(-4.0)])
    assert found.startswith("the last gain is 1; every candidate was run once")
    assert "run the best one again" in found


def test_the_probability_is_the_t_tests():
    a, b = (-5.0, -5.4, -4.9), (-4.2, -4.6, -4.5)
    found = last_improvement([tried(*a), tried(*b)])
    p = ttest_ind(b, a, alternative="less").pvalue
    assert found.endswith(f"an improvement with probability {p:.2f}")
    assert utility_noise([tried(*a), tried(*b)])[1] == 4


def test_noise_of_a_repeated_candidate_stands_in_for_the_others():
    history = [tried(-5.0, -5.2), tried(-4.0), tried(-3.9)]
    noise, freedom = utility_noise(history)
    assert (noise, freedom) == (pytest.approx(np.std([-5.0, -5.2], ddof=1)), 1)
    found = last_improvement(history)
    assert "the last gain is 0.1 +- 0.2 (noise of one trial 0.14)" in found


def test_failed_runs_are_left_out_and_trials_that_agree_say_so():
    assert utility_noise([tried(-5.0, -np.inf)])[1] == 0
    found = last_improvement([tried(-5.0, -5.0), tried(-4.0, -4.0)])
    assert found == "the last gain is 1; repeated trials agree exactly"
