"""A wrong adopted effect must not hold the search: the original model makes the next steps."""

from dataclasses import replace

from grounded.plant import Plant
from grounded.search.improve import propose
from grounded.search.planner import Planner, planner_with
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
