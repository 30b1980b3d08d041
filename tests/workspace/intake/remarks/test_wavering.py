"""A run that cost far more than predicted as its input went to and fro is told as that."""

from dataclasses import replace

import numpy as np
import pytest

from facts import holds
from grounded.plant import Plant
from grounded.search.candidate import Tried
from grounded.search.improve import propose
from grounded.search.step.step_size import SearchOptions
from grounded_trials.workspace.intake.remarks.control_loop import swung
from small_tasks import cart_task, drive

TASK = cart_task()


@pytest.fixture(scope="module")
def made():
    return propose(TASK, [], [], SearchOptions()).candidate


@pytest.mark.parametrize(
    ("size", "cost", "told"), [(1.15, True, True), (0.4, True, False), (1.15, False, False)]
)
def test_swings_below_the_plan_s_range_are_told_beside_a_cost_far_above_the_prediction(
    made, size, cost, told
):
    """An aircraft's aileron went from limit to limit, 72 times the predicted cost: not a word."""
    run = drive(TASK, Plant(TASK.model), made)
    wave = size * np.cos(0.9 * np.arange(run.steps))[:, None]
    states = np.array(run.states)
    states[1:, 0] += 2.0 * cost
    trial = replace(run, states=states, inputs=made.predicted_inputs + wave, id="t0001")
    tried = Tried(made, (trial,), (TASK.utility(trial),), True)
    assert np.ptp(made.predicted_inputs) > 2 * size
    said = swung(TASK, tried, trial, [tried])
    assert bool(said) == told
    if told:
        assert holds(said[0], "force about its plan", "swings of more than 2.0 N", "oscillate")
        assert holds(said[0], "Diagnose with this run", "input_change")
