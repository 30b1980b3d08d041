"""Derivatives of the grounded model, corrected by the mispredictions of earlier trials."""

from types import SimpleNamespace

import numpy as np
import pytest

from grounded.plant import Plant
from grounded.rollout import simulate
from grounded.search.ask_tell import Search
from grounded.search.mispredictions import believed, shared
from grounded.search.planner import Planner, predicted
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
