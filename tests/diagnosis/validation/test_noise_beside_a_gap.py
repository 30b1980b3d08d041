"""Beside a gap, the scatter of repeats and one-step errors are both bounds of the noise."""

from types import SimpleNamespace

import numpy as np
import pytest

from grounded.diagnosis.validation import measured
from grounded.diagnosis.validation.measured import Measured

SCATTER = np.array([[0.01, 0.005], [0.016, 0.0168], [np.nan, np.nan]])  # x, u at two horizons
CARRIED = np.array([[0.02, 0.004], [0.019, 0.0058], [np.nan, np.nan]])


def measuring(left):
    """Two runs of one candidate, and what is left in some states."""
    runs = [SimpleNamespace(candidate="c0004")] * 2
    errors = SimpleNamespace(rms=np.full((3, 2), 0.026))
    ruler = SimpleNamespace(
        steps=(1, 10),
        shown=[0, 1],
        measured=[(None, errors)],
        scatter=lambda fit, repeats: (SCATTER.copy(), np.array([0.3, 0.35, 1.0])),
    )
    return SimpleNamespace(
        exact=False,
        is_white=False,
        first=2,
        trials=runs,
        data=SimpleNamespace(model=SimpleNamespace(state_names=("x", "u"))),
        best=None,
        search=None,
        left=[SimpleNamespace(channel=name) for name in left],
        flexible={},
        units={"x": "m", "u": "m/s"},
        ruler=ruler,
        carried=CARRIED,
        sensors=lambda: np.zeros(2),
    )


@pytest.mark.parametrize("left", [(), ("u",), ("x", "u")])
def test_the_smaller_bound_is_the_noise_of_a_state_with_a_gap(monkeypatch, left):
    """Repeats that begin apart scatter by what the model misses in each as well."""
    monkeypatch.setattr(measured, "repeated", lambda *_: [[0, 1]])
    monkeypatch.setattr(measured, "carried", lambda *_: CARRIED.copy())
    monkeypatch.setattr(measured, "plain", lambda *_: None)
    found = measuring(left)
    floor, source = Measured.noise_floor(found)
    assert source == "repeats"
    assert floor[1].tolist() == [0.016, 0.0058 if left else 0.0168]
    sure = found.unsure[1] == 0.0  # how few repeats there are is no reason to doubt the other bound
    assert sure.tolist() == ([False, True] if left else [False])
