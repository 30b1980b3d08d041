"""The scatter between runs: two that agree by chance do not prove that there is none."""

from types import SimpleNamespace

import numpy as np
from scipy.stats import t

from grounded.search.candidate import Tried
from grounded.search.difference import PIECES, Repeats


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
