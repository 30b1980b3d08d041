"""The sentence on the certainty of an improvement, and the verdicts on candidates."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import t, ttest_ind

from grounded.search.candidate import Tried
from grounded.search.certainty import with_chances
from grounded.search.difference import Difference, beyond_one_trial, student
from grounded.trial import Trial


def tried(*utilities, accepted=True, base="c0001"):
    nothing = {"expected_of_base": np.nan, "base_as_run": np.nan}
    candidate = SimpleNamespace(id="c", base=base, model="m", way="", **nothing)
    return Tried(candidate=candidate, trials=(), utilities=utilities, accepted=accepted)


def test_the_probability_is_the_t_tests():
    a, b = (-5.0, -5.4, -4.9), (-4.2, -4.6, -4.5)
    history = [tried(*a), tried(*b)]
    assert Difference(*history, history).probability == pytest.approx(
        1 - ttest_ind(a, b, alternative="less").pvalue
    )
    assert Difference(*history, history).freedom == 4


@pytest.mark.parametrize("freedom", [1.0, 1.7, 4.0, 30.5, 7500.0])
@pytest.mark.parametrize("x", [-1e6, -2.5, -0.3, 0.0, 0.01, 1.0, 4.0])
def test_student_s_t_is_scipy_s(x, freedom):
    assert student(x, freedom) == pytest.approx(t.cdf(x, freedom), abs=2e-5)


def promising(gain, utilities=(-1.2, -1.0), deviation=0.1, doubtful=False):
    best = replace(tried(*utilities), deviation=deviation)
    made = SimpleNamespace(id="c2", base="c", promised_over=lambda _: gain, doubtful=doubtful)
    return made, best


@pytest.mark.parametrize("deviation", [np.nan, 0.0])
def test_nothing_is_below_a_noise_that_is_unknown_or_absent(deviation):
    assert beyond_one_trial(*promising(0.05, deviation=deviation)) is None


def test_more_repeats_of_each_candidate_show_smaller_gains():
    made, best = promising(0.1, utilities=(-1.0,) * 9)
    assert beyond_one_trial(made, best) and not beyond_one_trial(made, best, repeats=9)


def test_failed_runs_are_left_out_and_trials_that_agree_say_so():
    failed = tried(-5.0, -np.inf)
    assert not Difference(tried(-5.0), tried(-4.0), [failed]).known


def test_exact_repeats_show_at_any_utility_that_nothing_scatters():
    first, a, b = tried(-9000.1, -9000.1, -9000.1, base=""), tried(-5.0), tried(-4.0)
    assert Difference(a, b, [first, a, b]).probability == 1.0
    noisy = tried(-9000.1, -9000.2, base="")
    assert not Difference(a, b, [noisy, a, b]).known


@pytest.mark.parametrize(
    ("accepted", "base", "doubt", "trials", "last", "word"),
    [
        (True, "", False, 1, True, "first"),
        (True, "c0001", False, 1, False, "better"),
        (False, "c0001", False, 1, False, "no better"),
        (False, "", False, 1, False, "no better"),
        (None, "c0001", True, 1, True, "in doubt"),
        (None, "c0001", False, 0, True, "waiting"),
        (None, "c0001", False, 1, False, "waiting"),
        (None, "c0001", False, 0, False, "no trial"),
    ],
)
def test_a_verdict_is_one_of_a_few_words(accepted, base, doubt, trials, last, word):
    nothing = {"expected_of_base": np.nan, "base_as_run": np.nan}
    candidate = SimpleNamespace(id="c", base=base, model="m", **nothing)
    tried = Tried(candidate, (None,) * trials, (), accepted, in_doubt=doubt)
    assert tried.verdict(last) == word


@pytest.mark.parametrize(
    ("utility", "repeats", "word"),
    [
        (-3.9, (-4.0, -4.2, -3.8), "maybe better"),  # within the scatter of later repeats
        (-2.0, (-4.0, -4.2, -3.8), "better"),
        (-3.9, (-4.0,), "maybe better"),  # nothing was repeated: the noise is unknown
        (-1.1, (-4.0,), "better"),  # but no run scatters as much
        (-3.9, (-4.0, -4.0, -4.0), "better"),  # a system that repeats itself exactly
    ],
)
def test_a_run_within_the_scatter_of_repeats_is_not_called_better(utility, repeats, word):
    history = with_chances([tried(-90.0, base=""), tried(*repeats), tried(utility)])
    assert [one.verdict() for one in history] == ["first", "better", word]


def from_to_zero(off):
    """A trial of one state, from `off` to 0."""
    states = np.linspace(off, 0.0, 30)[:, None]
    return Trial(states, np.zeros((29, 1)), 0.05, ("x",), ("u",))


def test_what_a_start_is_worth_is_no_improvement():
    """A robot that starts 7 cm nearer to the target has not improved with probability 1.00."""

    def ran(name, base, utility, off, as_run=np.nan):
        """Return a run from `off` beside s_0; the model gives its base -4 from s_0."""
        candidate = SimpleNamespace(
            id=name, base=base, expected_of_base=-4.0, base_as_run=as_run, model="m", seen=()
        )
        candidate.predicted_states = np.zeros((30, 1))
        trials = (from_to_zero(off),) * 2
        return Tried(candidate, trials, (utility, utility + 0.01), True)

    first = ran("c0001", "", -6.0, off=0.07)
    second = ran("c0002", "c0001", -3.9, off=0.0, as_run=-5.9)
    assert Difference(first, second, [first, second]).owed == pytest.approx(1.9)
    costs = {"c0001": 0.5, "c0002": -0.2}
    planned = SimpleNamespace(owed=lambda *_: 0.0, cost=lambda one: costs[one.candidate.id])
    known = replace(second, starts=planned)  # which knows both, and a grounded model only one
    assert Difference(first, known, [first, known]).owed == pytest.approx(0.7)
    here = ran("c0001", "", -6.0, off=0.0)
    assert Difference(here, second, [here, second]).owed == 0.0
    same = ran("c0002", "c0001", -3.9, off=0.07, as_run=-5.9)
    assert Difference(first, same, [first, same]).owed == 0.0  # both began 7 cm away
    away = ran("c0002", "c0001", -3.9, off=-0.07, as_run=-5.9)
    assert Difference(first, away, [first, away]).owed == 0.0  # nothing tells what -7 cm is worth
    little = ran("c0002", "c0001", -3.9, off=0.0, as_run=-4.1)
    assert Difference(first, little, [first, little]).owed == 0.0
