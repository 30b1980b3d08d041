"""After feedback made inputs oscillate, later policies feed back no more than what ran quietly."""

from types import SimpleNamespace

import numpy as np

from grounded.plant import Noise, Plant
from grounded.search.improve import propose
from grounded.search.planner import Planner
from grounded.search.standing import standing
from grounded.search.step_size import SearchOptions
from small_tasks import drive, scara, scara_task

OPTIONS = SearchOptions()


def search(latency, runs):
    """Run a search on the arm with friction, rotors, load and a command delay it knows not of."""
    task = scara_task()
    noise = Noise(measurement={"q1": 5e-5, "q2": 5e-5, "w1": 5e-3, "w2": 5e-3})
    late = dict.fromkeys(task.model.input_names, latency)
    run = SimpleNamespace(
        task=task, plant=Plant(scara(1.0), latency=late, noise=noise, substeps=10)
    )
    run.candidates, run.trials = [], []
    for seed in range(runs):
        made = propose(task, run.candidates, run.trials, OPTIONS).candidate
        run.candidates += [made] * (made not in run.candidates)
        run.trials.append(drive(task, run.plant, made, seed))
    run.history = history_of(task, run.candidates, run.trials)
    return run


def history_of(task, candidates, trials):
    model = Planner(task, task).fingerprint
    return standing(task, candidates, trials, OPTIONS, model).history


def gains(made):
    return np.abs(made.policy.gain).mean()


def test_a_step_after_a_loss_of_gentler_gains_has_no_more_than_those():
    run = search(0.03, 4)
    loud, gentle, *steps = run.candidates
    assert gentle.way == "gentler gains" and not run.history[1].accepted
    assert all(one.way == "" and one.base for one in steps)
    assert max(map(gains, steps)) <= 1.05 * gains(gentle) < 0.5 * gains(loud)
    assert all(one.caution > 0 for one in steps)
