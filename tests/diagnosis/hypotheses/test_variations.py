"""Changes of a set of effects: one effect for several inputs; which acts first on a command."""

import numpy as np
import pytest

from grounded import Model, Param, Trial
from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.hypotheses.variations import variations, varied
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.effects import Library

DT, FADE, RATE = 0.02, 0.03, 5.0
VALVES = Model(
    name="valves",
    states={"v": "m/s", "w": "m/s"},
    inputs={"a": "1", "b": "1"},
    params={"tau": Param(0.15, "s")},
    derivative=lambda s, a, p: {"v": (a.a - s.v) / p.tau, "w": (a.b - s.w) / p.tau},
)
LIMIT, WEAKER, DELAY = "rate_limit:a", "input_fade:a", "delay:a"


def driven(trials=3, steps=300):
    """Valves whose first spool is slow and whose oil then flows ever less: limit, then fade."""
    rng, found = np.random.default_rng(3), []
    for k in range(trials):
        t = DT * np.arange(steps)
        u = np.stack([np.sign(np.sin((2.1 + 0.4 * k) * t)), np.sin((1.3 + 0.3 * k) * t)], axis=1)
        x, spool, rows = np.zeros(2), 0.0, [np.zeros(2)]
        for time, command in zip(t, u, strict=True):
            for _ in range(20):
                spool += np.clip(command[0] - spool, -RATE * DT / 20, RATE * DT / 20)
                acting = np.array([(1 - FADE * time) * spool, command[1]])
                x = acting + (x - acting) * np.exp(-DT / 20 / 0.15)
            rows.append(x := x + rng.normal(0, 1e-3, 2))
        noisy = np.array(rows) + rng.normal(0, 2e-3, (steps + 1, 2))
        found.append(Trial(noisy, u, DT, ("v", "w"), ("a", "b")))
    return found


@pytest.fixture(scope="module")
def search():
    data = prepare(VALVES, driven())
    found = HypothesisSearch(data, Library().candidates(VALVES, data.scales))
    found.refined([found.fresh(Hypothesis())])
    return found


def hypothesis(search, *parts):
    known, h = {effect.name: effect for effect in search.candidates}, Hypothesis()
    for name, values in parts:
        h = h.plus(known[name], values)
    return h


def test_an_effect_that_is_found_later_may_act_first(search):
    fade = hypothesis(search, (WEAKER, {"k": FADE}))
    few = HypothesisSearch(search.data, [e for e in search.candidates if e.name == LIMIT])
    (fit,) = few.refined([few.fresh(fade)], 25)
    few.refined(few.extended(fit), 25)
    (best,) = few.of_size(2)
    assert best.hypothesis.names == (LIMIT, WEAKER)
    assert best.hypothesis.values[0]["r"] == pytest.approx(RATE, rel=0.02)
    assert best.hypothesis.values[1]["k"] == pytest.approx(FADE, rel=0.05)


def names_of(search, *parts):
    """Return the effects of all variations of a set, each in its order."""
    return [h.names for h in variations(search, hypothesis(search, *parts))]


def test_a_set_is_rivalled_by_those_that_blame_fewer_inputs(search):
    both, fade = ("rate_limit:a+b", {"r": RATE}), (WEAKER, {"k": FADE})
    (fit,) = search.refined([search.fresh(hypothesis(search, both, fade))], 25)
    varied(search, fit)
    found = {f.hypothesis.names: search.score(f) for f in search.of_size(2)}
    assert found[LIMIT, WEAKER] > search.score(fit) - 1  # only one of the valves is slow
    assert found["rate_limit:b", WEAKER] < search.score(fit) - 10


@pytest.mark.parametrize("more", [("first_order_lag:b", "tau"), ("delay:b", "d")])
def test_a_delay_of_each_input_replaces_one_of_all_and_more_of_some(search, more):
    later, name = more
    both, limit = ("delay:a+b", {"d": 0.04}), (LIMIT, {"r": RATE})
    found = names_of(search, both, (later, {name: 0.01}), limit)
    assert (DELAY, "delay:b", LIMIT) in found
    assert names_of(search, both) == [(DELAY, "delay:b")]
