"""The sentence on the certainty of an improvement, and the verdicts on candidates."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm, t, ttest_ind

from facts import holds
from grounded.search.candidate import Tried
from grounded.search.certainty import (
    beyond_one_trial,
    by_starts,
    chance,
    cost_of_start,
    error_between,
    explained,
    few,
    last_improvement,
    owed_to_start,
    runs_to_show,
    share_of_cost,
    student,
    with_chances,
)
from grounded.search.scatter import with_errors
from grounded.search.standing import PATIENCE, _hardly
from grounded.trial import Trial


def tried(*utilities, accepted=True, base="c0001"):
    nothing = {"expected_of_base": np.nan, "base_as_run": np.nan}
    candidate = SimpleNamespace(id="c", base=base, model="m", way="", **nothing)
    return Tried(candidate=candidate, trials=(), utilities=utilities, accepted=accepted)


def test_nothing_to_say_before_the_first_improvement():
    assert last_improvement([]) == ""
    assert last_improvement([tried(-5.0)]) == ""
    assert last_improvement([tried(-5.0), tried(-6.0, accepted=False)]) == ""


def test_single_trials_say_nothing_about_noise():
    found = last_improvement([tried(-5.0), tried(-4.0)])
    assert holds(found, 1, "once") and "+-" not in found and "probability" not in found
    assert last_improvement([tried(-5.0), tried(-4.0)], " (do it)").endswith(" (do it)")


def test_the_probability_is_the_t_tests():
    a, b = (-5.0, -5.4, -4.9), (-4.2, -4.6, -4.5)
    found = last_improvement([tried(*a), tried(*b)])
    p = ttest_ind(b, a, alternative="less").pvalue
    assert holds(found, f"probability {p:.2f}")
    assert error_between(tried(*a), tried(*b), [tried(*a), tried(*b)])[1] == 4


@pytest.mark.parametrize("freedom", [1.0, 1.7, 4.0, 30.5, 7500.0])
@pytest.mark.parametrize("x", [-1e6, -2.5, -0.3, 0.0, 0.01, 1.0, 4.0])
def test_student_s_t_is_scipy_s(x, freedom):
    assert student(x, freedom) == pytest.approx(t.cdf(x, freedom), abs=2e-5)


def test_noise_of_a_repeated_candidate_stands_in_for_the_others():
    history = [tried(-9.0), tried(-5.0, -5.2, accepted=False), tried(-4.0), tried(-3.9)]
    error, freedom = error_between(history[-2], history[-1], history)
    assert (error, freedom) == (pytest.approx(2**0.5 * np.std([-5.0, -5.2], ddof=1)), 1)
    assert holds(last_improvement(history), "0.10 +- 0.20")


def test_the_wild_first_policy_says_nothing_of_the_noise_of_later_ones():
    """Scatter at very different utilities is not pooled: it would hide a clear gain."""
    wild = tried(-9000.0, -200.0, -4000.0, base="")
    found = last_improvement([wild, tried(-5.0, -5.02, -4.98), tried(-4.0, -4.01, -3.99)])
    assert holds(found, "probability 1.00")
    once = last_improvement([wild, tried(-5.0), tried(-4.0)])
    assert "probability" not in once
    gentler = tried(-900.0, -200.0, accepted=False, base="")  # a first policy too
    assert "probability" not in last_improvement([wild, gentler, tried(-5.0), tried(-4.0)])


def test_a_gain_within_its_own_standard_error_ends_a_search():
    """Under noise, four candidates in a row may each be slightly luckier than the one before."""
    small = (tried(-1.05), tried(-1.3, accepted=False), tried(-1.2, accepted=False))

    def ending(best, repeated=(-1.2, -1.0), tolerance=1e-3, base="c0001"):
        before = (tried(-9.0, base=""), tried(*repeated, base=base))
        found = _hardly((*before, *small, tried(best)), tolerance, "m")
        return found and found[0]

    assert ending(-1.02) == "too little gained" and ending(-0.5) is None
    assert ending(-1.02, repeated=(-1.1,)) is None  # the noise is unknown
    assert ending(-1.02, repeated=(-1.1,), tolerance=0.05) == "too little gained"
    assert ending(-0.9, repeated=(-9.0, -0.2, -4.0), base="") is None  # the wild first policy


def test_a_stopped_run_is_no_candidate_that_gained_nothing():
    """A car stopped at 8 s ended its search, beside a command to discard that run."""
    lost = [tried(-1.2 - k / 10, accepted=False) for k in range(3)]
    before = (tried(-9.0, base=""), tried(-1.1), *lost)
    crash = tried(-np.inf, accepted=False)
    assert _hardly((*before, crash), 1e-3, "m") is None
    assert _hardly((*before, crash, tried(-1.5, accepted=False)), 1e-3, "m") is not None
    assert _hardly((*before, *[crash] * PATIENCE), 1e-3, "m") is not None


def promising(gain, utilities=(-1.2, -1.0), deviation=0.1, doubtful=False):
    best = replace(tried(*utilities), deviation=deviation)
    made = SimpleNamespace(id="c2", base="c", promised_over=lambda _: gain, doubtful=doubtful)
    return made, best


def test_a_scatter_says_on_how_many_repeats_it_rests():
    """One pair of runs scattered by 0.016 where twenty scatter by 0.04."""
    few_runs, many = tried(-5.0, -5.2), tried(-5.0, *[-5.2] * 9)
    found = [with_errors([one])[0] for one in (few_runs, many)]
    assert [one.repeats for one in found] == [1, 9]
    assert [few(one.repeats) for one in found] == [", from a single repeat only", ""]
    made, _ = promising(0.05)
    told = [beyond_one_trial(made, replace(one, deviation=0.1)) for one in found]
    assert holds(told[0], "single repeat", "takes more runs of each") and "22" not in told[0]
    assert holds(told[1], f"takes {runs_to_show(0.05, replace(found[1], deviation=0.1))} runs")


def test_a_share_of_cost_has_its_error_if_repeats_tell_it():
    first, best = tried(-1.05, base=""), tried(-0.85, -0.9)
    assert share_of_cost(first, tried(-0.875), (first, tried(-0.875))) == "17 %"
    told = share_of_cost(first, best, (first, best))
    error = (0.05**2 / 2 * 1.5) ** 0.5 / 1.05  # by the scatter of the two, of a mean and a run
    assert told == f"17 % (+- {100 * error:.2g} %, from a single repeat only)"


def test_a_gain_that_a_trial_cannot_show_is_called_so_with_the_runs_it_takes():
    found = beyond_one_trial(*promising(0.05))
    assert holds(found, "c2", "0.05", "0.1", "0.2", "22 runs", "stop with c")
    assert runs_to_show(0.05, promising(0.05)[1]) == 22
    assert holds(beyond_one_trial(*promising(0.01)), "more than 50 runs")
    unsteady = beyond_one_trial(*promising(0.05, deviation=0.6))
    assert holds(unsteady, "runs as good as c scatter by about as much as they cost", "steadier")
    assert "stop with" not in unsteady
    error = 0.1 * (2 / 22) ** 0.5  # of the difference of two means
    assert norm.cdf(0.05 / error) == pytest.approx(0.95, abs=0.01)
    assert beyond_one_trial(*promising(0.25)) == ""  # one trial shows it
    made, best = promising(0.05)
    made.base = "c0"  # it was made before that best one, or is that one
    assert beyond_one_trial(made, best) == ""
    assert "stop with" not in beyond_one_trial(*promising(0.05, doubtful=True))  # `doubt` says it


@pytest.mark.parametrize("deviation", [np.nan, 0.0])
def test_nothing_is_below_a_noise_that_is_unknown_or_absent(deviation):
    assert beyond_one_trial(*promising(0.05, deviation=deviation)) == ""


def test_more_repeats_of_each_candidate_show_smaller_gains():
    made, best = promising(0.1, utilities=(-1.0,) * 9)
    assert beyond_one_trial(made, best) and not beyond_one_trial(made, best, repeats=9)


def test_failed_runs_are_left_out_and_trials_that_agree_say_so():
    failed = tried(-5.0, -np.inf)
    assert error_between(tried(-5.0), tried(-4.0), [failed])[1] == 0
    found = last_improvement([tried(-5.0, -5.0), tried(-4.0, -4.0)])
    assert holds(found, 1, "exactly") and "+-" not in found and "probability" not in found


def test_exact_repeats_show_at_any_utility_that_nothing_scatters():
    first, a, b = tried(-9000.1, -9000.1, -9000.1, base=""), tried(-5.0), tried(-4.0)
    assert holds(last_improvement([first, a, b]), "exactly")
    assert chance(a, b, [first, a, b]) == 1.0
    noisy = tried(-9000.1, -9000.2, base="")
    assert error_between(a, b, [noisy, a, b])[1] == 0


def test_a_crash_is_called_a_crash():
    """A run that ended early is "crashed", not "no better", in table, page and text (issue 12)."""
    candidate = SimpleNamespace(base="c0001")
    lost = Tried(candidate, (None, None), (-4.0, -np.inf), False)
    assert lost.verdict() == "crashed"


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
    said = last_improvement(history)
    if word == "maybe better" and len(repeats) > 1:
        assert holds(said, f"probability {history[-1].probability:.2f}")


@pytest.mark.parametrize(
    ("runs", "clause"),
    [
        (((-4.0,), (-3.68,)), "how much runs scatter is not known, and may explain"),
        (((-4.0, -4.3), (-3.9,)), "the scatter of repeats may explain"),
        (((-4.0,), (-1.0,)), ""),
        (((-np.inf,), (-1.0,)), ""),
    ],
)
def test_a_lead_is_told_only_if_nothing_may_explain_it(runs, clause):
    history = with_chances([tried(*runs[0], base=""), tried(*runs[1])])
    assert explained(*history, history) == clause


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
    assert owed_to_start(first, second, [first, second]) == pytest.approx(1.9)
    costs = {"c0001": 0.5, "c0002": -0.2}
    planned = SimpleNamespace(owed=lambda *_: 0.0, cost=lambda one: costs[one.candidate.id])
    known = replace(second, starts=planned)  # which knows both, and a grounded model only one
    assert owed_to_start(first, known, [first, known]) == pytest.approx(0.7)
    told = by_starts(first, second, [first, second])
    assert told == "by the model, different start states alone reduced the cost by 32 %"
    found = last_improvement([first, second])
    assert holds(found, "2.1", "1.9", "0.2", "c0001") and "probability" not in found
    worse = replace(second, utilities=(-4.4, -4.3))  # the policy lost, the start made up for it
    told = last_improvement([first, worse])
    assert holds(
        told, "c0002 over c0001", "which the search goes by", "c0001 would be ahead", "0.255"
    )
    here = ran("c0001", "", -6.0, off=0.0)
    assert owed_to_start(here, second, [here, second]) == 0.0
    assert "probability" in last_improvement([here, second])
    same = ran("c0002", "c0001", -3.9, off=0.07, as_run=-5.9)
    assert owed_to_start(first, same, [first, same]) == 0.0  # both began 7 cm away
    away = ran("c0002", "c0001", -3.9, off=-0.07, as_run=-5.9)
    assert owed_to_start(first, away, [first, away]) == 0.0  # nothing tells what -7 cm is worth
    told = last_improvement([first, away])
    assert holds(told, "2.1000 +- 0.0071", "start", "not known") and "probability" not in told
    little = ran("c0002", "c0001", -3.9, off=0.0, as_run=-4.1)
    assert owed_to_start(first, little, [first, little]) == 0.0
    assert by_starts(first, little, [first, little]) == ""


def test_starts_that_scatter_as_much_are_not_different_ones():
    """An arm's repeats began -1.5 and -0.6 mrad off, by 2 mrad each: -3.6 % "due to the start"."""

    def ran(name, base, utility, offs, as_run=np.nan):
        candidate = SimpleNamespace(
            id=name, base=base, expected_of_base=-4.0, base_as_run=as_run, model="m", seen=()
        )
        candidate.predicted_states = np.zeros((30, 1))
        trials = tuple(map(from_to_zero, offs))
        return Tried(candidate, trials, tuple(utility for _ in offs), True)

    first = ran("c0001", "", -6.0, (-3.1, 0.0, 1.5, 1.5, -3.1, -3.1))
    second = ran("c0002", "c0001", -3.9, (0.0, 1.5, 1.5, -3.1, -3.1), as_run=-5.9)
    third = ran("c0003", "c0002", -3.9, (0.0,), as_run=-4.1)
    assert owed_to_start(first, second, [first, second, third]) == 0.0
    apart = ran("c0001", "", -6.0, (-9.1, -6.0, -7.5, -9.1))
    assert owed_to_start(apart, second, [apart, second, third]) == pytest.approx(1.8)


