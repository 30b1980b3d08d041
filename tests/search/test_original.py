"""A wrong adopted effect must not hold the search: the original model makes the next steps."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from grounded.plant import Plant
from grounded.search.improve import propose
from grounded.search.planner import Planner, planner_with
from grounded.search.scatter import PIECES
from grounded.search.step.step_size import SearchOptions
from small_tasks import cart_task, drive, other, rover_task


def searched(task, plant, effects):
    """Return utilities and candidates of a search with effects adopted after the first trial."""
    planner, candidates, trials = Planner(task, task), [], []
    while True:
        made = propose(task, candidates, trials, SearchOptions(), planner=planner).candidate
        if made is None:
            return [task.utility(t) for t in trials], candidates
        candidates.append(made)
        trials.append(drive(task, plant, made))
        if effects:
            planner = replace(planner_with(task, effects), task=task)


CASES = {
    "cart": (cart_task(), "rate_gain:v"),
    "rover": (rover_task(), "rate_gain:psi"),
}


def test_a_wrong_effect_that_broke_its_promises_makes_no_further_steps(name="cart"):
    task, target = CASES[name]
    plant = Plant(other(task.model, 1.3))
    without, _ = searched(task, plant, [])
    found, candidates = searched(task, plant, [(target, {"g": -1.6})])
    assert found[1] < found[0]  # the step of the wrong model lost
    assert len({c.model for c in candidates}) == 2
    assert all(c.of_original for c in candidates[2:])
    assert max(found) >= 1.002 * max(without)


def test_an_effect_that_keeps_its_promises_makes_all_steps():
    task = cart_task()
    true = planner_with(task, [("rate_gain:v", {"g": 0.5})]).plan.model
    _, candidates = searched(task, Plant(true), [("rate_gain:v", {"g": 0.45})])
    assert len(candidates) > 1
    assert not any(c.of_original for c in candidates)


def step(
    name,
    base,
    model,
    promised,
    utility,
    of_original=False,
    accepted=True,
    doubtful=False,
    runs=None,
    lost=True,
):
    fields = {"id": name, "base": base, "model": model, "predicted_gain": promised}
    made = SimpleNamespace(**fields, of_original=of_original, doubtful=doubtful)
    utilities = (utility,) if runs is None else runs
    pieces = None if runs is None else np.outer(runs, np.ones(PIECES) / PIECES)
    fields = {"utility": float(np.mean(utilities)), "utilities": utilities, "pieces": pieces}
    fields["gain_over"] = lambda other: float(np.mean(utilities)) - other.utility
    return SimpleNamespace(
        candidate=made, accepted=accepted, lost=accepted is False and lost, **fields
    )


def test_a_run_that_was_stopped_on_its_path_broke_no_promise():
    task, target = CASES["cart"]
    plant, options = Plant(other(task.model, 1.3)), SearchOptions()
    candidates = [propose(task, [], [], options).candidate]
    trials = [drive(task, plant, candidates[0])]
    planner = replace(planner_with(task, [(target, {"g": -1.6})]), task=task)
    candidates.append(propose(task, candidates, trials, options, planner=planner).candidate)
    assert candidates[1].predicted_gain > 0.1 * -task.utility(trials[0])
    run = replace(trials[0].until(27), candidate="c0002", id="t2")
    fell = np.array(run.states)
    fell[15:, 0] -= np.linspace(0.0, 5.0, len(fell) - 15)
    for stopped, original in ((run, False), (replace(run, states=fell), True)):
        made = propose(task, candidates, [*trials, stopped], options, planner=planner)
        assert made.standing.history[1].verdict() == "crashed"
        assert made.candidate.of_original is original
