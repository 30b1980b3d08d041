"""The climb of one hypothesis: steps inside bounds, and what hangs on them."""

from dataclasses import replace

import numpy as np
import pytest

from grounded import Model, Trial
from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.linearise import gains_of, linearise
from grounded.diagnosis.likelihood.noise import Structure, likelihood_slopes, started
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.likelihood.refine import refine
from grounded.diagnosis.likelihood.step import bounded
from grounded.filter.kalman import innovations, smoother


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
