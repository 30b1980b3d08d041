"""The scatter between runs: two that agree by chance do not prove that there is none."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import t

from grounded.plant import Noise, Plant
from grounded.search.candidate import Tried
from grounded.search.improve import propose
from grounded.search.scatter import (
    PIECES,
    Repeats,
    noise_cost,
    sensor_noise,
)
from grounded.search.standing import standing
from grounded.search.step.step_size import SearchOptions
from small_tasks import cart_task, drive


def runs(pieces, cost=10.0):
    """Return a candidate whose runs have these utilities in each part, plus a common cost."""
    utilities = tuple(float(u) for u in pieces.sum(axis=1) - cost)
    candidate = SimpleNamespace(base="c0001", model="m", id="c0002")
    return Tried(candidate, (None,) * len(pieces), utilities, True, pieces=pieces)


def test_intervals_from_two_repeats_hold_as_often_as_they_say():
    rng = np.random.default_rng(0)
    inside, least, width = [], [], []
    for _ in range(600):
        pair = runs(rng.normal(size=(2, PIECES)))
        scatter = Repeats([pair]).near(pair.utility)
        error = scatter.error(2)
        inside.append(abs(pair.utility + 10.0) < t.ppf(0.95, scatter.freedom) * error)
        least.append(np.sqrt(scatter.variance) / 2.0)  # of the true deviation, sqrt(PIECES)
        width.append(np.std(pair.utilities, ddof=1) / 2.0)
    assert 0.87 < np.mean(inside) < 0.97  # of 0.9
    assert np.quantile(least, 0.01) > 0.2 > 10 * np.quantile(width, 0.01)


def test_what_costs_much_more_says_nothing_and_copies_count_where_all_agree():
    tame, wild = runs(np.ones((2, PIECES)) * [[0.1], [0.2]]), runs(np.eye(PIECES)[:2] * 90, 400.0)
    near = Repeats([tame, wild]).near(tame.utility)
    assert near == Repeats([tame]).near(tame.utility)
    copies = runs(np.ones((2, PIECES)))
    assert Repeats([tame, copies]).near(-9.0) == near
    alone = Repeats([copies]).near(copies.utility)
    assert (alone.variance, alone.freedom > 0) == (0.0, True)


def test_what_noise_in_a_log_costs_is_no_doubt_in_the_model():
    task = cart_task()
    proposal = propose(task, [], [], SearchOptions())
    policy, noise = proposal.candidate.policy, np.array([0.1, 0.1])
    seen = Noise(measurement={"x": 0.1, "v": 0.1})
    plant = Plant(task.model, noise=seen)
    clean = task.utility(drive(task, Plant(task.model), proposal.candidate))
    runs = [drive(task, plant, proposal.candidate, seed) for seed in range(15)]
    lost = clean - np.mean([task.utility(run) for run in runs])
    assert lost > -clean
    assert noise_cost(task, policy, noise) == pytest.approx(lost, rel=0.25)
    made = proposal.candidate
    now = standing(task, [made], runs[:1], SearchOptions(), made.model)
    told = now.history[0].noise_cost
    assert 0.3 < told / lost < 1.4  # from 41 rows of one log
    assert not now.doubt
    assert now.incumbent.promised == pytest.approx(made.predicted_utility - told)
    # one estimate from all logs, for what is promised before a run and for what is judged after it
    assert told == pytest.approx(noise_cost(task, policy, sensor_noise(runs[:1], 2)))
    more = standing(task, [made], runs[:3], SearchOptions(repeats=3), made.model).history[0]
    assert more.noise_cost == pytest.approx(noise_cost(task, policy, sensor_noise(runs[:3], 2)))
    each = [float(noise_cost(task, policy, sensor_noise([run], 2))) for run in runs[:3]]
    assert min(each) < more.noise_cost < max(each)
