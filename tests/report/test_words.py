"""Numbers, units and verdicts as people read them."""

from types import SimpleNamespace

import pytest

from grounded_trials.wording import (
    count,
    labelled,
    per_second,
    percent,
    shown,
    verdict,
    with_unit,
)


def test_one_trial_and_two_trials():
    assert [count(n, "trial") for n in (0, 1, 2)] == ["0 trials", "1 trial", "2 trials"]
    assert count(2, "crash", "crashes") == "2 crashes"


def test_the_unit_one_is_not_printed():
    assert shown("1") == "" and shown("m/s") == "m/s"
    assert with_unit("0.146", "1") == "0.146" and with_unit("0.3", "m") == "0.3 m"
    assert labelled("throttle", "1") == "throttle" and labelled("v", "m/s") == "v [m/s]"
    assert per_second("1") == "1/s" and per_second("rad") == "rad per s"


@pytest.mark.parametrize(
    ("share", "text"),
    [
        (0.5, "50 %"),
        (0.997, "99.7 %"),
        (0.002, "0.2 %"),
        (1.0, "100.0 %"),
        (0.0, "0.0 %"),
        (1e-5, "< 0.1 %"),
        (0.99999, "> 99.9 %"),
        (float("nan"), "-"),
    ],
)
def test_a_share_keeps_its_tenths_where_they_matter(share, text):
    assert percent(share) == text


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
    candidate = SimpleNamespace(base=base)
    tried = SimpleNamespace(
        accepted=accepted, candidate=candidate, in_doubt=doubt, trials=(None,) * trials
    )
    assert verdict(tried, last) == word
