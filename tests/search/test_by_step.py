"""Derivatives corrected step by step, after other steps have lost."""

from dataclasses import replace

import numpy as np
import pytest

from grounded.model import Model
from grounded.plant import Plant
from grounded.search.ask_tell import Search, learn
from grounded.search.candidate import BY_STEP
from grounded.search.corrected import Corrected, runs
from grounded.search.feedback import worse_costs
from grounded.search.mispredictions import PRICES, Seen, Told, seen
from grounded.search.planner import Planner, predicted
from grounded.search.step_size import SearchOptions
from grounded.solve.bias import ground
from small_tasks import cart_task, drive


def rails(s, a, p):
    """A cart whose drive lags and grips well and badly by turns: no law holds all along."""
    grip = 1 + 0.8 * np.sin(12 * s.x)
    return {"x": s.v, "v": s.drive * grip - 0.5 * s.v, "drive": (a.force - s.drive) / 0.02}


RAILS = Model(
    name="cart on rails",
    states={"x": "m", "v": "m/s", "drive": "N"},
    inputs={"force": "N"},
    derivative=rails,
)
TASK = cart_task(low=np.array([-15.0]), high=np.array([15.0]))


@pytest.fixture(scope="module")
def story():
    """Return the standing of a whole search on the rails."""
    return learn(TASK, lambda c: drive(TASK, Plant(RAILS), c), SearchOptions()).standing


def test_a_search_goes_on_where_laws_of_the_whole_run_lose(story):
    steps = [t for t in story.history if t.candidate.way == BY_STEP]
    whole = [t.utility for t in story.history if t.accepted and t.candidate.way != BY_STEP]
    assert story.incumbent.utility > 0.97 * max(whole)
    assert sum(bool(t.accepted) for t in steps) >= 2
    assert steps[0].candidate.damping == 10.0


@pytest.fixture
def grounded():
    """Return a search after two trials, and the crude model grounded on the best one."""
    search = Search(TASK)
    for _ in range(2):
        search.tell(drive(TASK, Plant(RAILS), search.ask()))
    best = search.best
    problem = ground(TASK, best.trials[0], exact=True).on(TASK.problem(exact=True))
    return search, best, problem


def turning(own: Seen, count: int) -> tuple[np.ndarray, list[Seen]]:
    """Return slopes E (H, n, n + m) of changing sign, and trials that show them."""
    rng, (H, n), m = np.random.default_rng(0), own.x.shape, own.u.shape[1]
    E = 0.3 * rng.standard_normal((n, n + m)) * np.sin(np.arange(H))[:, None, None]
    others = []
    for _ in range(count):
        d = 0.01 * rng.standard_normal((H, n + m))
        x, u = own.x + d[:, :n], own.u + d[:, n:]
        y = np.einsum("tnq,tq->tn", E, d)
        others.append(replace(own, x=x, u=u, before=np.vstack([u[:1], u[:-1]]), y=y))
    return E, others


def test_slopes_that_change_along_the_run_are_found(grounded):
    _, best, problem = grounded
    own = seen(Planner(TASK, TASK), best, problem)
    E, others = turning(own, 8)
    law = Told.by(others, own, problem).law(PRICES[0])
    q = E.shape[2]
    assert np.abs(law[:, :, :q] - E).max() < 0.1 * np.abs(E).max()


@pytest.mark.parametrize("age", [0.0, 0.013])
def test_runs_together_are_those_one_by_one_in_a_fraction_of_the_steps(grounded, age, monkeypatch):
    _, best, problem = grounded
    own = seen(Planner(TASK, TASK), best, problem)
    _, others = turning(own, 3)
    told = Told.by(others, own, problem)
    corrected = Corrected(problem.system, told.law(0.1), own.x, own.u, own.before)
    late = replace(corrected.on(problem), age=age)
    policy, steps = best.candidate.policy, []
    tried = [
        replace(policy, feedforward=policy.feedforward + 0.03 * i, gain=(1 - 0.1 * i) * policy.gain)
        for i in range(6)
    ]
    deep = policy.laid_out(policy.state_names, policy.angles, tuple(d + 2 for d in policy.depths))
    gain = deep.gain.copy()
    gain[:, :, -1] = 0.05  # on inputs that this model forgets
    tried.append(replace(deep, gain=gain))
    stepped = Corrected.stepped
    monkeypatch.setattr(
        Corrected, "stepped", lambda *given: steps.append(given[3]) or stepped(*given)
    )
    alone = [predicted(late, one) for one in tried]
    one_by_one = len(steps)
    together = runs([late] * len(tried), tried)
    assert len(steps) - one_by_one < 0.3 * one_by_one
    assert_same_runs(together, alone)
    monkeypatch.setattr("grounded.search.corrected.MOST_GAINS", 1)  # a long horizon: one at a time
    assert_same_runs(runs([late] * len(tried), tried), alone)
    assert worse_costs([late], replace(policy, gain=None, reference=None)).min() == np.inf


def assert_same_runs(found, expected):
    np.testing.assert_allclose(
        [one.utility for one in found], [one.utility for one in expected], rtol=1e-9
    )
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one.states, other.states, atol=1e-9)
        np.testing.assert_allclose(one.inputs, other.inputs, atol=1e-8)
