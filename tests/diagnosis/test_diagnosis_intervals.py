"""Standard deviations from the information: right where it is regular, honest where it is not."""

import numpy as np
import pytest

from grounded.diagnosis.likelihood.intervals import _fisher


@pytest.mark.parametrize("seed", range(4))
def test_regular_information_is_inverted_whatever_the_units(seed):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((20, 4))
    units = 10.0 ** rng.uniform(-8, 8, 4)
    G = A.T @ A
    expected = np.sqrt(np.diag(np.linalg.inv(G)))
    np.testing.assert_allclose(_fisher(G * np.outer(units, units)), expected / units, rtol=1e-6)


def test_what_the_data_do_not_determine_is_not_certain():
    """Two unknowns of which only the sum is seen, in units 1e9 apart, beside one that is known."""
    row = np.array([1.0, 1e-9, 0.0])
    G = 1e4 * np.outer(row, row) + np.diag([0.0, 0.0, 25.0])
    found = _fisher(G)
    assert found[2] == pytest.approx(0.2)
    assert found[0] > 1e3 and found[1] > 1e12


def test_an_unknown_that_nothing_depends_on_is_unknown():
    found = _fisher(np.diag([4.0, 0.0]))
    assert found[0] == pytest.approx(0.5) and found[1] > 1e100
