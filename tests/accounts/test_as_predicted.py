"""A fault of a log is only stated if the log without it is nearer to the candidate's prediction."""

from dataclasses import replace

import numpy as np
import pytest

from grounded.accounts.returned import Kind, multiplied, stories
from grounded.accounts.sent import apart, follows, like_predicted
from recorded import waiting


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    w = waiting(tmp_path_factory.mktemp("as_predicted"))
    own = w.candidate("c0002")[0]
    run = own.predicted_run
    noise = np.random.default_rng(0).normal(0, [0.002, 0.01], run.states.shape)
    return w.task, own, replace(run, states=run.states + noise)


def said(made, trial):
    task, own, _ = made
    return units(task, trial, own, follows(own.policy, trial, 1))


def units(task, run, own, plain):
    """The columns of a log that are in another unit, and the factor to correct them."""
    some = stories(task, own, run, plain)
    return next(((one.names, one.by) for one in some if one.kind is Kind.UNIT), ((), 1.0))


def test_a_sound_run_is_near_its_prediction_and_no_column_is_odd(made):
    task, own, run = made
    assert like_predicted(own, run) and said(made, run) == ((), 1.0)
    assert units(task, run, own, follows(own.policy, run, 1)) == ((), 1.0)


@pytest.mark.parametrize("by", [1e3, 1e-3, 180 / np.pi, -1.0])
def test_a_column_farther_from_the_prediction_is_told_whatever_its_size(made, by):
    _, own, run = made
    wrong = multiplied(run, ["v"], by)
    assert apart(own, wrong) > apart(own, run) + 1
    if abs(by) > 100 or abs(by) < 0.01 or by == -1:
        names, factor = said(made, wrong)
        assert names == ("v",) and factor * by == pytest.approx(1.0)
