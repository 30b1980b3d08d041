"""One delay of all commands, or one of each."""

import numpy as np
import pytest

from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.hypotheses.variations import varied
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.effects import Library
from grounded.model import Model
from grounded.trial import Trial

DT, FINE = 0.02, 10
ROBOT = Model(
    states={"v": "m/s", "w": "rad/s"},
    inputs={"throttle": "1", "steer": "rad"},
    derivative=lambda s, a, p: {"v": 3 * (a.throttle - s.v), "w": 4 * (a.steer - s.w)},
)


def driven(late: tuple[float, float], count: int = 400) -> Trial:
    """Return a run whose commands arrive so many seconds late."""
    rng = np.random.default_rng(1)
    sent = np.repeat(rng.uniform(-1, 1, (count // 8, 2)), 8, axis=0)
    x, states = np.zeros(2), [np.zeros(2)]
    for k in range(FINE * count):
        at = [(k - round(d / DT * FINE)) // FINE for d in late]
        u = np.array([sent[i, j] if i >= 0 else 0.0 for j, i in enumerate(at)])
        x = x + DT / FINE * np.array([3.0, 4.0]) * (u - x)
        states += [x] * ((k + 1) % FINE == 0)
    noisy = np.array(states) + 0.002 * rng.standard_normal((count + 1, 2))
    return Trial(noisy, sent, DT, ("v", "w"), ("throttle", "steer"))


def delays(late: tuple[float, float]) -> dict[str, float]:
    """Return the delays that are left of one of both commands."""
    data = prepare(ROBOT, [driven(late)])
    offered = Library().candidates(ROBOT, data.scales)
    search = HypothesisSearch(data, [e for e in offered if e.family.name == "delay"])
    with np.errstate(all="ignore"):
        both = Library().effect("delay:throttle+steer", ROBOT, data.scales)
        start = search.fresh(search.fresh(Hypothesis())[0].plus(both, {"d": 0.03}))
        (fit,) = search.refined([start], 12)
        search.refined([search.fresh(Hypothesis())], 1)
        varied(search, fit)
    found = max(search.fits.values(), key=search.score)
    return {e.name: v["d"] for e, v in found.hypothesis.pairs}


def test_a_command_that_is_later_than_another_gets_a_delay_of_its_own():
    found = delays((0.03, 0.05))
    assert found == pytest.approx({"delay:throttle": 0.03, "delay:steer": 0.05}, abs=2e-3)
