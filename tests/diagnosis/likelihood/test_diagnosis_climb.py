"""The climb of one hypothesis: steps inside bounds, and what hangs on them."""

from dataclasses import replace

import numpy as np
import pytest

from grounded import Model, Param, Trial
from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.linearise import gains_of, linearise
from grounded.diagnosis.likelihood.noise import (
    Structure,
    likelihood_slopes,
    noise_guess,
    started,
)
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.likelihood.refine import refine
from grounded.diagnosis.likelihood.step import bounded
from grounded.effects import Library
from grounded.filter.kalman import innovations, smoother
from grounded.models.arm import model as arm
from grounded.models.car import model as car
from grounded.models.pendulum import model as pendulum


@pytest.mark.parametrize("seed", [0, 1])
def test_a_bounded_step_is_the_best_one_inside(seed):
    """With the unknowns that stopped held where they are, nothing else wants to move."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((12, 4))
    G, slope = A.T @ A, 3 * rng.standard_normal(4)
    low, high = -rng.uniform(0, 0.2, 4), rng.uniform(0, 0.2, 4)
    low[3], high[3] = -np.inf, np.inf
    step = bounded(G, slope, low, high)
    assert (step >= low).all() and (step <= high).all()
    inside = (step > low) & (step < high)
    assert np.abs((G @ step + slope)[inside]).max(initial=0.0) < 1e-9
    np.testing.assert_allclose(
        bounded(G, slope, low - np.inf, high + np.inf), -np.linalg.solve(G, slope)
    )


def test_what_stops_at_its_bound_is_released_where_the_others_pull_it_back():
    """Two wheels' gains and viscous frictions: the unbounded step goes far beyond both bounds."""
    G = np.array([[1.0, 0.9999], [0.9999, 1.0]])
    slope = G @ np.array([-50.0, 49.0])  # so that the unbounded step is (50, -49)
    low, high = np.full(2, -1.0), np.full(2, 1.0)
    step = bounded(G, slope, low, high)
    best = min(
        float(slope @ x + 0.5 * x @ G @ x)
        for x in np.stack(np.meshgrid(*[np.linspace(-1, 1, 401)] * 2), -1).reshape(-1, 2)
    )
    found = float(slope @ step + 0.5 * step @ G @ step)
    assert found <= best + 1e-12 and found < 0
    at_once = np.array([1.0, -1.0])  # both held where the unbounded step leaves
    assert found < float(slope @ at_once + 0.5 * at_once @ G @ at_once)


def test_a_parameter_is_believed_within_three_of_its_standard_deviations():
    """A log that no length explains: thousands of nats carry it to its limit and no further."""
    t = 0.02 * np.arange(150)
    trials = []
    for k in range(4):
        q = (1 + 0.2 * k) * np.sin((2.0 + 0.3 * k) * t)  # swings as of a length of 0.9 to 2 m
        states = np.column_stack([q, np.gradient(q, 0.02)])
        trials.append(Trial(states, np.zeros((149, 1)), 0.02, ("q", "w"), ("u",)))
    crude = Model(
        states={"q": "rad", "w": "rad/s"},
        inputs={"u": "rad/s^2"},
        params={"l": Param(0.5, "m", std=0.02)},
        derivative=lambda s, a, p: {"q": s.w, "w": a.u - 9.81 / p.l * np.sin(s.q)},
    )
    search = HypothesisSearch(prepare(crude, trials), ())
    search.nulls()
    shifts = [f.hypothesis.shift[0] for (_, w, _), f in search.fits.items() if w > 0]
    assert max(shifts) == pytest.approx(0.06)


def test_a_fit_at_its_top_is_not_climbed_again_and_one_on_its_way_is():
    rng, u = np.random.default_rng(2), np.repeat(np.sin(np.arange(15)), 10)[:, None]
    x = np.zeros((151, 2))
    for t in range(150):
        x[t + 1] = x[t] + 0.05 * np.array([x[t, 1], 1.3 * u[t, 0] - x[t, 1]])
        x[t + 1] += 0.01 * rng.standard_normal(2)
    y = x + 0.02 * rng.standard_normal(x.shape)
    crude = Model(
        states={"x": "m", "v": "m/s"},
        inputs={"u": "N"},
        params={"k": Param(1.0)},
        derivative=lambda s, a, p: {"x": s.v, "v": p.k * a.u - s.v},
    )
    search = HypothesisSearch(prepare(crude, [Trial(y, u, 0.05, ("x", "v"), ("u",))]), ())
    (early,) = search.refined([search.fresh(Hypothesis())], 1)
    (top,) = search.refined([early], 40)
    assert not early.settled and top.settled and top.evidence > early.evidence
    assert search.refined([top, early], 5)[0] is top
    again = search.refined([(top.hypothesis, top.noise, top.track)], 40)[0]
    assert abs(again.evidence - top.evidence) < 0.1  # what another climb from there would find


