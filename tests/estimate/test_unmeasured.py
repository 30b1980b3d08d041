"""An unmeasured rate under model error, compared with its angle and the truth."""

import numpy as np
import pytest

from grounded.estimate import Record, process_noise, smoothed
from grounded.model import Model, Param

BOOM = Model(
    name="boom",
    states={"th": "rad", "w": "rad/s"},
    inputs={"u": "1"},
    params={"K": Param(0.5, "rad/s", 0.1, 1.0), "tau": Param(0.15, "s", 0.01, 1.0)},
    derivative=lambda s, a, p: {"th": s.w, "w": (p.K * a.u - s.w) / p.tau},
)


def turned(gain=0.4, tau=0.06, encoder=3e-4):
    """Return the record of a boom's angle at 100 Hz, and its true angle and rate (301,)."""
    t = np.arange(301) * 0.01
    at = t[:-1:4]
    u = np.where((at > 0.25) & (at < 2.2), 0.6 + 0.3 * np.sin(2 * at), 0.0)
    real, x = BOOM.with_values({"K": gain, "tau": tau}), np.zeros((301, 2))
    for k in range(300):
        x[k + 1] = real.system.step(x[k : k + 1], u[k // 4][None, None], real.values, 0.01)[0]
    y = x[:, :1] + encoder * np.random.default_rng(0).standard_normal((301, 1))
    y = np.hstack([y, np.full_like(y, np.nan)])
    return Record(t, y, at, u[:, None], np.zeros(1), start_std=np.array([1.0, 5.0])), *x.T


@pytest.mark.parametrize(("tau", "rms"), [(0.15, 0.006), (0.054, 0.0085), (0.03, 0.012)])
def test_a_rate_fits_the_slope_of_its_angle_where_the_model_is_off(tau, rms):
    """With a gain 25 % too large, a filter's rate is 0.0013 to 0.0075 rad/s too low on average."""
    record, th, w = turned()
    crude, known, sizes = (
        BOOM.with_values({"tau": tau}),
        np.array([3e-4, 1.0]),
        np.array([1.0, 0.5]),
    )
    noise = process_noise(crude, [record], known, sizes=sizes)
    found = smoothed(crude, [record], noise)[0].states[:, 1]
    assert np.mean(found[1:] + found[:-1]) / 2 == pytest.approx((th[-1] - th[0]) / 3, abs=5e-4)
    assert np.sqrt(np.mean((found - w) ** 2)) < rms
