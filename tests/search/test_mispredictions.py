"""Derivatives of the grounded model, corrected by the mispredictions of earlier trials."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from grounded.model import Model
from grounded.plant import Plant
from grounded.rollout import simulate
from grounded.search.ask_tell import Search, learn
from grounded.search.candidate import BY_STEP
from grounded.search.corrected import Corrected, runs
from grounded.search.feedback import worse_costs
from grounded.search.mispredictions import PRICES, Seen, Told, believed, seen, shared
from grounded.search.planner import Planner, predicted
from grounded.search.step_size import SearchOptions
from grounded.solve.bias import ground
from small_tasks import cart_task, drive, other, rover_task


def searched(task, plant, trials):
    """Return a search after some trials, its incumbent, and the crude model grounded on it."""
    search = Search(task)
    for _ in range(trials):
        search.tell(drive(task, plant, search.ask()))
    best = search.best
    own = best.trials[0]
    problem = ground(task, own, exact=True).on(task.problem(exact=True))
    return SimpleNamespace(search=search, best=best, own=own, problem=problem, task=task)


@pytest.fixture(params=["gain", "wrong parameters, latency, two inputs"])
def found(request):
    if request.param == "gain":
        task = cart_task()
        return searched(task, Plant(task.model.with_values({"mass": 1.6, "drag": 0.6})), 2)
    task = rover_task()
    return searched(task, Plant(other(task.model, 1.3), latency={"speed": 0.05, "turn": 0.02}), 3)


def test_the_trial_is_still_replayed_and_others_are_foretold(found):
    planner, history = Planner(found.task, found.task), found.search.standing.history
    made = believed(planner, found.best, history, found.problem)
    replayed = predicted(made.problem, found.best.candidate.policy)
    n = found.task.model.n
    np.testing.assert_allclose(replayed.states[:, :n], found.own.states, atol=1e-9)
    assert replayed.utility == pytest.approx(found.best.utility)
    first = history[0]
    crude = simulate(found.problem, planner.widened(first.candidate.policy)).utility
    told = predicted(made.problem, first.candidate.policy).utility
    assert made.missed < 0.5
    assert abs(told - first.utility) < 0.7 * abs(crude - first.utility)


def test_its_derivatives_are_those_of_its_steps(found):
    planner, history = Planner(found.task, found.task), found.search.standing.history
    made = believed(planner, found.best, history, found.problem).corrected
    rng = np.random.default_rng(0)
    H, n = found.task.horizon, found.task.model.n
    x = np.hstack([made.x, np.zeros((H, n)), made.before])
    x += 0.1 * rng.normal(size=x.shape)
    u = made.u + 0.3 * rng.normal(size=made.u.shape)
    p, dt = found.problem.p, found.problem.dt
    f_x, f_u = made.linearise(x, u, p, dt)
    for given, of in ((f_x, x), (f_u, u)):
        for i in range(of.shape[1]):
            step = np.zeros(of.shape[1])
            step[i] = 1e-6
            up = made.step(*((x + step, u) if of is x else (x, u + step)), p, dt)
            down = made.step(*((x - step, u) if of is x else (x, u - step)), p, dt)
            np.testing.assert_allclose(given[:, :, i], (up - down) / 2e-6, atol=1e-5)
    by_p = made.sensitivities(x, u, p, dt)[2]
    base = found.problem.system.sensitivities(np.ascontiguousarray(x[:, :n]), u, p, dt)[2]
    np.testing.assert_array_equal(by_p[:, :n], base)


def test_a_law_is_found_and_noise_gives_none():
    rng = np.random.default_rng(1)
    d = rng.normal(size=(3, 80, 4))
    law = rng.normal(size=(2, 4))
    far = np.array([1.0, 1.0, 1.0])
    got, missed = shared(d, d @ law.T, far)
    np.testing.assert_allclose(got, law, atol=1e-3)
    assert missed < 1e-4
    _, missed = shared(d, rng.normal(size=(3, 80, 2)), far)
    assert missed > 0.9
    none, missed = shared(d, np.zeros((3, 80, 2)), far)
    assert not none.any()


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
    for one, alone in zip(found, expected, strict=True):
        np.testing.assert_allclose(one.states, alone.states, atol=1e-9)
        np.testing.assert_allclose(one.inputs, alone.inputs, atol=1e-8)
