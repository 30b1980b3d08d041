"""Groups of trials that differ in motion or in condition, and the folds made of them."""

import numpy as np
import pytest

from grounded import Model, Param, Trial
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.groups import folds

MODEL = Model(
    states={"x": "m", "v": "m/s"},
    inputs={"u": "m/s^2"},
    params={"k": Param(1.0, "1", std=0.1)},
    roles={"position": ("x",), "speed": "v"},
    derivative=lambda s, a, p: {"x": s.v, "v": p.k * a.u - s.v},
)
DT, STEPS = 0.05, 120


def trial(u, noise=0.01, seed=0, steps=STEPS, **more):
    """A cart under a command u(t), with noise that makes no motion different."""
    rng, x, states = np.random.default_rng(seed), np.zeros(2), [np.zeros(2)]
    sent = np.array([[u(k * DT)] for k in range(steps)])
    for value in sent[:, 0]:
        x = x + DT * np.array([x[1], value - x[1]])
        states.append(x)
    y = np.array(states) + noise * rng.standard_normal((steps + 1, 2))
    return Trial(y, sent, DT, ("x", "v"), ("u",), **more)


def slow(t):
    return np.sin(1.1 * t)


def fast(t):
    return np.sin(2.7 * t)


@pytest.mark.parametrize(
    ("trials", "groups"),
    [
        ([trial(slow), trial(slow, seed=1), trial(fast)], [(0, 1), (2,)]),
        ([trial(slow), trial(lambda t: 0.5 * slow(t)), trial(slow, seed=2)], [(0, 2), (1,)]),
        ([trial(lambda t: 0.2), trial(lambda t: 0.4), trial(lambda t: 0.2)], [(0, 2), (1,)]),
        ([trial(slow), trial(slow, steps=60)], [(0,), (1,)]),
        ([trial(slow, group="wet"), trial(slow, seed=1, group="dry")], [(0,), (1,)]),
        ([trial(slow, group="wet"), trial(fast, group="wet"), trial(fast)], [(0, 1), (2,)]),
        ([trial(slow)], [(0,)]),
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