def test_a_lead_that_lucky_starts_explain_is_told_so():
    def ran(name, utilities, owed=0.0):
        candidate = SimpleNamespace(id=name, base="", model="m", seen=())
        candidate.predicted_states = np.zeros((30, 1))
        starts = SimpleNamespace(owed=lambda one, other: owed)
        trials = (from_to_zero(0.0),) * len(utilities)
        return Tried(candidate, trials, utilities, True, starts=starts)

    first, led = ran("c0001", (-5.0, -6.0)), ran("c2", (-4.9,), owed=0.9)
    fair = ran("c2", (-4.9,))
    assert chance(first, led, [first, led]) < chance(first, fair, [first, fair])
    # "0.576 of it is due to where their runs began", of a gain of 0.544, "and that counts"
    told = "c0001 would be ahead by 0.3 from the same start"
    assert told in last_improvement([first, led])
    assert "probability" not in last_improvement([first, led])  # which took all for a gain
    # "another run of c0001 would show which is better" stood beside a next command that ran c0003
    assert last_improvement([first, led]).endswith("which of the two is better is open")
    # a lead of 1.81 beside a scatter of 0.058, of which the first one's start cost 1.85
    first, led = ran("c0001", (-3.7,)), ran("c2", (-1.85, -1.87), owed=1.85)
    assert explained(first, led, [first, led]) == "where the runs began may explain"
    even = ran("c2", (-3.69, -3.71))
    assert explained(first, even, [first, even]) == "the scatter of repeats may explain"
    clear = last_improvement([ran("c0001", (-5.0, -5.01)), ran("c2", (-2.0,), owed=1.0)])
    assert clear.endswith("and 2 to the policy")
    assert "began" not in last_improvement([first, ran("c2", (-4.9,), owed=0.01)])
    assert "began" not in last_improvement([first, ran("c2", (-4.9,), owed=np.nan)])


def test_what_starts_cost_is_not_that_of_the_first_runs_alone():
    trials = tuple(replace(from_to_zero(0.07), id=name) for name in ("t1", "t2"))
    made = SimpleNamespace(expected_of_base=-4.0, base_as_run=-5.9, seen=("t1", "t2", "t0"))
    best = Tried(SimpleNamespace(id="c0001"), trials, (-6.0, -6.1), True)
    assert cost_of_start(best, made) == pytest.approx(1.9)
    made.seen = ("t1",)
    assert np.isnan(cost_of_start(best, made))
    starts = SimpleNamespace(cost=lambda tried: 0.7 if tried.trials == trials else np.nan)
    assert cost_of_start(replace(best, starts=starts), made) == 0.7
