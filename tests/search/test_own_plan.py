"""After `adopt` the changed model's own plan is run with its own gains, when it is due."""

from types import SimpleNamespace

import numpy as np

from grounded.search.feedback.oscillation import between_limits
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
