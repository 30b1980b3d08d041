"""The step rule: an accurate prediction enlarges the step, an inaccurate one reduces it."""

from types import SimpleNamespace

import pytest

from grounded.search import improve
from grounded.search.step.step_size import LEAST, MOST, Step, after_failure, after_success


def test_a_kept_promise_lowers_the_damping_and_a_broken_one_raises_it():
    assert after_success(Step(0.9), 100.0, 95.0) == Step(pytest.approx(0.03))
    assert after_success(Step(0.1), 100.0, 60.0) == Step(0.1)
    assert after_success(Step(0.1), 100.0, 10.0) == Step(1.0)
    assert after_success(Step(1.0), 100.0, 10.0) == Step(10.0)
    assert after_success(Step(MOST), 100.0, 10.0) == Step(MOST)
    assert after_success(Step(LEAST), 100.0, 100.0) == Step(LEAST)


def test_a_shortened_step_earns_no_wider_one():
    assert after_success(Step(1.0, 0.5), 100.0, 100.0) == Step(1.0)


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


def test_a_damping_is_written_as_in_the_table_of_status():
    """`propose`, the page and `status` show the same number, 100 rather than 1e+02."""
    texts = [str(Step(damping)) for damping in (1.0, 33.3, 100.0, 1000.0)]
    assert [text.partition("damping ")[2] for text in texts] == ["1.0", "33", "100", "1,000"]


@pytest.mark.parametrize(
    ("may_gain", "own_gain", "taken"),
    [
        (-6.0, -1.0, "own"),  # beyond a fifth of the best cost
        (-6.0, -8.0, "corrected"),  # the own derivatives are worse
        (-6.0, None, "corrected"),  # they promise nothing
        (-3.0, -1.0, "corrected"),  # a small risk teaches
        (0.5, 2.0, "corrected"),
    ],
)
def test_a_step_that_may_lose_much_gives_way_to_the_model_s_own_derivatives(
    monkeypatch, may_gain, own_gain, taken
):
    def step(gain):
        return SimpleNamespace(candidate=SimpleNamespace(expected_gain=gain))

    corrected, own = step(may_gain), None if own_gain is None else step(own_gain)
    about = SimpleNamespace(
        make=None,
        incumbent=SimpleNamespace(utility=-20.0),
        options=None,
        way="",
        original=False,
    )
    plain = SimpleNamespace(step_from=lambda first, promised: own, doubted=None)
    monkeypatch.setattr(improve, "About", lambda *given, plainly: plain)
    found = improve._surer(about, Step(), corrected)
    assert found is (own if taken == "own" else corrected)
