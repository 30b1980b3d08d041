"""After `adopt` the changed model's own plan is run with its own gains, when it is due."""

from types import SimpleNamespace

import numpy as np

from grounded.search.feedback.oscillation import between_limits, limit_cycle
from grounded.search.improve import propose
from grounded.search.step.step_size import SearchOptions
from small_tasks import drive

OPTIONS = SearchOptions()


def step(run, planner):
    """Run one more trial; return the candidate and the utility."""
    made = propose(run.task, run.candidates, run.trials, OPTIONS, planner=planner)
    run.candidates += [made.candidate] * made.is_new
    run.trials.append(drive(run.task, run.plant, made.candidate, len(run.trials)))
    return made.candidate, run.task.utility(run.trials[-1])


def test_an_input_that_is_at_both_limits_for_long_swings_between_them():
    task = SimpleNamespace(low=np.array([-1.0]), high=np.array([1.0]))
    noisy = 0.7 * np.sin(np.arange(60.0))[:, None]
    for inputs, expected in ((noisy, False), (np.sign(noisy), True), (np.abs(noisy) * 9, False)):
        trial = SimpleNamespace(inputs=np.clip(inputs, -1.0, 1.0))
        assert between_limits(SimpleNamespace(trials=[trial]), task) == expected


def test_noise_about_an_input_that_is_off_lastingly_is_no_limit_cycle():
    """An arm that sags under a load does not get gentler gains: it would sag more."""
    task = SimpleNamespace(low=np.array([-20.0]), high=np.array([20.0]))
    plan = np.linspace(0.0, 0.5, 80)[:, None]
    made = SimpleNamespace(predicted_inputs=plan)
    noise = np.tile([0.4, -0.4], 40)[:, None]
    for held, expected in ((0.0, True), (5.0, False)):
        trial = SimpleNamespace(inputs=plan + noise + held, steps=80)
        assert limit_cycle(SimpleNamespace(candidate=made, trials=[trial]), task) == expected