def test_an_unknown_whose_slope_is_no_number_stays_where_it_is():
    G = np.diag([2.0, np.nan, 1.0])
    G[1, 0] = G[0, 1] = np.nan
    wide = np.full(3, np.inf)
    step = bounded(G, np.array([2.0, np.nan, 3.0]), -wide, wide)
    np.testing.assert_allclose(step, [-1.0, 0.0, -3.0])
    assert not bounded(np.full((2, 2), np.nan), np.full(2, np.nan), -wide[:2], wide[:2]).any()


def test_a_rate_that_is_another_state_has_one_name():
    offered = {effect.name for effect in Library().candidates(pendulum)}
    assert "rate_gain:theta" in offered and "coupling:theta<-omega" not in offered
    assert any(effect.name.startswith("coupling:") for effect in Library().candidates(car))


def test_no_force_moves_an_angle_beside_its_own_rate():
    added = ("offset", "trend", "coupling", "periodic")
    names = [e.name for e in Library().candidates(arm) if e.family.name in added]
    assert {n.partition(":")[2].partition("<-")[0] for n in names} == {"q1_vel", "q2_vel"}


def test_what_fills_up_a_shorter_run_grows_without_bound_nowhere():
    falling = Model(
        states={"q": "rad", "w": "rad/s"},
        inputs={"u": "rad/s^2"},
        params={"g": Param(400.0, "1/s^2", std=40.0)},
        derivative=lambda s, a, p: {"q": s.w, "w": a.u + p.g * s.q},
    )
    rng, trials = np.random.default_rng(0), []
    for steps in (12, 190):
        states = np.column_stack([np.sin(0.1 * np.arange(steps + 1))] * 2)
        states += 1e-3 * rng.standard_normal(states.shape)
        inputs = -400 * states[:-1, :1]
        trials.append(Trial(states, inputs, 0.05, ("q", "w"), ("u",)))
    data = prepare(falling, trials)
    assert data.idle.any() and not data.idle.all()
    predictor, h = Predictor(data), Hypothesis((), shift=np.zeros(1), spread=1.0)
    noise = noise_guess(data.y[1:] - data.y[:-1], data.seen, np.ones(2))
    F, d, r = linearise(predictor, h, data.y)
    assert not d[data.idle].any()
    g = gains_of(predictor, h, noise, data.y, F)
    white, filtered = innovations(g, d, r, track=True)
    adjoint = smoother(g, white[..., 0])
    for found in (g.k, white, filtered, *vars(adjoint).values()):
        assert found is None or (np.isfinite(found).all() and np.abs(found).max() < 1e150)


@pytest.mark.parametrize("tau", [None, 0.1])
def test_the_slopes_of_the_noise_are_those_of_the_likelihood(tau):
    rng, trials = np.random.default_rng(2), []
    for _ in range(12):
        x = np.cumsum(0.1 * rng.standard_normal((13, 1)), axis=0)
        y = x + 0.1 * rng.standard_normal((13, 1))
        trials.append(Trial(y, np.zeros((12, 1)), 0.05, ("x",), ("u",)))
    drift = Model(
        states={"x": "m"}, inputs={"u": "m/s"}, params={}, derivative=lambda s, a, p: {"x": a.u}
    )
    data = prepare(drift, trials)
    predictor, h, track = Predictor(data), Hypothesis(), data.y.copy()
    start = HypothesisSearch(data, ()).fresh(h)[1].allowing(Structure(tau), data.dt)

    def likelihood(noise):
        return refine(predictor, [(h, noise, track)], iterations=1)[0].loglik

    F, d, r = linearise(predictor, h, track)
    g = gains_of(predictor, h, start, track, F)
    white = innovations(g, d, r)[0][..., 0]
    starts = started(g, white, start.structure.phi(data.dt))
    slope = likelihood_slopes(start, smoother(g, white), data.dt, starts)
    for row, name in zip(slope, ("log_q", "log_r", "log_c"), strict=False):
        up, down = (replace(start, **{name: getattr(start, name) + e}) for e in (1e-4, -1e-4))
        assert row[0] == pytest.approx((likelihood(up) - likelihood(down)) / 2e-4, rel=1e-3)
