"""Runs that are left out for memory: a trial is told from its start, repeats at the same time."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from grounded import Trial
from grounded.diagnosis.likelihood import data as diagnosis_data
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.validation.ruler import Ruler
from small_tasks import DT, pushed_cart

STEPS = 450  # three runs of 150 steps


@pytest.fixture
def known(monkeypatch):
    """A predictor of four trials without noise, of whose 12 runs 7 are kept; its fit."""
    model, _ = pushed_cart(trials=1)
    found = []
    for k in range(4):
        u = np.sin((1 + 0.2 * (k % 2)) * np.arange(STEPS) * DT)[:, None]  # 0 and 2, 1 and 3 repeat
        u = u * np.linspace(1, 2, STEPS)[:, None]  # so that more happens later
        x = [np.zeros(2)]
        for a in u:
            x.append(model.system.step(x[-1][None], a[None], model.values, DT)[0])
        names = (model.state_names, model.input_names)
        found.append(Trial(np.array(x), u, DT, *names, start_inputs=np.zeros(1)))
    monkeypatch.setattr(diagnosis_data, "MOST_NUMBERS", 7.5 * 150 * model.n**2 * 4)
    monkeypatch.setattr(diagnosis_data, "SESSION", 0)
    predictor = Predictor(prepare(model, found))
    assert predictor.data.time[0, :].tolist().count(0.0) == 3  # the beginnings of 0, 1 and 3
    assert len(predictor.data.valid) == 7
    return predictor, SimpleNamespace(hypothesis=Hypothesis(), states=predictor.data.y), found


def test_of_long_data_two_runs_of_one_candidate_are_kept_from_their_beginning(known):
    predictor, _, trials = known
    ran = [replace(t, candidate=c) for t, c in zip(trials, ["a", "b", "b", "c"], strict=True)]
    data = prepare(predictor.data.model, ran)
    begins = data.trial_of[data.time[0] == 0.0]
    assert {1, 2} <= {*begins.tolist()} and len(data.valid) == 7


def test_repeats_are_compared_at_the_same_time(known):
    predictor, fit, _ = known
    fit.hypothesis = Hypothesis(shift=np.array([0.5, 0.0]))  # wrong alike in repeats
    ruler = Ruler(predictor)
    np.testing.assert_allclose(ruler.scatter(fit, [[0, 2], [1, 3]])[0], 0.0, atol=1e-9)
    assert ruler.scatter(fit, [[1, 2]]) is None  # nothing that begins together


def test_short_repeats_say_nothing_of_longer_trials_and_little_of_long_horizons(known):
    predictor, _, trials = known
    short = [replace(t, states=t.states[:61], inputs=t.inputs[:60]) for t in trials[::2]]
    for some, whole in ((short, True), ([*short, trials[1]], False)):
        data = prepare(predictor.data.model, some)
        fit = SimpleNamespace(hypothesis=Hypothesis(), states=data.y)
        ruler = Ruler(Predictor(data))
        floor, unsure = ruler.scatter(fit, [[0, 1]])
        assert np.isfinite(floor[:-1]).all() and np.isfinite(floor[-1]).all() == whole
        assert unsure[0] < unsure[len(ruler.steps) - 1] < unsure[-1]


def test_of_long_data_the_runs_are_kept_in_which_most_happens(monkeypatch):
    model, _ = pushed_cart(trials=1)
    monkeypatch.setattr(diagnosis_data, "MOST_NUMBERS", 6.5 * 200 * model.n**2 * 4)
    busy = {3, 7, 11, 15, 19}  # of twenty runs of 200 steps, of four trials
    found = []
    for k in range(4):
        u = np.zeros((1000, 1))
        for run in range(5):
            if 5 * k + run in busy:
                u[200 * run : 200 * run + 200, 0] = np.sin(np.arange(200) * DT)
        x = np.vstack([np.zeros((1, 2)), np.cumsum(np.hstack([u, u]), axis=0)])
        found.append(Trial(x, u, DT, model.state_names, model.input_names))
    data = prepare(model, found)
    number = 5 * data.trial_of + np.rint(data.time[0] / (200 * DT)).astype(int)
    assert data.skipped == 14
    beginnings, busiest = {0, 5, 15}, {3, 11, 19}  # the busiest of each group of neighbours
    assert set(number.tolist()) == beginnings | busiest
