"""What the scan hands on: faint values, other places; what is too brief to be claimed."""

import numpy as np
import pytest

from grounded import Model, Param
from grounded.diagnosis.hypotheses import scan
from grounded.diagnosis.hypotheses.scan import elsewhere
from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.effects import Library
from grounded.models.car import model as car
from grounded.models.pendulum import model as pendulum
from stepped import logged


def test_fits_start_from_every_local_maximum_of_the_scan():
    effect = Library().effect("delay:throttle", car)
    gains = [3.0, 1.0, 90.0, 100.0, 95.0, 2.0, 4.0, 5.0, 1.0, -2.0, -1.0]
    grid = sorted(effect.free[0].grid)
    looks = [(gain, {"d": d}) for gain, d in zip(gains, grid, strict=False)]
    found = elsewhere(effect, sorted(looks, key=lambda look: -look[0]))
    assert found == ({"d": grid[7]}, {"d": grid[0]})


def test_a_late_position_is_tried_with_a_filter_of_its_own():
    cart = Model(
        states={"x": "m", "v": "m/s"},
        inputs={"u": "m/s^2"},
        derivative=lambda s, a, p: {"x": s.v, "v": a.u},
    )
    rng, trials = np.random.default_rng(3), []
    for _ in range(3):
        u = np.repeat(rng.uniform(-1, 1, 15), 10)
        v = np.concatenate([[0.0], np.cumsum(0.02 * u)]) + 5.0
        x = np.concatenate([[0.0], np.cumsum(0.02 * v[:-1])])
        late = x - 0.05 * v + 0.01 * rng.standard_normal(151)
        states = np.column_stack([late, v + 0.01 * rng.standard_normal(151)])
        trials.append(logged(cart, states, u, 0.02))
    data = prepare(cart, trials)
    search = HypothesisSearch(data, Library().candidates(cart, data.scales))
    null = search.nulls()
    starts = search.late_sensors(null)
    assert [h.names for h, _, _ in starts] == [("sensor_delay:x",)]
    (fit,) = search.refined(starts, 12)
    assert search.score(fit) > search.score(null) + 3
    assert fit.hypothesis.values[0]["d"] == pytest.approx(0.05, abs=0.015)


def test_a_state_that_is_set_outright_has_no_rate_to_be_scaled():
    model = Model(
        states={"w": "rad/s"},
        inputs={"steering": "1"},
        params={"k": Param(1.0, "rad/s", std=0.3)},
        step=lambda s, a, p, dt: {"w": p.k * a.steering + 0 * s.w},
    )
    names = [effect.name for effect in Library().candidates(model)]
    assert "rate_gain:w" not in names and "offset:w" in names
    assert "rate_gain:omega" in [effect.name for effect in Library().candidates(pendulum)]


def test_a_scan_of_a_few_runs_at_a_time_is_that_of_all_at_once(monkeypatch):
    rng, (B, T) = np.random.default_rng(2), (5, 60)
    trials = [
        logged(car, 0.1 * rng.normal(size=(T + 1, car.n)), rng.normal(size=(T, car.m)), 0.05)
        for _ in range(B)
    ]
    data = prepare(car, trials)
    candidates = Library().candidates(car, data.scales)
    search = HypothesisSearch(data, candidates)
    kinds = (Hypothesis(), Hypothesis().plus(Library().effect("sensor_delay:x", car), {"d": 0.07}))
    fits = search.refined([search.fresh(kinds[0])], 2) + search.refined([search.fresh(kinds[1])], 2)
    for fit in fits:
        found = []
        for most in (1, 1e9):
            monkeypatch.setattr(scan, "CACHED", most)
            found.append(scan.scan_candidates(search.predictor, fit, candidates))
        gains = np.array([[look.gain for look in looks] for looks in found])
        np.testing.assert_allclose(*gains, rtol=1e-6, atol=1e-6)
        assert (gains[0] > 0.1).sum() > 10
