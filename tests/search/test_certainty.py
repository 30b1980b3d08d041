"""The sentence on the certainty of an improvement, and the verdicts on candidates."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
from scipy.stats import ttest_ind

from grounded.search.candidate import Tried
from grounded.search.difference import Difference, Repeats, in_question, with_chance


def tried(*utilities, accepted=True, base="c0001"):
    candidate = SimpleNamespace(id="c", base=base, model="m", way="")
    return Tried(candidate=candidate, trials=(), utilities=utilities, accepted=accepted)


def test_the_probability_is_the_t_tests():
    a, b = (-5.0, -5.4, -4.9), (-4.2, -4.6, -4.5)
    history = [tried(*a), tried(*b)]
    assert Difference(*history, history).probability == pytest.approx(
        1 - ttest_ind(a, b, alternative="less").pvalue
    )
    assert Difference(*history, history).freedom == 4


def promising(gain, utilities=(-1.2, -1.0), deviation=0.1, doubtful=False):
    best = replace(tried(*utilities), deviation=deviation)
    made = SimpleNamespace(id="c2", base="c", promised_over=lambda _: gain, doubtful=doubtful)
    return made, best


def test_more_repeats_of_each_candidate_show_smaller_gains():
    made, best = promising(0.1, utilities=(-1.0,) * 9)
    assert in_question(made, best) and not in_question(made, best, repeats=9)


def test_exact_repeats_show_at_any_utility_that_nothing_scatters():
    first, a, b = tried(-9000.1, -9000.1, -9000.1, base=""), tried(-5.0), tried(-4.0)
    assert Difference(a, b, [first, a, b]).probability == 1.0
    noisy = tried(-9000.1, -9000.2, base="")
    assert not Difference(a, b, [noisy, a, b]).known


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
    history = [tried(-90.0, base=""), tried(*repeats), tried(utility)]
    pool, befores = Repeats(history), [None, *history]
    told = [with_chance(*two, history, pool) for two in zip(history, befores, strict=False)]
    assert [one.verdict() for one in told] == ["first", "better", word]
