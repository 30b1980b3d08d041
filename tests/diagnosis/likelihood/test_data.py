"""Which runs of which trials are used, in which groups, and what is compared between them."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from grounded import Model, Param, Trial
from grounded.diagnosis.likelihood import data as diagnosis_data
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.groups import folds
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.validation.ruler import Ruler
from small_tasks import DT, pushed_cart
from stepped import logged, stepped

STEPS = 450  # three runs of 150 steps


@pytest.fixture
def known(monkeypatch):
    """A predictor of four trials without noise, of whose 12 runs 7 are kept; its fit."""
    model, _ = pushed_cart(trials=1)
    found = []
    for k in range(4):
        u = np.sin((1 + 0.2 * (k % 2)) * np.arange(STEPS) * DT)  # 0 and 2, 1 and 3 repeat
        u = u * np.linspace(1, 2, STEPS)  # so that more happens later
        found.append(logged(model, stepped(model, u, DT), u, DT))
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


MODEL = Model(
    states={"x": "m", "v": "m/s"},
    inputs={"u": "m/s^2"},
    params={"k": Param(1.0, "1", std=0.1)},
    roles={"position": ("x",), "speed": "v"},
    derivative=lambda s, a, p: {"x": s.v, "v": p.k * a.u - s.v},
)


def trial(omega=1.1, size=1.0, level=0.0, seed=0, steps=120, **more):
    """A cart under a sine or a level, with noise that makes no motion different."""
    u = level or size * np.sin(omega * np.arange(steps) * DT)
    x = stepped(MODEL, u + np.zeros(steps), DT)
    return logged(MODEL, x, u + np.zeros(steps), DT, 0.01, np.random.default_rng(seed), **more)


@pytest.mark.parametrize(
    ("trials", "groups"),
    [
        ([trial(), trial(seed=1), trial(2.7)], [(0, 1), (2,)]),
        ([trial(), trial(size=0.5), trial(seed=2)], [(0, 2), (1,)]),
        ([trial(level=0.2), trial(level=0.4), trial(level=0.2)], [(0, 2), (1,)]),
        ([trial(), trial(steps=60)], [(0,), (1,)]),
        ([trial(group="wet"), trial(seed=1, group="dry")], [(0,), (1,)]),
        ([trial(group="wet"), trial(2.7, group="wet"), trial(2.7)], [(0, 1), (2,)]),
        ([trial()], [(0,)]),
    ],
)
def test_trials_of_one_motion_in_one_condition_are_a_group(trials, groups):
    assert [group.trials for group in prepare(MODEL, trials).groups] == groups


@pytest.mark.parametrize(
    ("group", "steps", "levels", "expected"),
    [
        ([0, 1, 0, 1], [50, 50, 50, 50], True, [0, 1, 0, 1]),  # half of all, at its own level
        ([0, 1, 0, 1], [50, 50, 50, 50], False, [0, 1, 2, 3]),  # the rest would extrapolate
        ([0, 0, 0, 1], [50, 50, 50, 50], True, [1, 2, 3, 0]),  # most of all: trial by trial
        ([0, 1, 2], [10, 10, 80], False, [0, 1, 2]),
        ([0], [100], False, [0]),
    ],
)
def test_a_fold_is_a_group_or_part_of_one_that_holds_most(group, steps, levels, expected):
    own = np.full(len(group), levels)
    assert folds(np.array(group), np.arange(len(group)), steps, own).tolist() == expected
